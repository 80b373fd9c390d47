//! Whole jobs over the crates below: reports and the demo.

mod model_capture;
mod report;

pub use model_capture::{ModelCapture, simulate_model};
pub use report::{ColorScale, Curves, Gallery, Picture, Report, Stage, Table};
