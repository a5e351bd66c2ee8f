//! Who may do what. Every request to a described operation passes here: what its `security` says in the API's description
//! is what is asked for, so that an operation that says nothing lets nobody in.

use crate::http::error::{ApiError, Code};
use crate::http::server::Peer;
use crate::http::state::AppState;
use crate::http::uploads::intake::receive::{drain, waits_to_be_asked};
use crate::oidc::{Oidc, OidcError};
use crate::store::{ApiKey, AuditEntry, Digest, KeyId, OrganisationId, Scope};
use axum::extract::{FromRequestParts, MatchedPath, RawPathParams, Request, State};
use axum::http::request::Parts;
use axum::http::{HeaderMap, Method, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use heliomap_model::PlantId;
use jiff::{SignedDuration, Timestamp};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::net::IpAddr;
use std::sync::Arc;
use tower_http::request_id::RequestId;
use tracing::Instrument;
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityScheme};
use utoipa::openapi::{ContentBuilder, OpenApi, Ref, ResponseBuilder};
use uuid::Uuid;

/// The name of the one way in, in the API's description.
const SCHEME: &str = "key";

/// How exact the time of a key's last use is.
const LAST_USE_GRAIN: SignedDuration = SignedDuration::from_mins(1);

/// How much of a request's path the audit log keeps, characters.
const MAX_NOTED_PATH: usize = 500;

/// Who sent a request.
#[derive(Debug, Clone)]
pub struct Caller {
    pub organisation: OrganisationId,
    /// The key and its name; none where the caller shows another thing, or nothing has to be shown.
    pub key: Option<(KeyId, String)>,
    /// Who it is by the identity provider's token.
    pub subject: Option<String>,
    /// Whose requests are counted together.
    pub counted: Option<KeyId>,
    pub scopes: BTreeSet<Scope>,
    /// The plants that the caller may see; all of the organisation's where there is no list.
    pub plants: Option<Vec<PlantId>>,
}

impl Caller {
    /// Whoever sends requests where the service asks for no keys.
    fn anyone() -> Self {
        let (organisation, scopes) = (OrganisationId::DEFAULT, BTreeSet::from([Scope::Admin]));
        Self { organisation, key: None, subject: None, counted: None, scopes, plants: None }
    }

    /// Refuses a caller whose key is for some plants only.
    pub fn require_all_plants(&self) -> Result<(), ApiError> {
        match self.plants {
            None => Ok(()),
            Some(_) => {
                Err(ApiError::new(Code::Forbidden, "this key is for some plants only; use one without that limit"))
            }
        }
    }

    fn may_see(&self, plant: PlantId) -> bool {
        self.plants.as_ref().is_none_or(|plants| plants.contains(&plant))
    }
}

impl From<ApiKey> for Caller {
    fn from(key: ApiKey) -> Self {
        Self {
            organisation: key.organisation,
            key: Some((key.id, key.name)),
            subject: None,
            counted: Some(key.id),
            scopes: key.scopes,
            plants: key.plants,
        }
    }
}

impl<S: Sync> FromRequestParts<S> for Caller {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, ApiError> {
        parts.extensions.get::<Self>().cloned().ok_or_else(unknown_caller)
    }
}

/// What an operation asks for.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Need {
    /// Open to everyone.
    Nothing,
    /// One of these scopes, or that of administrators.
    OneOf(BTreeSet<Scope>),
}

/// What every operation asks for, by path and method.
#[derive(Debug)]
pub struct Policy(HashMap<String, BTreeMap<String, Need>>);

impl Policy {
    /// Reads the policy out of the description.
    pub fn of(description: &OpenApi) -> Self {
        let document = serde_json::to_value(description).unwrap_or_default();
        let mut policy = HashMap::new();
        for (path, operations) in document["paths"].as_object().into_iter().flatten() {
            let needs: &mut BTreeMap<String, Need> = policy.entry(path.clone()).or_default();
            for (method, operation) in operations.as_object().into_iter().flatten() {
                let alternatives = operation["security"].as_array().into_iter().flatten();
                let names: Vec<_> = alternatives.map(|alternative| alternative[SCHEME].as_array()).collect();
                let need = match names.as_slice() {
                    [None] => Need::Nothing,
                    names => {
                        let words = names.iter().flatten().copied().flatten().filter_map(|word| word.as_str());
                        Need::OneOf(words.filter_map(|word| word.parse().ok()).collect())
                    }
                };
                needs.insert(method.to_ascii_uppercase(), need);
            }
        }
        Self(policy)
    }

