//! The HTTP API and the web page. `router.rs` is the table of contents; the interface is described by `/openapi.yaml`.

pub mod error;
pub mod router;
pub mod state;

mod admission;
mod conditional;
mod docs;
mod encoding;
mod events;
mod examples;
mod extract;
mod features;
mod file_lists;
mod guard;
mod health;
mod idempotency;
mod images;
mod intake;
mod jobs;
mod keys;
mod loopback;
mod models;
mod page;
mod paging;
mod plants;
mod rates;
mod server;
mod surveys;
mod tus;
mod uploads;
mod usage;
mod webhooks;

pub use rates::Rates;
pub use router::{openapi, router};
pub use server::serve;
pub use state::AppState;
pub use tus::Desk;
