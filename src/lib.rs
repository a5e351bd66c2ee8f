//! heliomap maps photovoltaic plants from drone overview photos.
//!
//! Each room may use what stands before it in this list, never what comes after: `geometry`, `reconstruction`,
//! `detection`, `layout`, `fusion`, `refinement`, `plant`, `pipeline`; then `store`, `jobs`, `webhooks` and `oidc`; then `http`. `overlay`
//! and `evaluation` look at what the pipeline made; `simulator` makes plants with known truth for tests and benchmarks.

#![allow(clippy::duplicate_mod, reason = "the store's methods are compiled once beside each database")]

pub mod config;
pub mod detection;
pub mod evaluation;
pub mod fusion;
pub mod geometry;
pub mod http;
pub mod jobs;
pub mod layout;
pub mod oidc;
pub mod overlay;
pub mod pipeline;
pub mod plant;
pub mod reconstruction;
pub mod refinement;
pub mod simulator;
pub mod store;
pub mod telemetry;
pub mod tls;
pub mod webhooks;
