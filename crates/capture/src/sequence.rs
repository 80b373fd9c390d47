//! A sequence folder.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};

use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
use mb_image::{Confidence, DepthImage, Mask, RgbImage};
use mb_job::{InputError, Result, write_atomic};
use serde::{Deserialize, Serialize};

use crate::{Alignment, read_intrinsics_txt, read_pose_txt};

/// A frame's stable number, the `NNNNNN` of its files; numbers may have gaps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct FrameId(pub u32);

/// Six digits, as in the file names.
impl fmt::Display for FrameId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:06}", self.0)
    }
}

/// One frame: its camera, and where its images are.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Which frame.
    pub id: FrameId,
    /// Intrinsics of the photograph.
    pub intrinsics: Intrinsics,
    /// The phone's pose as `pose/` has it.
    pub world_from_cam: Rigid3<World, Camera>,
    /// The photograph, where there is one.
    pub image: Option<PathBuf>,
    /// The phone's depth, where there is one.
    pub arkit_depth: Option<PathBuf>,
}

/// `sequence.json`: what the published layout has no place for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SequenceMeta {
    /// Version of this document, 1.
    pub version: u32,
    /// Size of the photographs that the intrinsics refer to.
    pub image_size: ImageSize,
    /// Device or program that made the capture.
    #[serde(default)]
    pub device: String,
    /// What it was imported or simulated from.
    #[serde(default)]
    pub source: String,
    /// Time of each frame in seconds from the first, in the order of the frame numbers; `None` where unknown.
    #[serde(default)]
    pub frame_times_s: Option<Vec<f64>>,
    /// SHA-256 of the files that the capture consists of, by their path in the folder; `None` where nobody took them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hashes_sha256: Option<BTreeMap<String, String>>,
    /// Seed, options and versions of the program that wrote the sequence.
    #[serde(default)]
    pub provenance: serde_json::Value,
}

/// A sequence folder, its index read and checked.
#[derive(Debug, Clone)]
pub struct Sequence {
    root: PathBuf,
    frames: Vec<Frame>,
    image_size: ImageSize,
    meta: Option<SequenceMeta>,
    warnings: Vec<String>,
}

impl Sequence {
    /// Size of the published photographs, in sensor orientation.
    pub const PUBLISHED_SIZE: ImageSize = ImageSize::new(1920, 1440);

    /// Opens a sequence folder: every frame of `intrinsic/`, `pose/`, `image/` and `arkit_depth/`, joined by number.
    ///
    /// # Errors
    /// The folder or every frame is missing; a frame lacks its pose or intrinsics; a matrix is malformed. The frame
    /// and the file are named.
    pub fn open(root: impl Into<PathBuf>) -> Result<Self> {
        let root = root.into();
        if !root.is_dir() {
            let found = if root.exists() { "not a folder" } else { "no such folder" };
            return Err(InputError::new(root, found).help("A sequence is a folder with pose/ and intrinsic/").into());
        }
        let poses = numbered_files(&root.join("pose"), &["txt"])?;
        let intrinsics = numbered_files(&root.join("intrinsic"), &["txt"])?;
        let images = numbered_files(&root.join("image"), &["jpg", "jpeg", "png"])?;
        let depths = numbered_files(&root.join("arkit_depth"), &["png"])?;
        let find = |list: &[(FrameId, PathBuf)], id: FrameId| {
            list.binary_search_by_key(&id, |(id, _)| *id).ok().map(|i| list[i].1.clone())
        };
        let ids: BTreeSet<FrameId> =
            [&poses, &intrinsics, &images, &depths].iter().flat_map(|l| l.iter().map(|(id, _)| *id)).collect();
        if ids.is_empty() {
            return Err(InputError::new(root, "no frames found")
                .help("Expected pose/NNNNNN.txt, intrinsic/NNNNNN.txt and image/NNNNNN.jpg or .png")
                .into());
        }
        let mut warnings = Vec::new();
        let mut frames = Vec::with_capacity(ids.len());
        for id in ids {
            let missing = |what: &str| {
                InputError::new(
                    root.join(what).join(format!("{id}.txt")),
                    "missing, although the frame has other files",
                )
                .at(format!("frame {id}"))
                .help("Add the file, or import the folder with `capture import`, which leaves such frames out")
            };
            let pose = find(&poses, id).ok_or_else(|| missing("pose"))?;
            let intrinsic = find(&intrinsics, id).ok_or_else(|| missing("intrinsic"))?;
            let (world_from_cam, defect) = read_pose_txt(&pose)?;
            if !defect.is_within(1e-5) {
                warnings.push(format!(
                    "{}: rotation re-orthonormalised (determinant {:.5})",
                    pose.display(),
                    defect.determinant
                ));
            }
            frames.push(Frame {
                id,
                intrinsics: read_intrinsics_txt(&intrinsic)?,
                world_from_cam,
                image: find(&images, id),
                arkit_depth: find(&depths, id),
            });
        }
        let meta_path = root.join("sequence.json");
        let meta: Option<SequenceMeta> = if meta_path.exists() { Some(read_json(&meta_path)?) } else { None };
        let image_size = match (&meta, frames.iter().find_map(|f| f.image.as_ref())) {
            (Some(meta), _) => meta.image_size,
            (None, Some(image)) => mb_image::read_size(image)?,
            (None, None) => Self::PUBLISHED_SIZE,
        };
        if image_size.pixels() == 0 {
            return Err(InputError::new(meta_path, format!("image_size is {image_size}")).into());
        }
        Ok(Self { root, frames, image_size, meta, warnings })
    }