    fn need(&self, method: &Method, path: &str) -> Result<&Need, ApiError> {
        let needs = self.0.get(path);
        let asked = |method: &Method| needs.and_then(|needs| needs.get(method.as_str()));
        asked(method).or_else(|| asked(&Method::GET).filter(|_| method == Method::HEAD)).ok_or_else(|| {
            let allowed: Vec<&str> = needs.into_iter().flatten().map(|(method, _)| method.as_str()).collect();
            ApiError::new(Code::MethodNotAllowed, format!("{path} takes {}", allowed.join(", ")))
                .with("allow", allowed.join(","))
        })
    }
}

/// Adds what the guard answers to the description of every operation that it guards.
pub fn describe(description: &mut OpenApi) {
    let components = description.components.get_or_insert_default();
    let scheme = HttpBuilder::new()
        .scheme(HttpAuthScheme::Bearer)
        .description(Some(
            "A key of this service, `Authorization: Bearer hm_…`, or a token of the identity provider that the service is \
             configured for. Each operation names the scopes that open it, of which one is enough; `admin` opens all.",
        ))
        .build();
    components.add_security_scheme(SCHEME, SecurityScheme::Http(scheme));
    let problem = |text: &str| {
        let content = ContentBuilder::new().schema(Some(Ref::from_schema_name("Problem"))).build();
        ResponseBuilder::new().description(text).content("application/problem+json", content).build()
    };
    for item in description.paths.paths.values_mut() {
        let operations =
            [&mut item.get, &mut item.put, &mut item.post, &mut item.delete, &mut item.patch, &mut item.head];
        for operation in operations.into_iter().flatten() {
            if operation.security.as_ref().is_some_and(|needs| needs.iter().all(|need| *need != Default::default())) {
                let responses = &mut operation.responses.responses;
                let unchecked = "`unavailable`: no token can be checked now; or another reason, as the code tells";
                responses.entry("503".to_owned()).or_insert_with(|| problem(unchecked).into());
                responses.insert("401".to_owned(), problem("`unauthorized`: no key, or none that is good").into());
                responses.insert("403".to_owned(), problem("`forbidden`: the key does not open this").into());
                responses
                    .insert("429".to_owned(), problem("`too_many_requests`: wait for `retry-after` seconds").into());
            }
        }
    }
}

/// What the guard knows.
#[derive(Clone)]
pub struct Gate {
    pub state: AppState,
    pub policy: Arc<Policy>,
}

/// Lets a request through, or says why not; notes in the audit log what changes something, or was refused.
pub async fn guard(
    State(gate): State<Gate>,
    path: MatchedPath,
    parameters: RawPathParams,
    mut request: Request,
    next: Next,
) -> Response {
    let need = match gate.policy.need(request.method(), path.as_str()) {
        Ok(Need::Nothing) => return next.run(request).await,
        Ok(Need::OneOf(scopes)) => scopes,
        Err(problem) => {
            let allow = problem.members["allow"].as_str().unwrap_or_default().to_owned();
            return ([(header::ALLOW, allow)], problem).into_response();
        }
    };
    let caller = gate.caller(request.headers()).await.map_err(|problem| gate.failed(&request, problem));
    let caller = match caller.and_then(|caller| gate.within_rate(caller)) {
        Ok(caller) => caller,
        Err(problem) => return refuse(request, problem).await,
    };
    let changes = !matches!(*request.method(), Method::GET | Method::HEAD);
    let mut entry = AuditEntry {
        organisation: caller.organisation,
        at: Timestamp::now(),
        key: caller.key.clone(),
        subject: caller.subject.clone(),
        method: request.method().to_string(),
        path: noted_path(request.uri().path()),
        status: 0,
        request_id: request_id(&request).to_owned(),
    };
    let allowed = gate.allow(&caller, need, &parameters).await;
    let noted = changes || (allowed.is_err() && gate.state.rates.refusal(caller.counted));
    let state = gate.state.clone();
    let answer = async move {
        let response = match allowed {
            Ok(()) => {
                request.extensions_mut().insert(caller);
                next.run(request).await
            }
            Err(problem) => refuse(request, problem).await,
        };
        if noted {
            entry.status = response.status().as_u16();
            if let Err(error) = state.store.record(&entry).await {
                tracing::error!(%error, ?entry, "the audit log cannot be written");
            }
        }
        response
    };
    if !changes {
        return answer.await;
    }
    // What began to change something comes to its end, and into the audit log, though the client hung up.
    let answered = gate.state.answering.spawn(answer.in_current_span()).await;
    answered.unwrap_or_else(|failure| match failure.try_into_panic() {
        Ok(panic) => std::panic::resume_unwind(panic),
        Err(failure) => ApiError::internal(&failure).into_response(),
    })
}

