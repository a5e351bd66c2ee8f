//! The description of the API.

pub mod examples;
pub mod responses;
