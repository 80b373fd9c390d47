//! LDraw text files: what stands in them, where they are found, what they look like.

mod archive;
pub(crate) mod colors;
pub(crate) mod file;
pub(crate) mod library;
pub(crate) mod load;
pub(crate) mod parse;
pub(crate) mod shape;
mod studio;
pub(crate) mod warnings;
