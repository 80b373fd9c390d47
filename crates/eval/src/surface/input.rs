//! What is scored, and whether it can be.

use std::path::{Path, PathBuf};

use mb_capture::VisibilityVolume;
use mb_job::{InputError, Result};
use mb_mesh::{KdTree, TriangleMesh, sample_uniform};
use nalgebra::{Matrix3, Point3};

use super::SurfaceProtocol;
use super::setting::Setting;

/// The ground truth of one sequence.
#[derive(Debug, Clone)]
pub struct SurfaceTruth {
    /// Name of the sequence: its folder's name.
    pub sequence: String,
    /// The true surface, metres, world frame.
    pub mesh: TriangleMesh,
    /// The file of `mesh`.
    pub mesh_path: PathBuf,
    /// Where predictions can be judged.
    pub visibility: VisibilityVolume,
    /// What is known of the scene; read for `exact-1` alone.
    pub(super) setting: Setting,
}

impl SurfaceTruth {
    /// Reads what a protocol needs from a sequence folder: `visibility_mask.npy` and `mesh/gt_mesh.ply`, or for
    /// `exact-1` `mesh/visible_surface.ply` where there is one. Nothing else of the sequence need be there.
    ///
    /// # Errors
    /// A file is missing or damaged; the mesh has no triangles, or a vertex that is not finite.
    pub fn read(sequence: &Path, protocol: SurfaceProtocol) -> Result<Self> {
        if !sequence.is_dir() {
            let found = if sequence.exists() { "not a folder" } else { "no such folder" };
            let help = "The ground truth is a sequence folder with mesh/gt_mesh.ply and visibility_mask.npy";
            return Err(InputError::new(sequence, found).help(help).into());
        }
        let exact = sequence.join("mesh/visible_surface.ply");
        let published = sequence.join("mesh/gt_mesh.ply");
        let mesh_path = match protocol {
            SurfaceProtocol::MobileBrick2023 => published,
            _ if exact.exists() => exact,
            _ => published,
        };
        let visibility_path = sequence.join("visibility_mask.npy");
        for path in [&mesh_path, &visibility_path] {
            if !path.exists() {
                let help = "Make the sequence's ground truth first: `mobilebrick truth SEQ`";
                return Err(InputError::new(path, "the sequence has no such file").help(help).into());
            }
        }
        let mesh = mb_mesh::read_mesh(&mesh_path)?;
        check_vertices(&mesh, &mesh_path)?;
        if mesh.triangles.is_empty() {
            return Err(InputError::new(mesh_path, "the ground truth has no triangles").into());
        }
        let absolute = std::path::absolute(sequence).unwrap_or_else(|_| sequence.to_owned());
        let name = absolute.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let visibility = VisibilityVolume::read(visibility_path)?;
        let setting = match protocol {
            SurfaceProtocol::Exact1 => Setting::read(sequence),
            _ => Setting::default(),
        };
        Ok(Self { sequence: name, mesh, mesh_path, visibility, setting })
    }

    /// Whether the surface is the model's own and not a fused one.
    pub(super) fn is_exact(&self) -> bool {
        self.mesh_path.ends_with("mesh/visible_surface.ply")
    }

    /// The mesh's path inside the sequence, for documents.
    pub(super) fn relative_mesh_path(&self) -> String {
        let name = self.mesh_path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        format!("mesh/{name}")
    }
}

/// Points of the ground truth that are looked for in the prediction.
const PROBES: usize = 500;
/// Points of the prediction among which they are looked for.
const PREDICTED: usize = 20_000;
/// As far as a good prediction may be off, metres: the reach of the published alignment.
const NEAR_M: f64 = 0.02;
/// A prediction that covers this share of the probes is in the right unit and frame.
const PLAUSIBLE: f64 = 0.3;
/// Another unit or frame explains a prediction that covers less, if with it this share is covered.
const EXPLAINED: f64 = 0.7;

