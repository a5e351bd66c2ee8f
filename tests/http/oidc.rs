//! Tokens of an identity provider: a real one on loopback with keys of every kind that is taken, and tokens of every kind that
//! is not.

use crate::app::{App, assert_problem, json_of};
use axum::Router;
use axum::extract::State;
use axum::routing::get;
use base64::Engine;
use base64::prelude::BASE64_URL_SAFE_NO_PAD;
use heliomap::oidc::keys::Ages;
use heliomap::oidc::{Oidc, OidcError, OidcSettings, OrganisationRule};
use heliomap::store::Scope;
use reqwest::{Method, StatusCode};
use ring::rand::SystemRandom;
use ring::signature::{
    ECDSA_P256_SHA256_FIXED_SIGNING, EcdsaKeyPair, Ed25519KeyPair, KeyPair, RSA_PKCS1_SHA256, RsaKeyPair,
};
use serde_json::{Value, json};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

const AUDIENCE: &str = "heliomap";

/// RSA keys of 2048 bits, PKCS #8, made for these tests: they open nothing.
const RSA_OF_PROVIDER: &[u8] = include_bytes!("../fixtures/oidc/rsa-provider.der");
const RSA_OF_STRANGER: &[u8] = include_bytes!("../fixtures/oidc/rsa-stranger.der");

enum Key {
    Rsa(RsaKeyPair),
    Ec(EcdsaKeyPair),
    Ed(Ed25519KeyPair),
}

fn b64(bytes: impl AsRef<[u8]>) -> String {
    BASE64_URL_SAFE_NO_PAD.encode(bytes)
}

impl Key {
    fn rsa(document: &[u8]) -> Self {
        Self::Rsa(RsaKeyPair::from_pkcs8(document).unwrap())
    }

    fn ec() -> Self {
        let random = SystemRandom::new();
        let document = EcdsaKeyPair::generate_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, &random).unwrap();
        Self::Ec(EcdsaKeyPair::from_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, document.as_ref(), &random).unwrap())
    }

    fn ed() -> Self {
        let document = Ed25519KeyPair::generate_pkcs8(&SystemRandom::new()).unwrap();
        Self::Ed(Ed25519KeyPair::from_pkcs8(document.as_ref()).unwrap())
    }

    fn algorithm(&self) -> &'static str {
        match self {
            Self::Rsa(_) => "RS256",
            Self::Ec(_) => "ES256",
            Self::Ed(_) => "EdDSA",
        }
    }

    /// As the provider shows it.
    fn jwk(&self, id: &str) -> Value {
        match self {
            Self::Rsa(pair) => {
                let public = ring::signature::RsaPublicKeyComponents::<Vec<u8>>::from(pair.public());
                json!({"kty": "RSA", "kid": id, "use": "sig", "alg": "RS256", "n": b64(public.n), "e": b64(public.e)})
            }
            Self::Ec(pair) => {
                let (x, y) = pair.public_key().as_ref()[1..].split_at(32);
                json!({"kty": "EC", "kid": id, "use": "sig", "crv": "P-256", "x": b64(x), "y": b64(y)})
            }
            Self::Ed(pair) => json!({"kty": "OKP", "kid": id, "crv": "Ed25519", "x": b64(pair.public_key().as_ref())}),
        }
    }

    fn sign(&self, message: &[u8]) -> Vec<u8> {
        let random = SystemRandom::new();
        match self {
            Self::Rsa(pair) => {
                let mut signature = vec![0; pair.public().modulus_len()];
                pair.sign(&RSA_PKCS1_SHA256, &random, message, &mut signature).unwrap();
                signature
            }
            Self::Ec(pair) => pair.sign(&random, message).unwrap().as_ref().to_vec(),
            Self::Ed(pair) => pair.sign(message).as_ref().to_vec(),
        }
    }

    /// A token that says so.
    fn token(&self, id: &str, claims: &Value) -> String {
        let header = json!({"alg": self.algorithm(), "kid": id, "typ": "JWT"});
        let signed = format!("{}.{}", b64(header.to_string()), b64(claims.to_string()));
        format!("{signed}.{}", b64(self.sign(signed.as_bytes())))
    }
}

