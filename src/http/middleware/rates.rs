//! How often a caller may ask, how often an address may fail to show a key that is good, and how many refusals are noted.

use crate::config::Limits;
use crate::http::error::{ApiError, Code};
use crate::store::KeyId;
use governor::clock::{Clock, DefaultClock};
use governor::{DefaultKeyedRateLimiter, Quota, RateLimiter};
use std::hash::Hash;
use std::net::{IpAddr, Ipv6Addr};
use std::num::NonZeroU32;
use std::sync::atomic::{AtomicU32, Ordering};

/// After so many counts, keys and addresses that were not heard of for a while are forgotten.
const FORGET_EVERY: u32 = 10_000;
/// How many refused looks of a caller are noted in a minute.
const REFUSALS_PER_MINUTE: NonZeroU32 = NonZeroU32::new(60).unwrap();

/// Counts the requests of each key and the failures of each address in this process.
pub struct Rates {
    clock: DefaultClock,
    counted: AtomicU32,
    keys: DefaultKeyedRateLimiter<KeyId>,
    addresses: DefaultKeyedRateLimiter<IpAddr>,
    refusals: DefaultKeyedRateLimiter<KeyId>,
}

impl Rates {
    /// Rates within these limits.
    pub fn new(limits: &Limits) -> Self {
        let at_least_one = |count: u32| NonZeroU32::new(count).unwrap_or(NonZeroU32::MIN);
        let per_second = at_least_one(limits.max_requests_per_second);
        let burst = per_second.saturating_mul(NonZeroU32::MIN.saturating_add(1));
        Self {
            clock: DefaultClock::default(),
            counted: AtomicU32::new(0),
            keys: RateLimiter::keyed(Quota::per_second(per_second).allow_burst(burst)),
            addresses: RateLimiter::keyed(Quota::per_minute(at_least_one(limits.max_failed_logins_per_minute))),
            refusals: RateLimiter::keyed(Quota::per_minute(REFUSALS_PER_MINUTE)),
        }
    }

    /// Counts a refused look of a caller; whether it is to be noted: who is refused without end fills no disk.
    pub fn refusal(&self, key: Option<KeyId>) -> bool {
        key.is_none_or(|key| self.count(&self.refusals, key, "refused too often").is_ok())
    }

    /// Counts a request of a caller; a problem where there were too many.
    pub fn request(&self, key: KeyId) -> Result<(), ApiError> {
        self.count(&self.keys, key, "this key asks too often: ask less often, or ask for a higher limit")
    }

    /// Counts a request without a good key; a problem where there were too many from its address.
    pub fn failure(&self, address: IpAddr) -> Result<(), ApiError> {
        self.count(&self.addresses, network(address), "too many requests without a good key came from this address")
    }

    fn count<K: Hash + Eq + Clone>(
        &self,
        rates: &DefaultKeyedRateLimiter<K>,
        who: K,
        detail: &'static str,
    ) -> Result<(), ApiError> {
        if self.counted.fetch_add(1, Ordering::Relaxed) % FORGET_EVERY == FORGET_EVERY - 1 {
            self.keys.retain_recent();
            self.addresses.retain_recent();
            self.refusals.retain_recent();
        }
        rates.check_key(&who).map_err(|until| {
            let wait = until.wait_time_from(self.clock.now());
            ApiError::new(Code::TooManyRequests, detail).retry_after(wait.as_secs() + 1)
        })
    }
}

/// One customer's network: an IPv6 customer has at least 2^64 addresses.
pub fn network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX))),
        address => address,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use uuid::Uuid;

    #[test]
    fn each_key_and_network_is_counted_by_itself() {
        let limits = Limits { max_requests_per_second: 1, max_failed_logins_per_minute: 2, ..Limits::default() };
        let rates = Rates::new(&limits);
        let (one, other) = (KeyId(Uuid::from_u128(1)), KeyId(Uuid::from_u128(2)));
        assert!(rates.request(one).is_ok() && rates.request(one).is_ok());
        let refused = rates.request(one).unwrap_err();
        assert_eq!((refused.code, refused.retry_after_s), (Code::TooManyRequests, Some(1)));
        assert!(rates.request(other).is_ok());

        let address = |text: &str| text.parse::<IpAddr>().unwrap();
        assert!(rates.failure(address("2001:db8::1")).is_ok() && rates.failure(address("2001:db8::2")).is_ok());
        let refused = rates.failure(address("2001:db8::3")).unwrap_err();
        assert!((1..=31).contains(&refused.retry_after_s.unwrap()), "{refused:?}");
        assert!(rates.failure(address("2001:db8:0:1::3")).is_ok());
        // The same customer, whichever way the address is written.
        assert!(rates.failure(address("192.0.2.1")).is_ok() && rates.failure(address("::ffff:192.0.2.1")).is_ok());
        assert!(rates.failure(address("192.0.2.1")).is_err());
    }
}
