//! PLY files (Turk 1994).

mod header;
mod read;
mod values;
mod write;

pub(crate) use read::parse;
pub use write::write_ply;