/// The provider: what it shows, and how often it was asked.
#[derive(Clone, Default)]
struct Provider {
    keys: Arc<Mutex<Vec<Value>>>,
    issuer: Arc<Mutex<String>>,
    asked: Arc<AtomicUsize>,
    /// Whether it takes connections and says nothing.
    silent: Arc<AtomicBool>,
}

impl Provider {
    async fn new(keys: Vec<Value>) -> Self {
        let provider = Self { keys: Arc::new(Mutex::new(keys)), ..Self::default() };
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        *provider.issuer.lock().unwrap() = format!("http://{}", listener.local_addr().unwrap());
        let discovery = async |State(provider): State<Self>| {
            if provider.silent.load(Ordering::Relaxed) {
                std::future::pending::<()>().await;
            }
            let issuer = provider.issuer();
            axum::Json(json!({"issuer": issuer, "jwks_uri": format!("{issuer}/keys"), "response_types_supported": []}))
        };
        let keys = async |State(provider): State<Self>| {
            provider.asked.fetch_add(1, Ordering::Relaxed);
            let keys = provider.keys.lock().unwrap().clone();
            axum::Json(json!({"keys": keys}))
        };
        let app = Router::new().route("/.well-known/openid-configuration", get(discovery)).route("/keys", get(keys));
        let app = app.with_state(provider.clone());
        tokio::spawn(async move { axum::serve(listener, app).await });
        provider
    }

    fn issuer(&self) -> String {
        self.issuer.lock().unwrap().clone()
    }

    fn oidc(&self, min_refresh: Duration) -> Oidc {
        self.oidc_with(Ages::with_min_refresh(min_refresh))
    }

    fn oidc_with(&self, ages: Ages) -> Oidc {
        let word = |scope: Scope| (format!("heliomap:{scope}"), scope);
        Oidc::new(OidcSettings {
            issuer: self.issuer(),
            audience: AUDIENCE.to_owned(),
            organisation: OrganisationRule::Claim("organisation".to_owned()),
            scope_claim: "scope".to_owned(),
            scopes: Scope::ALL.into_iter().map(word).collect(),
            ages,
        })
        .unwrap()
    }

    /// The claims of a token that is good.
    fn claims(&self) -> Value {
        let now = jiff::Timestamp::now().as_second();
        json!({
            "iss": self.issuer(), "aud": [AUDIENCE, "other"], "sub": "pilot-7", "exp": now + 600, "nbf": now - 5,
            "organisation": "owner", "scope": "openid heliomap:upload heliomap:read",
        })
    }
}

async fn ask(app: &App, token: &str) -> (StatusCode, Value) {
    json_of(app.client.get(format!("{}/api/v1/plants", app.base)).bearer_auth(token).send().await.unwrap()).await
}

#[tokio::test]
async fn who_shows_a_good_token_is_let_in_as_its_claims_say() {
    let keys = [Key::rsa(RSA_OF_PROVIDER), Key::ec(), Key::ed()];
    let provider = Provider::new(keys.iter().zip(["r", "e", "d"]).map(|(key, id)| key.jwk(id)).collect()).await;
    let app = App::with_oidc(provider.oidc(Duration::from_secs(60))).await;
    // There is no such organisation yet.
    let token = keys[0].token("r", &provider.claims());
    assert_problem(ask(&app, &token).await, 403, "forbidden", "`owner`");
    let admin = app.key("owner", &[Scope::Admin], None).await;
    for (key, id) in keys.iter().zip(["r", "e", "d"]) {
        let (status, plants) = ask(&app, &key.token(id, &provider.claims())).await;
        assert_eq!(status, StatusCode::OK, "{}: {plants}", key.algorithm());
    }
    assert_eq!(provider.asked.load(Ordering::Relaxed), 1);

    let create = app.client.post(format!("{}/api/v1/plants", app.base)).bearer_auth(&token);
    assert_eq!(create.json(&json!({"name": "Sunfield"})).send().await.unwrap().status(), StatusCode::CREATED);
    let (_, plants) = ask(&app, &admin).await;
    assert_eq!(plants["items"][0]["name"], "Sunfield", "a key of the organisation goes on to open it");
    let keys_path = format!("{}/api/v1/keys", app.base);
    let refused = app.client.get(&keys_path).bearer_auth(&token).send().await.unwrap();
    assert_problem(json_of(refused).await, 403, "forbidden", "admin");
    // The log names who it was.
    let log = app.client.get(format!("{}/api/v1/audit", app.base)).bearer_auth(&admin).send().await.unwrap();
    let (_, log) = json_of(log).await;
    assert_eq!((&log["items"][0]["subject"], &log["items"][0]["status"]), (&json!("pilot-7"), &json!(403)), "{log}");
    assert_eq!((&log["items"][1]["subject"], &log["items"][1]["status"]), (&json!("pilot-7"), &json!(201)), "{log}");
    assert!(log["items"][0].get("key").is_none(), "{log}");
}

