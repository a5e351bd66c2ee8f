//! Bytes that come in: received and checked (`intake`), whole or by the tus protocol.

pub mod form;
pub mod intake;
pub mod tus;
