//! The HTTP API in process: real store, real worker, a mapper that does as it is told.

mod app;
mod contract;
mod images;
mod jobs;
mod models;
mod plants;
mod reconstruction;
