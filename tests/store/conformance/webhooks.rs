//! Webhooks and the messages to them.

use super::{ALL, LEASE, ORGANISATION, at, claim, enqueue, model, plant, survey};
use heliomap::store::{
    Completed, Created, DeliveryState, Ending, JobId, NewWebhook, OrganisationId, Quotas, Sent, SigningSecret, Store,
    StoreError, Webhook, WebhookId,
};
use heliomap_model::PlantId;
use std::time::Duration;
use uuid::Uuid;

async fn webhook(store: &dyn Store, organisation: OrganisationId, plant: Option<PlantId>) -> Webhook {
    let secret = SigningSecret::given("0123456789abcdef").unwrap();
    let new = NewWebhook { organisation, plant, url: "https://example.org/".to_owned(), secret };
    store.create_webhook(&new, at(0)).await.unwrap().unwrap()
}

async fn messages(store: &dyn Store, webhook: &Webhook) -> Vec<(JobId, DeliveryState)> {
    let found = store.deliveries(webhook.id, None, ALL).await.unwrap();
    found.into_iter().map(|delivery| (delivery.job, delivery.state)).collect()
}

pub async fn webhooks(store: &dyn Store) {
    let Created::New(other) = store.create_organisation("other", at(0)).await.unwrap() else {
        panic!("there is no such organisation yet");
    };
    let (a, b) = (plant(store, "A").await, plant(store, "B").await);
    let all = webhook(store, ORGANISATION, None).await;
    let of_a = webhook(store, ORGANISATION, Some(a.id)).await;
    let strange = webhook(store, other.id, None).await;
    let of_nothing = NewWebhook {
        organisation: ORGANISATION,
        plant: Some(PlantId(Uuid::nil())),
        url: String::new(),
        secret: SigningSecret::random().unwrap(),
    };
    let nowhere = store.create_webhook(&of_nothing, at(0)).await;
    assert!(matches!(nowhere, Err(StoreError::Gone { what: "plant" })));
    let listed = store.webhooks(ORGANISATION, ALL).await.unwrap();
    assert_eq!(listed.iter().map(|webhook| webhook.id).collect::<Vec<_>>(), [all.id, of_a.id]);
    assert_eq!(listed[1].plant, Some(a.id));
    assert!(store.webhook(other.id, all.id).await.unwrap().is_none());
    assert!(!store.delete_webhook(other.id, all.id).await.unwrap());

    // Every end creates one message; a return to the queue creates none.
    let (june, july) = (survey(store, a.id, "June").await, survey(store, b.id, "July").await);
    let mut ended = Vec::new();
    for ending in 0..5 {
        let job = enqueue(store, &june).await;
        if ending == 0 {
            store.cancel_job(a.id, job.id, at(1)).await.unwrap();
        } else {
            let claimed = claim(store, 1).await.unwrap();
            let failed = Ending::Failed { code: "code".to_owned(), message: "message".to_owned() };
            match ending {
                1 => assert!(store.end_job(&claimed, &failed, at(1)).await.unwrap()),
                2 => assert!(store.end_job(&claimed, &Ending::Cancelled, at(1)).await.unwrap()),
                3 => {
                    let done = store.complete_job(&claimed, &model(a.id, 1, 1), at(1)).await.unwrap();
                    assert!(matches!(done, Completed::Done(_)));
                }
                _ => {
                    let backoff = Duration::from_secs(1);
                    let retry = Ending::Retry { code: "code".to_owned(), message: "message".to_owned(), backoff };
                    assert!(store.end_job(&claimed, &retry, at(1)).await.unwrap());
                    assert_eq!(messages(store, &of_a).await.len(), ended.len());
                    // Its last attempt, whose worker falls silent.
                    claim(store, 2).await.unwrap();
                    assert!(claim(store, 100).await.is_none());
                }
            }
        }
        ended.insert(0, (job.id, DeliveryState::Waiting));
        assert_eq!(messages(store, &of_a).await, ended, "after {ending}");
    }
    let of_b = enqueue(store, &july).await;
    store.cancel_job(b.id, of_b.id, at(100)).await.unwrap();
    assert_eq!(messages(store, &of_a).await, ended);
    assert_eq!(messages(store, &all).await.len(), 6);
    assert!(messages(store, &strange).await.is_empty());

    assert!(store.delete_plant(a.id, at(101)).await.unwrap());
    assert_eq!(messages(store, &all).await, [(of_b.id, DeliveryState::Waiting)]);
    assert!(store.webhook(ORGANISATION, of_a.id).await.unwrap().is_none());
    assert!(store.delete_webhook(ORGANISATION, all.id).await.unwrap());
    assert!(messages(store, &all).await.is_empty());

    for _ in 0..100 {
        webhook(store, ORGANISATION, None).await;
    }
    let secret = SigningSecret::random().unwrap();
    let more = NewWebhook { organisation: ORGANISATION, plant: None, url: String::new(), secret };
    assert!(store.create_webhook(&more, at(0)).await.unwrap().is_none());
}

