//! Images of a job that workers share.

use super::{LEASE, at, claim, enqueue, plant, survey};
use heliomap::store::{Checkpoint, Ending, GivenBack, ImageTask, OwnTask, Store};
use std::time::Duration;
use tokio::sync::Notify;

fn tasks(images: &[&str]) -> Vec<ImageTask> {
    let task = |image: &&str| ImageTask { image: (*image).to_owned(), document: format!("about {image}") };
    images.iter().map(task).collect()
}

pub async fn tasks_are_shared_among_workers(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    enqueue(store, &survey).await;
    let owner = claim(store, 0).await.unwrap();
    assert_eq!(store.take_own_task(&owner, at(0)).await.unwrap(), OwnTask::None);
    assert!(store.offer_tasks(&owner, "f", "this version", &tasks(&["a", "b", "c", "d"])).await.unwrap());
    assert_eq!(store.waiting_tasks(at(0)).await.unwrap(), 4);
    assert_eq!(store.queue(at(0)).await.unwrap().images, 4);
    // A worker of another version finds something else in the same images.
    assert!(store.take_task("another version", LEASE, at(0)).await.unwrap().is_none());
    let helper = store.take_task("this version", LEASE, at(0)).await.unwrap().unwrap();
    assert_eq!((helper.plant, helper.job, &helper.task), (survey.plant, owner.job.id, &tasks(&["a"])[0]));
    assert_eq!(store.take_own_task(&owner, at(1)).await.unwrap(), OwnTask::Image("b".to_owned()));
    assert!(store.gather_tasks(&owner).await.unwrap().is_empty());

    assert!(store.finish_task(&helper, b"in a").await.unwrap());
    assert!(!store.finish_task(&helper, b"in a, again").await.unwrap());
    let found = Checkpoint { name: "a".to_owned(), document: b"in a".to_vec() };
    assert_eq!(store.checkpoints(owner.job.id, "f").await.unwrap(), std::slice::from_ref(&found));
    assert_eq!(store.gather_tasks(&owner).await.unwrap(), [found]);
    assert!(store.gather_tasks(&owner).await.unwrap().is_empty());

    // What could not be done is for the job's own worker alone.
    let helper = store.take_task("this version", LEASE, at(1)).await.unwrap().unwrap();
    assert_eq!(helper.task.image, "c");
    store.give_back_task(&helper, GivenBack::ToOwner).await.unwrap();
    let last = store.take_task("this version", LEASE, at(1)).await.unwrap().unwrap();
    assert_eq!(last.task.image, "d");
    assert!(store.take_task("this version", LEASE, at(1)).await.unwrap().is_none());
    assert_eq!(store.waiting_tasks(at(1)).await.unwrap(), 0);
    assert_eq!(store.take_own_task(&owner, at(1)).await.unwrap(), OwnTask::Image("c".to_owned()));
    assert_eq!(store.take_own_task(&owner, at(1)).await.unwrap(), OwnTask::HeldByOthers);
    store.give_back_task(&last, GivenBack::ToAll).await.unwrap();
    assert_eq!(store.take_own_task(&owner, at(1)).await.unwrap(), OwnTask::Image("d".to_owned()));
    assert_eq!(store.take_own_task(&owner, at(1)).await.unwrap(), OwnTask::None);
    let own: Vec<_> = ["b", "c", "d"].map(|name| Checkpoint { name: name.to_owned(), document: vec![1] }).into();
    assert!(store.checkpoint(&owner, "f", &own).await.unwrap());
    assert_eq!(store.checkpoints(owner.job.id, "f").await.unwrap().len(), 4);
}

pub async fn workers_are_notified(store: &dyn Store) {
    let plant = plant(store, "A").await.id;
    let (june, july) = (survey(store, plant, "June").await, survey(store, plant, "July").await);
    let bell = Notify::new();
    let rung = async |after: &str| {
        let rung = tokio::time::timeout(Duration::from_secs(20), bell.notified()).await;
        rung.unwrap_or_else(|_| panic!("nothing rang after {after}"));
    };
    let script = async {
        enqueue(store, &june).await;
        let owner = claim(store, 0).await.unwrap();
        // Since when it is listened is not known.
        loop {
            assert!(store.offer_tasks(&owner, "f", "v", &tasks(&["a"])).await.unwrap());
            if tokio::time::timeout(Duration::from_millis(50), bell.notified()).await.is_ok() {
                break;
            }
        }
        // Until all of that was heard.
        while tokio::time::timeout(Duration::from_millis(200), bell.notified()).await.is_ok() {}
        enqueue(store, &july).await;
        rung("a job was queued").await;
        store.offer_tasks(&owner, "f", "v", &tasks(&["a"])).await.unwrap();
        rung("images were offered").await;
        let helper = store.take_task("v", LEASE, at(0)).await.unwrap().unwrap();
        store.give_back_task(&helper, GivenBack::ToAll).await.unwrap();
        rung("an image was given back").await;
        store.end_job(&owner, &Ending::Released, at(1)).await.unwrap();
        rung("a job was given back").await;
    };
    tokio::time::timeout(Duration::from_secs(60), async {
        tokio::select! {
            () = store.listen_for_work(&bell) => unreachable!("it rings for as long as it is polled"),
            () = script => {}
        }
    })
    .await
    .expect("it rings");
}

