//! Messages to other services: that a job has ended. The store creates them in the transaction that ends the job; here they
//! are signed and sent, until they arrive or have used up their attempts.

pub mod message;
pub mod sender;
pub mod signature;
pub mod target;

pub use message::{Failure, Message};
pub use sender::{Sender, SenderSettings};
pub use signature::{HEADER, sign};
pub use target::{TargetError, Targets};