pub async fn messages_are_claimed_once_and_have_limited_attempts(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let webhook = webhook(store, ORGANISATION, None).await;
    let job = enqueue(store, &survey).await;
    assert!(store.claim_delivery(&[], LEASE, at(1)).await.unwrap().is_none());
    store.cancel_job(survey.plant, job.id, at(1)).await.unwrap();
    let take = async |now| store.claim_delivery(&[], LEASE, at(now)).await.unwrap();
    let first = take(1).await.unwrap();
    assert_eq!(
        (first.job.id, first.url.as_str(), first.secret.reveal()),
        (job.id, "https://example.org/", "0123456789abcdef")
    );
    assert!(take(30).await.is_none());
    // Whoever had it is taken for dead.
    let mut taken = take(31).await.unwrap();
    assert!(!store.end_delivery(&first, &Sent::Arrived, at(31)).await.unwrap());
    let failed = |seconds| Sent::Failed { error: "refused".to_owned(), at: at(seconds) };
    let mut now = 31;
    for attempts in 2..=8 {
        assert_eq!((taken.delivery.attempts, taken.delivery.attempts_left), (attempts, 8 - attempts));
        assert!(store.end_delivery(&taken, &failed(now + 10), at(now)).await.unwrap());
        now += 10;
        if attempts < 8 {
            assert!(take(now - 1).await.is_none());
            taken = take(now).await.unwrap();
        }
    }
    assert!(take(100_000).await.is_none());
    assert!(store.resend_delivery(webhook.id, taken.delivery.id, None, at(now)).await.unwrap().is_some());
    for _ in 0..8 {
        now += 31;
        take(now).await.unwrap();
    }
    // Whoever tried the last time died; the next one tries once more, and then it is given up.
    now += 31;
    taken = take(now).await.unwrap();
    assert_eq!((taken.delivery.attempts, taken.delivery.attempts_left), (17, 0));
    assert!(store.end_delivery(&taken, &failed(now + 10), at(now)).await.unwrap());
    assert!(take(100_000).await.is_none());
    let dead = store.deliveries(webhook.id, Some(DeliveryState::Dead), ALL).await.unwrap();
    assert_eq!((dead.len(), dead[0].attempts, dead[0].error.as_deref()), (1, 17, Some("refused")));
    assert!(store.deliveries(webhook.id, Some(DeliveryState::Waiting), ALL).await.unwrap().is_empty());

    let refused = WebhookId(Uuid::nil());
    assert!(store.resend_delivery(refused, dead[0].id, None, at(1000)).await.unwrap().is_none());
    let waiting = store.resend_delivery(webhook.id, dead[0].id, None, at(1000)).await.unwrap().unwrap();
    assert_eq!((waiting.state, waiting.finished), (DeliveryState::Waiting, None));
    let again = take(1000).await.unwrap();
    assert_eq!(again.delivery.attempts, 18);
    assert!(store.end_delivery(&again, &Sent::Arrived, at(1001)).await.unwrap());
    assert!(!store.end_delivery(&again, &failed(1100), at(1002)).await.unwrap());
    let arrived = store.deliveries(webhook.id, Some(DeliveryState::Delivered), ALL).await.unwrap();
    assert_eq!((arrived[0].finished, &arrived[0].error), (Some(at(1001)), &None));
    // Asked for twice under one identifier, it is sent again once.
    let once = Some(Uuid::new_v4());
    let resend = async |now| store.resend_delivery(webhook.id, dead[0].id, once, at(now)).await.unwrap().unwrap().state;
    assert_eq!(resend(1000).await, DeliveryState::Waiting);
    let again = take(1000).await.unwrap();
    assert!(store.end_delivery(&again, &Sent::Arrived, at(1001)).await.unwrap());
    assert_eq!(resend(1001).await, DeliveryState::Delivered);
    store.forget_old_deliveries(at(1001)).await.unwrap();
    assert_eq!(messages(store, &webhook).await.len(), 1);
    store.forget_old_deliveries(at(1002)).await.unwrap();
    assert!(messages(store, &webhook).await.is_empty());
}

pub async fn busy_organisations_do_not_delay_messages_of_others(store: &dyn Store) {
    let (Created::New(other) | Created::Existing(other)) = store.create_organisation("other", at(0)).await.unwrap();
    let other = other.id;
    let (Created::New(theirs) | Created::Existing(theirs)) =
        store.create_plant(other, "A", Quotas::default(), at(0)).await.unwrap();
    let ours = plant(store, "A").await;
    for (organisation, plant, ended) in [(ORGANISATION, ours.id, 1), (other, theirs.id, 2)] {
        webhook(store, organisation, None).await;
        let job = enqueue(store, &survey(store, plant, "June").await).await;
        store.cancel_job(plant, job.id, at(ended)).await.unwrap();
    }
    let take = async |busy: &[OrganisationId]| store.claim_delivery(busy, LEASE, at(3)).await.unwrap();
    assert!(take(&[ORGANISATION, other]).await.is_none());
    assert_eq!(take(&[ORGANISATION]).await.unwrap().organisation, other);
    assert_eq!(take(&[other]).await.unwrap().organisation, ORGANISATION);
}
