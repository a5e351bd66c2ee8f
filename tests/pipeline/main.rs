//! The program on the command line, on the example plant: whole, and broken in every way that was thought of.

#[path = "../common/boxes.rs"]
mod boxes;
mod broken;
mod data;
mod detect;
mod projects;
mod resume;
mod survey;
mod unusual;
mod whole;