pub async fn tasks_of_silent_workers_are_claimed_again(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    enqueue(store, &survey).await;
    assert!(claim(store, 0).await.is_some());
    let owner = claim(store, 100).await.unwrap();
    store.offer_tasks(&owner, "f", "v", &tasks(&["a", "b"])).await.unwrap();
    let silent = store.take_task("v", LEASE, at(100)).await.unwrap().unwrap();
    let alive = store.take_task("v", LEASE, at(100)).await.unwrap().unwrap();
    assert_eq!(store.extend_tasks(&[alive.token], LEASE, at(120)).await.unwrap(), [alive.token]);
    assert_eq!(store.take_own_task(&owner, at(130)).await.unwrap(), OwnTask::HeldByOthers);
    assert!(store.take_task("v", LEASE, at(130)).await.unwrap().is_none());
    let second = store.take_task("v", LEASE, at(131)).await.unwrap().unwrap();
    assert_eq!((second.task.image.as_str(), second.token != silent.token), ("a", true));
    // Who was silent has lost it, and changes nothing any more.
    assert!(store.extend_tasks(&[silent.token], LEASE, at(132)).await.unwrap().is_empty());
    assert!(!store.finish_task(&silent, b"late").await.unwrap());
    store.give_back_task(&silent, GivenBack::ToOwner).await.unwrap();
    assert_eq!(store.take_own_task(&owner, at(151)).await.unwrap(), OwnTask::Image("b".to_owned()));
    assert!(!store.finish_task(&alive, b"late").await.unwrap());
    assert!(store.finish_task(&second, b"in a").await.unwrap());
    // Others' work counts as the job's: this was its last attempt, and it has another.
    assert_eq!(claim(store, 200).await.unwrap().job.attempt, 3);
}

pub async fn tasks_are_deleted_with_their_job(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let job = enqueue(store, &survey).await;
    let first = claim(store, 0).await.unwrap();
    store.offer_tasks(&first, "f", "v", &tasks(&["a", "b"])).await.unwrap();
    let held = store.take_task("v", LEASE, at(0)).await.unwrap().unwrap();
    // The next worker offers anew; what was held before is lost.
    let second = claim(store, 40).await.unwrap();
    assert!(!store.offer_tasks(&first, "f", "v", &tasks(&["a"])).await.unwrap());
    assert_eq!(store.take_own_task(&first, at(40)).await.unwrap(), OwnTask::HeldByOthers);
    assert!(store.offer_tasks(&second, "g", "v", &tasks(&["a", "b"])).await.unwrap());
    assert!(!store.finish_task(&held, b"late").await.unwrap());
    assert!(store.checkpoints(job.id, "g").await.unwrap().is_empty());

    let held = store.take_task("v", LEASE, at(41)).await.unwrap().unwrap();
    store.cancel_job(job.plant, job.id, at(42)).await.unwrap();
    assert!(store.take_task("v", LEASE, at(42)).await.unwrap().is_none());
    assert!(store.extend_tasks(&[held.token], LEASE, at(42)).await.unwrap().is_empty());
    assert_eq!(store.waiting_tasks(at(42)).await.unwrap(), 0);
    assert!(store.end_job(&second, &Ending::Cancelled, at(43)).await.unwrap());
    assert!(!store.finish_task(&held, b"late").await.unwrap());
    assert_eq!(store.take_own_task(&second, at(43)).await.unwrap(), OwnTask::None);

    // A plant that is deleted takes them along.
    enqueue(store, &survey).await;
    let third = claim(store, 50).await.unwrap();
    store.offer_tasks(&third, "f", "v", &tasks(&["a"])).await.unwrap();
    store.delete_plant(survey.plant, at(51)).await.unwrap();
    assert_eq!(store.waiting_tasks(at(51)).await.unwrap(), 0);
}
