//! Organisations, their keys, and the audit log.

use super::digest::Digest;
use super::error::StoreError;
use super::ids::{KeyId, OrganisationId};
use super::listing::{Created, Page, TimeSpan};
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;

/// What a key permits.
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

/// An owner of plants and keys. Organisations never see each other's.
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
    /// The beginning of its secret, by which people recognise it.
    pub prefix: String,
    pub scopes: BTreeSet<Scope>,
    /// The plants that it gives access to; `None` for all of the organisation's.
    pub plants: Option<Vec<PlantId>>,
    pub created: Timestamp,
    pub expires: Option<Timestamp>,
    pub revoked: Option<Timestamp>,
    /// Exact to a minute.
    pub last_used: Option<Timestamp>,
}

/// What is stored of a secret.
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

/// A request that changed something, or tried to.
#[derive(Debug, Clone)]
pub struct AuditEntry {
    pub organisation: OrganisationId,
    pub at: Timestamp,
    /// Identifier and name of the key that was used.
    pub key: Option<(KeyId, String)>,
    /// The subject of the token that was used.
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
    /// Creates an organisation, or returns the existing one of that name.
    async fn create_organisation(&self, name: &str, now: Timestamp) -> Result<Created<Organisation>, StoreError>;

    /// The organisation of a name.
    async fn organisation(&self, name: &str) -> Result<Option<Organisation>, StoreError>;

    /// Stores a key.
    async fn create_key(&self, key: &NewKey, now: Timestamp) -> Result<ApiKey, StoreError>;
    /// One key of an organisation, even if revoked or expired.
    async fn key(&self, organisation: OrganisationId, id: KeyId) -> Result<Option<ApiKey>, StoreError>;
    /// Keys of one organisation or of all that were created within a time span, in order of creation, including revoked and
    /// expired ones.
    async fn keys(
        &self,
        organisation: Option<OrganisationId>,
        made: TimeSpan,
        page: Page,
    ) -> Result<Vec<ApiKey>, StoreError>;
    /// The key with this secret that is valid now.
    async fn key_of_secret(&self, sha256: Digest, now: Timestamp) -> Result<Option<ApiKey>, StoreError>;
    /// Revokes a key; where `prefix` is given, only while its secret begins so.
    async fn revoke_key(
        &self,
        organisation: OrganisationId,
        id: KeyId,
        prefix: Option<&str>,
        now: Timestamp,
    ) -> Result<Option<ApiKey>, StoreError>;
    /// Gives a key that is not revoked a new secret; where `prefix` is given, only while its secret begins so. The previous
    /// secret stays valid until `previous_until`.
    async fn rotate_key(
        &self,
        organisation: OrganisationId,
        id: KeyId,
        prefix: Option<&str>,
        secret: &SecretRecord,
        previous_until: Timestamp,
    ) -> Result<Option<ApiKey>, StoreError>;
    /// Records that a key was used.
    async fn key_used(&self, id: KeyId, now: Timestamp) -> Result<(), StoreError>;

    /// Adds to the audit log.
    async fn record(&self, entry: &AuditEntry) -> Result<(), StoreError>;
    /// Deletes entries of the audit log from before a time.
    async fn forget_audit(&self, before: Timestamp) -> Result<(), StoreError>;
    /// An organisation's audit log within a time span, newest first, each entry with its sequence number.
    async fn audit(
        &self,
        organisation: OrganisationId,
        within: TimeSpan,
        page: Page,
    ) -> Result<Vec<(i64, AuditEntry)>, StoreError>;
}
