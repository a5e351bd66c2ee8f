//! Identifiers of rows.

use std::fmt;
use uuid::Uuid;

macro_rules! row_id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
        #[serde(transparent)]
        pub struct $name(pub Uuid);

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(f)
            }
        }
    };
}

row_id!(
    /// Identifies an organisation: an owner of plants and keys.
    OrganisationId
);

impl OrganisationId {
    /// The organisation that always exists.
    pub const DEFAULT: Self = Self(Uuid::nil());
}

row_id!(
    /// Identifies a key, independent of its current secret.
    KeyId
);

row_id!(
    /// Identifies a survey: one flight over a plant.
    SurveyId
);

row_id!(
    /// Identifies a job: one mapping of a survey.
    JobId
);

row_id!(
    /// Identifies an upload that may be resumed.
    UploadId
);

row_id!(
    /// Identifies a webhook: a URL that is notified when jobs end.
    WebhookId
);

row_id!(
    /// Identifies a delivery: one message to one webhook.
    DeliveryId
);