/// The path of a request as the audit log keeps it: no longer than any that leads somewhere.
fn noted_path(path: &str) -> String {
    match path.char_indices().nth(MAX_NOTED_PATH) {
        Some((end, _)) => format!("{}…", &path[..end]),
        None => path.to_owned(),
    }
}

impl Gate {
    /// Who sent a request with these headers.
    async fn caller(&self, headers: &HeaderMap) -> Result<Caller, ApiError> {
        if self.state.insecure {
            return Ok(Caller::anyone());
        }
        let bearer = headers.get(header::AUTHORIZATION).and_then(|value| value.to_str().ok()?.split_once(' '));
        let secret =
            bearer.filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer")).map(|(_, secret)| secret.trim());
        let now = Timestamp::now();
        if let (Some(oidc), Some(token)) = (&self.state.oidc, secret.filter(|secret| secret.contains('.'))) {
            return self.bearer(oidc, token).await;
        }
        let found = match secret {
            Some(secret) => self.state.store.key_of_secret(Digest::of(secret.as_bytes()), now).await?,
            None => None,
        };
        let key = found.ok_or_else(unknown_caller)?;
        if key.last_used.is_none_or(|last| now.duration_since(last) >= LAST_USE_GRAIN)
            && let Err(error) = self.state.store.key_used(key.id, now).await
        {
            tracing::warn!(%error, key = %key.id, "the key's last use cannot be noted");
        }
        Ok(key.into())
    }

    /// Who showed a token of the identity provider.
    async fn bearer(&self, oidc: &Oidc, token: &str) -> Result<Caller, ApiError> {
        let bearer = oidc.bearer(token).await.map_err(|error| match error {
            OidcError::Refused(_) => {
                ApiError::new(Code::Unauthorized, format!("{error}; ask the identity provider for a new one"))
            }
            OidcError::Unavailable(_) => ApiError::new(
                Code::Unavailable,
                "the identity provider's keys cannot be fetched, so that no token can be checked",
            )
            .retry_after(10),
        })?;
        let organisation = self.state.store.organisation(&bearer.organisation).await?.ok_or_else(|| {
            let detail = format!(
                "there is no organisation `{}`; whoever runs the service makes it with `heliomap organisations create`",
                bearer.organisation
            );
            ApiError::new(Code::Forbidden, detail)
        })?;
        let name = format!("{}#{}", oidc.issuer(), bearer.subject);
        Ok(Caller {
            organisation: organisation.id,
            key: None,
            counted: Some(KeyId(Uuid::new_v5(&Uuid::NAMESPACE_URL, name.as_bytes()))),
            subject: Some(bearer.subject),
            scopes: bearer.scopes,
            plants: None,
        })
    }

    /// What is said to a caller without a good key; who fails too often is told to wait.
    fn failed(&self, request: &Request, problem: ApiError) -> ApiError {
        let address = client_address(request, self.state.network.behind_proxy);
        match address {
            Some(address) if problem.code == Code::Unauthorized => {
                self.state.rates.failure(address).err().unwrap_or(problem)
            }
            _ => problem,
        }
    }

