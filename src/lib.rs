//! heliomap maps photovoltaic plants from drone overview photos.
//!
//! Each room may use what stands before it in this list, never what comes after: `geometry`, `reconstruction`,
//! `detection`, `layout`, `fusion`, `refinement`, `plant`, `pipeline`; then `store` and `jobs`; then `http`.
//! `simulator` stands aside: it invents plants, photos and reconstructions for tests and benchmarks.

pub mod detection;
pub mod geometry;
pub mod pipeline;
pub mod plant;
pub mod reconstruction;
pub mod simulator;
