//! A brick model becomes a capture that carries the model with it.

use std::path::Path;

use mb_bricks::{MeshOptions, Model};
use mb_job::{Progress, Result};
use mb_simulate::{SimulateOptions, SimulateSummary, simulate};
use serde::{Deserialize, Serialize};

/// How a model is filmed.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ModelCapture {
    /// Play of outer side walls, millimetres: 0 is nominal, real bricks have about 0.1.
    pub clearance_mm: f64,
    /// The phone.
    pub simulate: SimulateOptions,
}

/// Simulates a capture of `model` in the folder `out`, and puts the model itself under `model/`, with every part file
/// that it uses, so that later stages need neither the model file nor a parts library.
///
/// # Errors
/// The model lacks parts (ground truth from an incomplete model would be wrong), the simulation fails, or a file
/// cannot be written.
pub fn simulate_model(
    model: &Model,
    capture: &ModelCapture,
    out: &Path,
    progress: &dyn Progress,
) -> Result<SimulateSummary> {
    model.require_complete()?;
    let mesh = model.mesh(&MeshOptions { clearance_mm: capture.clearance_mm });
    let summary = simulate(&mesh, &capture.simulate, out, progress)?;
    model.write_self_contained(out.join("model/model.mpd"))?;
    Ok(summary)
}