#[tokio::test]
async fn every_other_token_lets_nobody_in() {
    let (rsa, ec) = (Key::rsa(RSA_OF_PROVIDER), Key::ec());
    let provider = Provider::new(vec![rsa.jwk("r"), ec.jwk("e")]).await;
    let app = App::with_oidc(provider.oidc(Duration::from_secs(60))).await;
    app.key("owner", &[Scope::Admin], None).await;
    let good = provider.claims();
    assert_eq!(ask(&app, &rsa.token("r", &good)).await.0, StatusCode::OK);
    let now = jiff::Timestamp::now().as_second();
    let with = |name: &str, value: Value| {
        let mut claims = good.clone();
        claims[name] = value;
        rsa.token("r", &claims)
    };
    let without = |name: &str| {
        let mut claims = good.clone();
        claims.as_object_mut().unwrap().remove(name);
        rsa.token("r", &claims)
    };
    let forged = |alg: &str, signature: &dyn Fn(&[u8]) -> Vec<u8>| {
        let signed = format!("{}.{}", b64(json!({"alg": alg, "kid": "r"}).to_string()), b64(good.to_string()));
        format!("{signed}.{}", b64(signature(signed.as_bytes())))
    };
    // Whoever takes the public key for a shared secret.
    let public = match &rsa {
        Key::Rsa(pair) => pair.public().as_ref().to_vec(),
        _ => unreachable!("it is an RSA key"),
    };
    let by_public_key = |message: &[u8]| {
        let key = ring::hmac::Key::new(ring::hmac::HMAC_SHA256, &public);
        ring::hmac::sign(&key, message).as_ref().to_vec()
    };
    let mut changed = rsa.token("r", &good);
    let at = changed.find('.').unwrap() + 5;
    let other = if &changed[at..=at] == "A" { "B" } else { "A" };
    changed.replace_range(at..=at, other);
    for (token, names) in [
        (with("iss", json!("https://evil.example.org")), "is not of http://"),
        (with("aud", json!("another")), "is not for heliomap"),
        (with("exp", json!(now - 60)), "has expired"),
        (with("nbf", json!(now + 60)), "is not valid yet"),
        (with("sub", json!("")), "names no subject"),
        (with("organisation", json!(7)), "names no organisation"),
        (without("exp"), "lacks the claim exp"),
        (without("iss"), "lacks the claim iss"),
        (without("aud"), "lacks the claim aud"),
        (without("sub"), "lacks the claim sub"),
        (forged("none", &|_| Vec::new()), "cannot be read"),
        (forged("HS256", &by_public_key), "is not signed by RS256"),
        (forged("PS256", &|message| rsa.sign(message)), "is not signed by RS256"),
        (forged("ES256", &|message| ec.sign(message)), "a key that the provider does not publish"),
        (rsa.token("e", &good), "a key that the provider does not publish"),
        (rsa.token("unknown", &good), "a key that the provider does not publish"),
        (Key::rsa(RSA_OF_STRANGER).token("r", &good), "an invalid signature"),
        (changed, "the token"),
        ("a.b.c".to_owned(), "cannot be read"),
        (format!("{}.b.c", "a".repeat(20_000)), "longer than"),
    ] {
        assert_problem(ask(&app, &token).await, 401, "unauthorized", names);
    }
    // Unknown keys asked for one look at most.
    assert!(provider.asked.load(Ordering::Relaxed) <= 2);
    let challenge = app.client.get(format!("{}/api/v1/plants", app.base)).bearer_auth(with("exp", json!(1))).send();
    let challenge = challenge.await.unwrap();
    assert_eq!(challenge.headers()["www-authenticate"], "Bearer");
}