    /// The folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The folder's name, which names the sequence.
    pub fn name(&self) -> String {
        let absolute = std::path::absolute(&self.root).unwrap_or_else(|_| self.root.clone());
        absolute.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
    }

    /// Frames in ascending order of their ids, at least one.
    pub fn frames(&self) -> &[Frame] {
        &self.frames
    }

    /// The frame with this id.
    pub fn frame(&self, id: FrameId) -> Option<&Frame> {
        self.frames.binary_search_by_key(&id, |f| f.id).ok().map(|i| &self.frames[i])
    }

    /// Size of the photographs, which intrinsics, masks and exact depth refer to.
    pub fn image_size(&self) -> ImageSize {
        self.image_size
    }

    /// What `sequence.json` says, where there is one.
    pub fn meta(&self) -> Option<&SequenceMeta> {
        self.meta.as_ref()
    }

    /// What was found and mended while opening.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// A frame's photograph.
    ///
    /// # Errors
    /// It is missing, damaged, or not of the sequence's size.
    pub fn read_image(&self, frame: &Frame) -> Result<RgbImage> {
        let path = frame.image.as_ref().ok_or_else(|| {
            InputError::new(self.root.join("image"), "no photograph").at(format!("frame {}", frame.id))
        })?;
        let image = mb_image::read_rgb(path)?;
        self.check_size(path, frame, image.size())?;
        Ok(image)
    }

    /// A frame's phone depth (metres) with its confidence (2 everywhere where no confidence file lies beside it).
    ///
    /// # Errors
    /// The depth is missing; either file is damaged; their sizes differ.
    pub fn read_arkit_depth(&self, frame: &Frame) -> Result<(DepthImage, Confidence)> {
        let path = frame.arkit_depth.as_ref().ok_or_else(|| {
            InputError::new(self.root.join("arkit_depth"), "no depth map").at(format!("frame {}", frame.id))
        })?;
        let depth = mb_image::read_depth_png(path)?;
        let conf_path = self.root.join("arkit_depth").join(format!("{}_conf.png", frame.id));
        let confidence = if conf_path.exists() {
            mb_image::read_confidence_png(&conf_path)?
        } else {
            Confidence::filled(depth.size(), 2)
        };
        if confidence.size() != depth.size() {
            let found = format!("{}, but the depth map is {}", confidence.size(), depth.size());
            return Err(InputError::new(conf_path, found).at(format!("frame {}", frame.id)).into());
        }
        Ok((depth, confidence))
    }

    /// A frame's exact depth (metres), written by `truth`.
    ///
    /// # Errors
    /// It is missing, damaged, or not of the photographs' size.
    pub fn read_gt_depth(&self, frame: &Frame) -> Result<DepthImage> {
        let path = self.gt_depth_path(frame.id);
        let depth = mb_image::read_depth_png(&path)?;
        self.check_size(&path, frame, depth.size())?;
        Ok(depth)
    }

    /// A frame's object mask, written by `truth`.
    ///
    /// # Errors
    /// It is missing, damaged, or not of the photographs' size.
    pub fn read_mask(&self, frame: &Frame) -> Result<Mask> {
        let path = self.mask_path(frame.id);
        let mask = mb_image::read_mask_png(&path)?;
        self.check_size(&path, frame, mask.size())?;
        Ok(mask)
    }

