//! (story to be written by the crate)
