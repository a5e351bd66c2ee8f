//! The service: what is stored, the jobs that map, webhooks, identity providers, and the HTTP API. The mapping itself is the
//! library `heliomap_mapping`, the model `heliomap_model`; both stand below and know nothing of this crate.
//!
//! `store` stands below `jobs`, `webhooks` and `oidc`, and these below `http`.

#![allow(clippy::duplicate_mod, reason = "the store's methods are compiled once beside each database")]

pub mod config;
pub mod http;
pub mod jobs;
pub mod oidc;
pub mod store;
pub mod telemetry;
pub mod tls;
pub mod webhooks;
