//! heliomap maps photovoltaic plants from drone overview photos.
//!
//! Each room may use what stands before it in this list, never what comes after: `geometry`, `reconstruction`,
//! `detection`, `layout`, `fusion`, `refinement`, `plant`, `evaluation`, `pipeline`; then `store` and `jobs`; then
//! `http`.

pub mod detection;
pub mod evaluation;
pub mod geometry;
pub mod pipeline;
pub mod plant;
pub mod reconstruction;