    /// A caller that does not ask too often.
    fn within_rate(&self, caller: Caller) -> Result<Caller, ApiError> {
        if let Some(counted) = caller.counted {
            self.state.rates.request(counted)?;
        }
        Ok(caller)
    }

    /// Whether a caller may do what asks for one of these scopes. What the caller may not see is not there.
    async fn allow(&self, caller: &Caller, need: &BTreeSet<Scope>, parameters: &RawPathParams) -> Result<(), ApiError> {
        for (name, value) in parameters {
            if name == "plant" {
                let plant: PlantId = value.parse().map_err(|_| {
                    ApiError::new(Code::NotFound, format!("`{value}` names no plant; identifiers are UUIDs"))
                })?;
                let owned = self.state.store.plant(plant).await?.filter(|p| p.organisation == caller.organisation);
                if owned.is_none() || !caller.may_see(plant) {
                    return Err(AppState::no_plant(plant));
                }
            }
        }
        if caller.scopes.contains(&Scope::Admin) || !caller.scopes.is_disjoint(need) {
            return Ok(());
        }
        Err(ApiError::new(Code::Forbidden, lacking(need)))
    }
}

/// What is said to a key that has none of these scopes.
fn lacking(need: &BTreeSet<Scope>) -> String {
    let others = need.iter().filter(|scope| **scope != Scope::Admin).map(|scope| scope.as_str());
    let words: Vec<&str> = others.chain([Scope::Admin.as_str()]).collect();
    match words.as_slice() {
        [only] => format!("this takes a key with the scope {only}"),
        words => format!("this takes a key with one of the scopes {}", words.join(", ")),
    }
}

/// Where a request comes from. A proxy in front appends the address that it was asked from to `x-forwarded-for`: what
/// stands before that anyone may have written.
fn client_address(request: &Request, behind_proxy: bool) -> Option<IpAddr> {
    let told = request.headers().get_all("x-forwarded-for").iter().next_back();
    let told = told.and_then(|value| value.to_str().ok()?.rsplit(',').next()?.trim().parse().ok());
    let peer = request.extensions().get::<Peer>().map(|peer| peer.0.ip());
    if behind_proxy { told.or(peer) } else { peer }
}

/// Answers a problem, once what the client is sending was taken off the line within reason; one that waits to be asked is
/// not.
pub async fn refuse(request: Request, problem: ApiError) -> Response {
    if !waits_to_be_asked(request.headers()) {
        drain(request.into_body().into_data_stream(), &problem).await;
    }
    let challenge = (problem.code == Code::Unauthorized).then_some([(header::WWW_AUTHENTICATE, "Bearer")]);
    (challenge, problem).into_response()
}

fn unknown_caller() -> ApiError {
    ApiError::new(
        Code::Unauthorized,
        "send a key that is neither expired nor revoked as `authorization: Bearer hm_…`; an administrator of yours makes one \
         with POST /api/v1/keys, whoever runs the service makes the first with `heliomap keys create`",
    )
}

/// What the request is called in the log.
pub fn request_id(request: &Request) -> &str {
    request.extensions().get::<RequestId>().and_then(|id| id.header_value().to_str().ok()).unwrap_or("")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::http::openapi;

    #[test]
    fn scopes_are_named_once() {
        assert_eq!(lacking(&BTreeSet::from([Scope::Admin])), "this takes a key with the scope admin");
        let several = lacking(&BTreeSet::from([Scope::Read, Scope::Admin]));
        assert_eq!(several, "this takes a key with one of the scopes read, admin");
    }

    #[test]
    fn only_what_says_nothing_of_anyone_is_open() {
        let policy = Policy::of(&openapi());
        let mut open: Vec<&str> = Vec::new();
        for (path, needs) in &policy.0 {
            for need in needs.values() {
                match need {
                    Need::Nothing => open.push(path),
                    Need::OneOf(scopes) => assert!(!scopes.is_empty(), "{path} says not who may use it"),
                }
            }
        }
        open.sort();
        assert_eq!(
            open,
            ["/api/v1/plants/{plant}/surveys/{survey}/uploads", "/health", "/openapi.json", "/openapi.yaml", "/ready"]
        );
    }
}
