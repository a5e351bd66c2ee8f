//! The HTTP API and the web page. `router.rs` is the table of contents; the interface is described by `/openapi.yaml`.

pub mod error;
pub mod router;
pub mod state;

mod controllers;
mod description;
mod extract;
mod middleware;
mod paging;
mod server;
mod turns;
mod uploads;
mod writable;

pub use middleware::rates::Rates;
pub use router::{openapi, router};
pub use server::serve;
pub use state::AppState;
pub use turns::Turns;
pub use uploads::tus::Desk;
pub use writable::Writable;
