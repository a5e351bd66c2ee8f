//! Callers that go away in the middle: whatever a statement had come to, the store is whole and works on.

use super::*;
use std::pin::{Pin, pin};
use std::task::{Context, Poll};

/// A future that is dropped unless it ends within so many polls.
struct Polls<F> {
    future: F,
    left: usize,
}

impl<F: Future + Unpin> Future for Polls<F> {
    type Output = Option<F::Output>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        if self.left == 0 {
            return Poll::Ready(None);
        }
        self.left -= 1;
        let ended = Pin::new(&mut self.future).poll(context).map(Some);
        // The last poll is not waited for: what it began is dropped while it runs.
        if ended.is_pending() && self.left == 0 { Poll::Ready(None) } else { ended }
    }
}

/// What a future gives, where it ends within so many polls.
async fn polled<F: Future>(future: F, times: usize) -> Option<F::Output> {
    Polls { future: pin!(future), left: times }.await
}

/// More polls than any method needs.
const MAX_POLLS: usize = 3000;

/// The store still writes, and what it writes is there for others.
async fn works(store: &dyn Store, other: &dyn Store, name: &str) {
    let made = plant(store, name).await;
    let found = other.plant(made.id).await.unwrap();
    assert_eq!(found.map(|plant| plant.name).as_deref(), Some(name), "what was acknowledged is not there");
}

/// Transactions are dropped at each of their awaits.
pub async fn a_transaction_cancelled_at_any_await_is_whole_or_not_at_all(store: &dyn Store, other: &dyn Store) {
    for times in 1..MAX_POLLS {
        let plant = plant(store, &format!("Model {times}")).await;
        let survey = survey(store, plant.id, "June").await;
        let job = enqueue(store, &survey).await;
        let claim = claim(store, 0).await.unwrap();
        assert_eq!(claim.job.id, job.id);
        store.reserve_model(plant.id, (Digest::of(b"model"), 5), at(0)).await.unwrap();
        let new = model(plant.id, 1, 3);
        let ended = polled(store.complete_job(&claim, &new, at(1)), times).await;
        works(store, other, &format!("After model {times}")).await;
        let (state, models) = (state(other, &job).await, other.models(plant.id, ALL).await.unwrap().len());
        match &ended {
            Some(completed) => {
                completed.as_ref().unwrap();
                assert_eq!((state, models), (JobState::Succeeded, 1));
                return;
            }
            // Its commit may have been on its way.
            None => assert!(matches!((state, models), (JobState::Running, 0) | (JobState::Succeeded, 1)), "{times}"),
        }
        store.delete_plant(plant.id, at(2)).await.unwrap();
    }
    panic!("the job never ended within {MAX_POLLS} polls");
}

/// Claims are dropped at each await: the queue goes on.
pub async fn a_claim_cancelled_at_any_await_leaves_the_queue_whole(store: &dyn Store, other: &dyn Store) {
    for times in 1..MAX_POLLS {
        let plant = plant(store, &format!("Claim {times}")).await;
        let survey = survey(store, plant.id, "June").await;
        let job = enqueue(store, &survey).await;
        let ended = polled(store.claim_job("worker", LEASE, at(0)), times).await;
        works(store, other, &format!("After claim {times}")).await;
        if let Some(claimed) = ended {
            assert_eq!(claimed.unwrap().unwrap().job.id, job.id);
            return;
        }
        let state = state(other, &job).await;
        assert!(matches!(state, JobState::Queued | JobState::Running), "{state:?}");
        store.delete_plant(plant.id, at(2)).await.unwrap();
    }
    panic!("the claim never ended within {MAX_POLLS} polls");
}

/// Single statements that write, and that read, are dropped at each await.
pub async fn a_statement_cancelled_at_any_await_leaves_the_store_whole(store: &dyn Store, other: &dyn Store) {
    let written = plant(store, "Written").await;
    let mut times = 0;
    loop {
        times += 1;
        let ended = polled(store.forget_deleted_plants(at(0)), times).await;
        works(store, other, &format!("After a write {times}")).await;
        if ended.is_some() || times > MAX_POLLS {
            ended.unwrap().unwrap();
            break;
        }
    }
    times = 0;
    loop {
        times += 1;
        let ended = polled(store.plants(ORGANISATION, None, "", ALL), times).await;
        works(store, other, &format!("After a read {times}")).await;
        if ended.is_some() || times > MAX_POLLS {
            assert!(ended.unwrap().unwrap().iter().any(|plant| plant.id == written.id));
            break;
        }
    }
}