#[tokio::test]
async fn new_keys_are_fetched_when_they_are_shown_and_not_too_often() {
    let (old, new) = (Key::ed(), Key::ed());
    let provider = Provider::new(vec![old.jwk("1")]).await;
    let oidc = provider.oidc(Duration::from_millis(300));
    assert!(oidc.bearer(&old.token("1", &provider.claims())).await.is_ok());
    provider.keys.lock().unwrap().push(new.jwk("2"));
    // Within the time between two fetches nobody is asked, whatever comes.
    for id in 0..50 {
        assert!(oidc.bearer(&old.token(&format!("x{id}"), &provider.claims())).await.is_err());
    }
    let asked = provider.asked.load(Ordering::Relaxed);
    assert!(asked <= 2, "{asked}");
    tokio::time::sleep(Duration::from_millis(310)).await;
    assert_eq!(oidc.bearer(&new.token("2", &provider.claims())).await.unwrap().subject, "pilot-7");
    assert!(oidc.bearer(&old.token("1", &provider.claims())).await.is_ok());
}

#[tokio::test]
async fn a_provider_that_falls_silent_keeps_nobody_waiting_and_its_keys_hold_for_a_while() {
    let key = Key::ed();
    let provider = Provider::new(vec![key.jwk("1")]).await;
    let (claims, wait) = (provider.claims(), Duration::from_secs(2));
    let old = Ages { min_refresh: Duration::ZERO, fresh: Duration::ZERO, max: Duration::from_secs(3600) };
    let oidc = provider.oidc_with(old);
    assert!(oidc.bearer(&key.token("1", &claims)).await.is_ok());
    provider.silent.store(true, Ordering::Relaxed);
    for _ in 0..20 {
        let answer = tokio::time::timeout(wait, oidc.bearer(&key.token("1", &claims))).await;
        assert!(answer.expect("nobody waits for the provider").is_ok());
    }

    provider.silent.store(false, Ordering::Relaxed);
    let max = Duration::from_secs(1);
    let oidc = provider.oidc_with(Ages { max, ..old });
    assert!(oidc.bearer(&key.token("1", &claims)).await.is_ok());
    *provider.issuer.lock().unwrap() = "http://127.0.0.1:9".to_owned();
    assert!(oidc.bearer(&key.token("1", &claims)).await.is_ok());
    tokio::time::sleep(max).await;
    let error = oidc.bearer(&key.token("1", &claims)).await.unwrap_err();
    assert!(matches!(error, OidcError::Unavailable(_)), "{error}");
}

#[tokio::test]
async fn a_provider_that_cannot_be_asked_is_no_fault_of_the_caller() {
    let key = Key::ed();
    let provider = Provider::new(Vec::new()).await;
    let claims = provider.claims();
    let oidc = provider.oidc(Duration::from_secs(60));
    // It says that it is another.
    *provider.issuer.lock().unwrap() = "http://127.0.0.1:9".to_owned();
    let app = App::with_oidc(oidc).await;
    assert_problem(ask(&app, &key.token("1", &claims)).await, 503, "unavailable", "identity provider");
    let secret = app.key("owner", &[Scope::Read], None).await;
    assert_eq!(ask(&app, &secret).await.0, StatusCode::OK);
    let silent = app.client.request(Method::GET, format!("{}/api/v1/plants", app.base)).send().await.unwrap();
    assert_eq!(silent.status(), StatusCode::UNAUTHORIZED);
}
