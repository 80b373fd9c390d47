//! The published data set, or parts of it, from the web.
//!
//! The data set is one zip archive of about 13 GB. Where the server answers requests for ranges, [`download`] reads the archive's
//! index, and then only the members that were asked for: one sequence, or only meshes. Every member is checked against the
//! size and checksum of the index and appears under its name when it is whole, so that a stopped run is taken up where it
//! was. Connections that are cut or fall silent are made again, from the byte that is due. Where the server ignores ranges, the
//! whole archive is fetched first and kept beside what was taken from it.
//!
//! This is the only crate that speaks HTTP as a client. It knows zip archives, not what a sequence is.

mod archive;
mod download;
mod http;
mod remote;

pub use download::{DownloadOptions, DownloadSummary, PUBLISHED_URL, download};
pub use http::Patience;
