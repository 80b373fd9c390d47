//! The model in the sequence's world, and what each camera sees of it.

use mb_capture::{Alignment, Frame, Sequence};
use mb_geometry::{ImageSize, World};
use mb_job::{InputError, Result};
use mb_mesh::TriangleMesh;
use mb_render::{Raster, Scene, View};

/// Longer models are refused: their unit is not the metre.
const MAX_MODEL_M: f64 = 20.0;

/// The aligned model of a sequence with its cameras.
pub struct ExactScene {
    /// The model, world frame, metres.
    pub mesh: TriangleMesh,
    /// The sequence's frames with aligned poses.
    pub frames: Vec<Frame>,
    size: ImageSize,
    scene: Scene,
}

impl ExactScene {
    /// Places the sequence's model by its alignment.
    ///
    /// # Errors
    /// The sequence has no model or no alignment, or either is malformed.
    pub fn open(sequence: &Sequence) -> Result<Self> {
        Self::with_alignment(sequence, &sequence.read_alignment()?)
    }

    /// Places the sequence's model by a given alignment.
    ///
    /// # Errors
    /// The sequence has no model, or it is malformed, without triangles or longer than 20 m.
    pub fn with_alignment(sequence: &Sequence, alignment: &Alignment) -> Result<Self> {
        let path = sequence.model_mesh_path();
        if !path.exists() {
            return Err(InputError::new(path, "the sequence carries no model")
                .help("Write the model's geometry there with `mobilebrick model mesh MODEL -o SEQ/model/mesh.ply`")
                .into());
        }
        let mesh = mb_mesh::read_mesh(&path)?;
        if mesh.triangles.is_empty() {
            return Err(InputError::new(path, "the model has no triangles").into());
        }
        let longest_m = mesh.bounds().extent().max();
        // NaN is refused as well.
        if !longest_m.is_finite() || longest_m > MAX_MODEL_M {
            return Err(InputError::new(path, format!("the model is {longest_m:.0} m long"))
                .help("The file must be in metres; this one seems to hold millimetres or LDraw units")
                .into());
        }
        let mesh = mesh.transformed(&alignment.world_from_object);
        Ok(Self::new(mesh, sequence.aligned_frames(alignment), sequence.image_size()))
    }

    /// A scene that is on no disk: the model in the world frame, metres, and cameras whose intrinsics are those of
    /// photographs of `size`.
    pub fn new(mesh_in_world: TriangleMesh, frames: Vec<Frame>, size: ImageSize) -> Self {
        let scene = Scene::new(&mesh_in_world);
        Self { mesh: mesh_in_world, frames, size, scene }
    }

    /// The camera of a frame, at the photographs' size.
    pub fn view(&self, frame: &Frame) -> View<World> {
        View { intrinsics: frame.intrinsics, size: self.size, cam_from_frame: frame.world_from_cam.inverse() }
    }

    /// Exact depth and triangle ids of a frame, at the photographs' size: `gt_depth/` before it is rounded to millimetres.
    pub fn render(&self, frame: &Frame) -> Raster {
        self.scene.render(&self.view(frame))
    }
}
