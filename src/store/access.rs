//! Who may do what: organisations, their keys, and the log of what was done.

use super::records::row_id;
use super::{Created, Digest, Page, StoreError, TimeSpan};
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;
use uuid::Uuid;

row_id!(
    /// Identifies an organisation: who owns plants and keys.
    OrganisationId
);
row_id!(
    /// Identifies a key, whatever its secret is at the moment.
    KeyId
);

impl OrganisationId {
    /// The organisation that is always there.
    pub const DEFAULT: Self = Self(Uuid::nil());
}

/// What a key is good for.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    serde::Serialize,
    serde::Deserialize,
    utoipa::ToSchema,
    clap::ValueEnum,
)]
#[serde(rename_all = "lowercase")]
pub enum Scope {
    /// Create plants and surveys, upload to them, start and cancel jobs; see how they stand.
    Upload,
    /// See everything.
    Read,
    /// See everything and correct what was found.
    Review,
    /// Everything, keys and deletion included.
    Admin,
}

impl Scope {
    /// All scopes.
    pub const ALL: [Self; 4] = [Self::Upload, Self::Read, Self::Review, Self::Admin];

    /// The word in rows, answers and the API's description.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Upload => "upload",
            Self::Read => "read",
            Self::Review => "review",
            Self::Admin => "admin",
        }
    }
}

impl fmt::Display for Scope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for Scope {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        Self::ALL.into_iter().find(|scope| scope.as_str() == text).ok_or(())
    }
}

/// Who owns plants and keys. Organisations never see each other's.
#[derive(Debug, Clone)]
pub struct Organisation {
    pub id: OrganisationId,
    pub name: String,
    pub created: Timestamp,
}

/// A key, without its secret.
#[derive(Debug, Clone)]
pub struct ApiKey {
    pub seq: i64,
    pub id: KeyId,
    pub organisation: OrganisationId,
    pub name: String,
    /// How its secret begins, for people to know it by.
    pub prefix: String,
    pub scopes: BTreeSet<Scope>,
    /// The plants that it is good for; all of the organisation's where there is no list.
    pub plants: Option<Vec<PlantId>>,
    pub created: Timestamp,
    pub expires: Option<Timestamp>,
    pub revoked: Option<Timestamp>,
    /// Exact to a minute.
    pub last_used: Option<Timestamp>,
}

/// What is kept of a secret.
#[derive(Debug, Clone)]
pub struct SecretRecord {
    pub sha256: Digest,
    pub prefix: String,
}

/// A key to be stored.
#[derive(Debug, Clone)]
pub struct NewKey {
    pub organisation: OrganisationId,
    pub name: String,
    pub secret: SecretRecord,
    pub scopes: BTreeSet<Scope>,
    pub plants: Option<Vec<PlantId>>,
    pub expires: Option<Timestamp>,
}

/// Something that was done, or tried.
#[derive(Debug, Clone)]
pub struct AuditEntry {
    pub organisation: OrganisationId,
    pub at: Timestamp,
    /// The key that it was done with, and what that was called; none where it was done without one.
    pub key: Option<(KeyId, String)>,
    /// Whose token it was done with.
    pub subject: Option<String>,
    pub method: String,
    pub path: String,
    /// The HTTP status of the answer.
    pub status: u16,
    pub request_id: String,
}

/// Organisations, keys and the audit log.
#[async_trait::async_trait]
pub trait AccessStore: Send + Sync + 'static {
    /// Creates an organisation, or finds the one of that name.
    async fn create_organisation(&self, name: &str, now: Timestamp) -> Result<Created<Organisation>, StoreError>;

    /// The organisation of a name.
    async fn organisation(&self, name: &str) -> Result<Option<Organisation>, StoreError>;

    /// Stores a key.
    async fn create_key(&self, key: &NewKey, now: Timestamp) -> Result<ApiKey, StoreError>;
    /// One key of an organisation, revoked and expired ones included.
    async fn key(&self, organisation: OrganisationId, id: KeyId) -> Result<Option<ApiKey>, StoreError>;
    /// An organisation's keys, or everyone's, that were made within a time, in the order of their creation, revoked and
    /// expired ones included.
    async fn keys(
        &self,
        organisation: Option<OrganisationId>,
        made: TimeSpan,
        page: Page,
    ) -> Result<Vec<ApiKey>, StoreError>;
    /// The key with this secret that is good now.
    async fn key_of_secret(&self, sha256: Digest, now: Timestamp) -> Result<Option<ApiKey>, StoreError>;
    /// Makes a key good for nothing, for ever; where it is said, only while its secret is the one that begins so.
    async fn revoke_key(
        &self,
        organisation: OrganisationId,
        id: KeyId,
        prefix: Option<&str>,
        now: Timestamp,
    ) -> Result<Option<ApiKey>, StoreError>;
    /// Gives a key that is not revoked a new secret, where it is said only while its secret is the one that begins so; the
    /// one before stays good until a time.
    async fn rotate_key(
        &self,
        organisation: OrganisationId,
        id: KeyId,
        prefix: Option<&str>,
        secret: &SecretRecord,
        previous_until: Timestamp,
    ) -> Result<Option<ApiKey>, StoreError>;
    /// Notes that a key was used.
    async fn key_used(&self, id: KeyId, now: Timestamp) -> Result<(), StoreError>;

    /// Adds to the audit log.
    async fn record(&self, entry: &AuditEntry) -> Result<(), StoreError>;
    /// Forgets what the audit log holds of before a time.
    async fn forget_audit(&self, before: Timestamp) -> Result<(), StoreError>;
    /// An organisation's audit log of a time, the newest first, each entry with its sequence number.
    async fn audit(
        &self,
        organisation: OrganisationId,
        within: TimeSpan,
        page: Page,
    ) -> Result<Vec<(i64, AuditEntry)>, StoreError>;
}
