//! Turns at work of which little may be done at once: organisations take them one after the other, so that none waits for all
//! that another has sent.

use crate::store::OrganisationId;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::oneshot;

/// Who waits, by organisation, and how many may work.
#[derive(Debug)]
struct Queue {
    free: usize,
    /// Organisations in the order in which they are next; each with those who wait in the order in which they came.
    waiting: VecDeque<(OrganisationId, VecDeque<oneshot::Sender<Turn>>)>,
}

/// Turns at some work.
#[derive(Debug, Clone)]
pub struct Turns(Arc<Mutex<Queue>>);

/// The right to work until it is dropped.
#[derive(Debug)]
pub struct Turn(Turns);

impl Turns {
    /// So many may work at once.
    pub fn new(at_once: usize) -> Self {
        Self(Arc::new(Mutex::new(Queue { free: at_once, waiting: VecDeque::new() })))
    }

    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for a turn.
    pub async fn take(&self, organisation: OrganisationId) -> Turn {
        let receiver = {
            let mut queue = self.queue();
            if queue.free > 0 {
                queue.free -= 1;
                return Turn(self.clone());
            }
            let (sender, receiver) = oneshot::channel();
            match queue.waiting.iter_mut().find(|(waiting, _)| *waiting == organisation) {
                Some((_, senders)) => senders.push_back(sender),
                None => queue.waiting.push_back((organisation, VecDeque::from([sender]))),
            }
            receiver
        };
        match receiver.await {
            Ok(turn) => turn,
            // Who waits is never forgotten: a sender goes only with its turn.
            Err(_) => Turn(self.clone()),
        }
    }

    /// Who is next: one of each organisation in turn.
    fn next(&self) -> Option<oneshot::Sender<Turn>> {
        let mut queue = self.queue();
        while let Some((organisation, mut senders)) = queue.waiting.pop_front() {
            let next = senders.pop_front();
            if !senders.is_empty() {
                queue.waiting.push_back((organisation, senders));
            }
            // Who went away meanwhile waits no longer.
            if let Some(sender) = next.filter(|sender| !sender.is_closed()) {
                return Some(sender);
            }
        }
        queue.free += 1;
        None
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        if let Some(sender) = self.0.next() {
            // Where nobody takes it any more it is dropped, and goes on to who is next.
            let _ = sender.send(Turn(self.0.clone()));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use futures::FutureExt;
    use uuid::Uuid;

    fn organisation(number: u128) -> OrganisationId {
        OrganisationId(Uuid::from_u128(number))
    }

    #[tokio::test]
    async fn organisations_take_turns_however_many_of_one_wait() {
        let turns = Turns::new(1);
        let held = turns.take(organisation(1)).await;
        let order = Arc::new(Mutex::new(Vec::new()));
        let mut tasks = Vec::new();
        for (name, of) in [("a1", 1), ("a2", 1), ("a3", 1), ("b1", 2), ("c1", 3), ("b2", 2)] {
            let (turns, order) = (turns.clone(), order.clone());
            tasks.push(tokio::spawn(async move {
                let _turn = turns.take(organisation(of)).await;
                order.lock().unwrap().push(name);
            }));
            tokio::task::yield_now().await;
        }
        drop(held);
        for task in tasks {
            task.await.unwrap();
        }
        assert_eq!(*order.lock().unwrap(), ["a1", "b1", "c1", "a2", "b2", "a3"]);
    }

    #[tokio::test]
    async fn who_goes_away_leaves_the_turn_to_others() {
        let turns = Turns::new(2);
        let held = [turns.take(organisation(1)).await, turns.take(organisation(1)).await];
        let mut gone = Box::pin(turns.take(organisation(2)));
        assert!((&mut gone).now_or_never().is_none());
        let mut stays = Box::pin(turns.take(organisation(3)));
        assert!((&mut stays).now_or_never().is_none());
        drop(gone);
        drop(held);
        let turn = stays.now_or_never().unwrap();
        // One of two is free again; with the other they are all.
        let other = turns.take(organisation(4)).now_or_never().unwrap();
        assert!(turns.take(organisation(5)).now_or_never().is_none());
        drop((turn, other));
        assert!(turns.take(organisation(5)).now_or_never().is_some());
    }

    #[tokio::test]
    async fn a_turn_that_came_too_late_goes_on() {
        let turns = Turns::new(1);
        let held = turns.take(organisation(1)).await;
        let mut late = Box::pin(turns.take(organisation(2)));
        assert!((&mut late).now_or_never().is_none());
        // It is handed over, and its taker goes without having seen it.
        drop(held);
        drop(late);
        assert!(turns.take(organisation(3)).now_or_never().is_some());
    }
}
