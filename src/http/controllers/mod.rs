//! The endpoints: each file holds parameters, handlers and responses of one kind of resource.

pub mod events;
pub mod features;
pub mod file_deletion;
pub mod file_lists;
pub mod files;
pub mod health;
pub mod images;
pub mod jobs;
pub mod keys;
pub mod models;
pub mod openapi;
pub mod page;
pub mod plants;
pub mod surveys;
pub mod usage;
pub mod webhooks;
