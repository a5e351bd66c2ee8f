//! The HTTP API in process: real store, real worker, a mapper that does as it is told.

mod access;
mod app;
#[path = "../common/boxes.rs"]
mod boxes;
mod broken;
mod conditions;
mod contract;
mod deletion;
mod idempotency;
mod images;
mod jobs;
mod limits;
mod models;
mod oidc;
mod plants;
mod quotas;
mod reconstruction;
mod replaced;
mod sharing;
mod stub;
mod tenants;
mod tus;
mod verdicts;
mod webhooks;
