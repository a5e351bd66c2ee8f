//! What every request passes on its way to a controller.

pub mod access;
pub mod admission;
pub mod conditional;
pub mod encoding;
pub mod head;
pub mod idempotency;
pub mod loopback;
pub mod rates;