    fn check_size(&self, path: &Path, frame: &Frame, found: ImageSize) -> Result<()> {
        if found == self.image_size {
            return Ok(());
        }
        let found = format!("{found} pixels, but the sequence's photographs are {}", self.image_size);
        Err(InputError::new(path, found).at(format!("frame {}", frame.id)).into())
    }

    /// Where a frame's exact depth lies.
    pub fn gt_depth_path(&self, id: FrameId) -> PathBuf {
        self.root.join("gt_depth").join(format!("{id}.png"))
    }

    /// Where a frame's mask lies.
    pub fn mask_path(&self, id: FrameId) -> PathBuf {
        self.root.join("mask").join(format!("{id}.png"))
    }

    /// Where the ground-truth mesh of the published layout lies.
    pub fn gt_mesh_path(&self) -> PathBuf {
        self.root.join("mesh/gt_mesh.ply")
    }

    /// Where the exact triangles that some frame sees lie.
    pub fn visible_surface_path(&self) -> PathBuf {
        self.root.join("mesh/visible_surface.ply")
    }

    /// Where the cameras for NeuS lie, with the sphere around the object.
    pub fn neus_cameras_path(&self) -> PathBuf {
        self.root.join("cameras.npz")
    }

    /// Where the visibility volume lies.
    pub fn visibility_path(&self) -> PathBuf {
        self.root.join("visibility_mask.npy")
    }

    /// Where the model's triangles lie: metres, object frame, one part index and colour per triangle.
    pub fn model_mesh_path(&self) -> PathBuf {
        self.root.join("model/mesh.ply")
    }

    /// The sequence's alignment.
    ///
    /// # Errors
    /// There is none yet, or it is malformed.
    pub fn read_alignment(&self) -> Result<Alignment> {
        let path = self.root.join(Alignment::FILE);
        if !path.exists() {
            return Err(InputError::new(path, "the sequence has no alignment yet")
                .help("Run `mobilebrick align keypoints` on it first")
                .into());
        }
        let alignment = Alignment::read(&path)?;
        for camera in &alignment.frames {
            if self.frame(camera.frame).is_none() {
                let found = "the alignment names a frame that the sequence does not have";
                return Err(InputError::new(path, found).at(format!("frame {}", camera.frame)).into());
            }
        }
        Ok(alignment)
    }

    /// The frames with their poses replaced by those of `alignment`, where it has them.
    pub fn aligned_frames(&self, alignment: &Alignment) -> Vec<Frame> {
        let mut frames = self.frames.clone();
        for camera in &alignment.frames {
            if let Ok(i) = frames.binary_search_by_key(&camera.frame, |f| f.id) {
                frames[i].world_from_cam = camera.world_from_cam;
            }
        }
        frames
    }
}

/// Files `NNNNNN.EXT` of a folder, in ascending order. An absent folder has none; other names are not frames.
pub(crate) fn numbered_files(folder: &Path, extensions: &[&str]) -> Result<Vec<(FrameId, PathBuf)>> {
    let entries = match std::fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(e) => return Err(InputError::unreadable(folder, &e).into()),
    };
    let mut files: Vec<(FrameId, PathBuf)> = Vec::new();
    for entry in entries {
        let path = entry.map_err(|e| InputError::unreadable(folder, &e))?.path();
        let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
        let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        if !extensions.contains(&extension.as_str()) || !stem.bytes().all(|b| b.is_ascii_digit()) {
            continue;
        }
        if let Ok(number) = stem.parse() {
            files.push((FrameId(number), path));
        }
    }
    files.sort();
    if let Some(pair) = files.windows(2).find(|pair| pair[0].0 == pair[1].0) {
        let found = format!("frame {} is there twice, also as {}", pair[0].0, pair[1].1.display());
        return Err(InputError::new(&pair[0].1, found).help("Keep one of the two").into());
    }
    Ok(files)
}

/// Reads a JSON document; errors name line and column.
pub(crate) fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T> {
    let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
    serde_json::from_slice(&bytes).map_err(|e| InputError::new(path, e.to_string()).into())
}

/// Writes a JSON document, indented, with a final line end.
pub(crate) fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    let mut bytes = serde_json::to_vec_pretty(value).map_err(|e| mb_job::Error::write(path, e.into()))?;
    bytes.push(b'\n');
    write_atomic(path, &bytes)
}
