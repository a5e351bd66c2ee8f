//! The refined structure becomes the plant model; modules of an earlier survey keep their identifiers.

mod assemble;
mod resurvey;

pub use assemble::{Identity, assemble};
