//! Maps a photovoltaic plant: photos, camera poses, parameters and a seed go in; a plant model with its warnings comes out.
//!
//! Each room may use the rooms before it in this list, never those after it: `geometry`, `reconstruction`, `detection`,
//! `layout`, `fusion`, `refinement`, `assembly`, `pipeline`. Nothing here knows of HTTP, databases or the environment, and
//! equal input gives an equal model whatever the number of threads.

pub mod assembly;
pub mod detection;
pub mod fusion;
pub mod geometry;
pub mod layout;
pub mod pipeline;
pub mod reconstruction;
pub mod refinement;
