//! Whole jobs over the crates below: reports and the demo.

mod report;

pub use report::{ColorScale, Curves, Gallery, Picture, Report, Stage, Table};
