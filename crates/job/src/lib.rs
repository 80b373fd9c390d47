//! What every job needs from the world around it, in one place:
//!
//! - [`InputError`]: bad input, told so that a person can mend it (what was found, where, what to do);
//! - [`write_atomic`]: outputs that appear whole or not at all;
//! - [`Progress`]: progress and the wish to stop, without knowing who listens;
//! - [`rng`]: random numbers that depend on a seed and a stream, never on threads.
//!
//! Libraries return [`Error`]; the command maps [`Error::Input`] to exit status 3 and the rest to 1.

mod error;
mod output;
mod progress;
mod random;

pub use error::{Error, InputError, Result};
pub use output::{write_atomic, write_atomic_with};
pub use progress::{Progress, Silent, Steps};
pub use random::{Rng, rng};