/// Checks that a prediction can be scored at all; returns warnings.
pub(super) fn check_prediction(truth: &SurfaceTruth, prediction: &TriangleMesh, name: &Path) -> Result<Vec<String>> {
    check_vertices(prediction, name)?;
    let predicted = representatives(prediction);
    let tree = KdTree::new(&predicted);
    let probes: Vec<Point3<f64>> = sample_uniform(&truth.mesh, PROBES, 0).into_iter().map(|s| s.point).collect();
    let covered = |candidate: &Candidate| {
        let near = |p: &&Point3<f64>| tree.nearest_within(&candidate.undo(p), NEAR_M / candidate.scale).is_some();
        probes.iter().filter(near).count() as f64 / probes.len().max(1) as f64
    };
    let now = covered(&Candidate::new(1.0, Matrix3::identity()));
    if now >= PLAUSIBLE {
        return Ok(Vec::new());
    }
    for (candidate, found, help) in candidates() {
        if covered(&candidate) >= EXPLAINED {
            return Err(InputError::new(name, found).help(help).into());
        }
    }
    let (gt_box, pred_box) = (truth.mesh.bounds(), prediction.bounds());
    let ratio = pred_box.extent().norm() / gt_box.extent().norm();
    let sizes = format!(
        "it spans {} m around {}, the ground truth {} m around {}",
        triple(pred_box.extent().as_slice()),
        triple(pred_box.center().coords.as_slice()),
        triple(gt_box.extent().as_slice()),
        triple(gt_box.center().coords.as_slice()),
    );
    if now == 0.0 && (300.0..3000.0).contains(&ratio) {
        let found = format!("the prediction seems to be in millimetres, and in another frame: {sizes}");
        let help = "Multiply its coordinates by 0.001 and bring it into the world frame of pose/, in metres";
        return Err(InputError::new(name, found).help(help).into());
    }
    let grown = gt_box.grown(NEAR_M);
    let apart = (0..3).any(|axis| pred_box.max[axis] < grown.min[axis] || grown.max[axis] < pred_box.min[axis]);
    let normalised = pred_box.center().coords.norm() < 0.5 && (1.0..6.0).contains(&pred_box.extent().norm());
    if now == 0.0 && (apart || normalised) {
        let found = format!("the prediction lies in another frame than the ground truth: {sizes}");
        let help = if normalised {
            "If it is in the normalised frame of NeuS, multiply it by scale_mat_0 of cameras.npz"
        } else if (0.7..1.4).contains(&ratio) {
            "Its size fits: move it from the object's frame, or from where its method centred it, to the world frame of pose/"
        } else {
            "Predictions are compared in metres in the sequence's world frame, the frame of pose/"
        };
        return Err(InputError::new(name, found).help(help).into());
    }
    let percent = 100.0 * now;
    Ok(vec![format!("only {percent:.0} % of the ground truth has any prediction within 20 mm; check unit and frame")])
}

/// A mesh must have vertices, all finite, and triangles that refer to them.
fn check_vertices(mesh: &TriangleMesh, path: &Path) -> Result<(), InputError> {
    if mesh.vertices.is_empty() {
        return Err(InputError::new(path, "the mesh is empty: it has no vertices"));
    }
    if let Some(at) = mesh.vertices.iter().position(|v| !v.coords.iter().all(|c| c.is_finite())) {
        let v = mesh.vertices[at];
        return Err(InputError::new(path, format!("({}, {}, {}) is not a finite point", v.x, v.y, v.z))
            .at(format!("vertex {at}"))
            .help("Remove such vertices and their triangles before scoring"));
    }
    let count = mesh.vertices.len();
    if let Some(at) = mesh.triangles.iter().position(|t| t.iter().any(|&v| v as usize >= count)) {
        let found = format!("refers to vertices {:?} of {count}", mesh.triangles[at]);
        return Err(InputError::new(path, found).at(format!("triangle {at}")));
    }
    Ok(())
}

/// A few points of the prediction, spread over it.
fn representatives(prediction: &TriangleMesh) -> Vec<Point3<f64>> {
    let samples = sample_uniform(prediction, PREDICTED, 0);
    if !samples.is_empty() {
        return samples.into_iter().map(|s| s.point).collect();
    }
    let step = prediction.vertices.len().div_ceil(PREDICTED).max(1);
    prediction.vertices.iter().step_by(step).copied().collect()
}

/// A mistake that is often made: what turns the prediction back.
struct Candidate {
    scale: f64,
    world_from_predicted: Matrix3<f64>,
}

impl Candidate {
    fn new(scale: f64, world_from_predicted: Matrix3<f64>) -> Self {
        Self { scale, world_from_predicted }
    }

    /// A point of the world, as the mistake shows it.
    fn undo(&self, p_in_world: &Point3<f64>) -> Point3<f64> {
        (self.world_from_predicted.transpose() * p_in_world) / self.scale
    }
}

/// Units and axes that methods confuse, each with the sentence that names it and the one that mends it.
fn candidates() -> Vec<(Candidate, String, String)> {
    let units = [(0.001, "millimetres"), (0.01, "centimetres"), (0.0254, "inches")].map(|(scale, unit)| {
        let found = format!("the prediction is in {unit}, not in metres");
        (Candidate::new(scale, Matrix3::identity()), found, format!("Multiply its coordinates by {scale}"))
    });
    let axes = [
        ("(x, -y, -z)", [[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
        ("(-x, -y, z)", [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]),
        ("(-x, y, -z)", [[-1, 0, 0], [0, 1, 0], [0, 0, -1]]),
        ("(x, z, -y)", [[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
        ("(x, -z, y)", [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    ]
    .map(|(formula, rows)| {
        let matrix = Matrix3::from_fn(|row, column| f64::from(rows[row][column]));
        let found = "the prediction is in a frame with other axes than the sequence's world frame".to_owned();
        (Candidate::new(1.0, matrix), found, format!("Replace each vertex (x, y, z) by {formula}"))
    });
    units.into_iter().chain(axes).collect()
}

fn triple(values: &[f64]) -> String {
    let values: Vec<String> = values.iter().map(|v| format!("{v:.3}")).collect();
    format!("({})", values.join(", "))
}
