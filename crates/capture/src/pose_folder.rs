//! Camera poses alone: a folder with `pose/NNNNNN.txt`, whether or not it is a whole sequence.

use std::path::{Path, PathBuf};

use mb_geometry::{Camera, Rigid3, World};
use mb_job::{InputError, Result};

use crate::sequence::numbered_files;
use crate::{Alignment, FrameId, read_pose_txt};

/// The camera poses of a folder, and the object's where it is known.
#[derive(Debug, Clone)]
pub struct PoseFolder {
    root: PathBuf,
    frames: Vec<(FrameId, Rigid3<World, Camera>)>,
    alignment: Option<(PathBuf, Alignment)>,
    warnings: Vec<String>,
}

impl PoseFolder {
    /// Reads `pose/NNNNNN.txt`, and `alignment/alignment.json` or else `alignment.json` where there is one. The poses
    /// of an alignment replace those of `pose/`, frame by frame.
    ///
    /// # Errors
    /// There is no pose; a pose or the alignment is malformed.
    pub fn open(root: impl Into<PathBuf>) -> Result<Self> {
        let root = root.into();
        let files = numbered_files(&root.join("pose"), &["txt"])?;
        if files.is_empty() {
            let found = if root.is_dir() { "no pose/NNNNNN.txt in this folder" } else { "no such folder" };
            return Err(InputError::new(root, found)
                .help("Name the folder that holds pose/, such as a sequence")
                .into());
        }
        let mut warnings = Vec::new();
        let mut frames = Vec::with_capacity(files.len());
        for (id, path) in files {
            let (world_from_cam, defect) = read_pose_txt(&path)?;
            if !defect.is_within(1e-5) {
                let determinant = defect.determinant;
                warnings
                    .push(format!("{}: rotation re-orthonormalised (determinant {determinant:.5})", path.display()));
            }
            frames.push((id, world_from_cam));
        }
        let candidates = [root.join(Alignment::FILE), root.join("alignment.json")];
        let alignment = match candidates.into_iter().find(|path| path.exists()) {
            Some(path) => {
                let alignment = Alignment::read(&path)?;
                for camera in &alignment.frames {
                    let i = frames.binary_search_by_key(&camera.frame, |(id, _)| *id).map_err(|_| {
                        InputError::new(&path, "the alignment names a frame that pose/ does not have")
                            .at(format!("frame {}", camera.frame))
                    })?;
                    frames[i].1 = camera.world_from_cam;
                }
                Some((path, alignment))
            }
            None => None,
        };
        Ok(Self { root, frames, alignment, warnings })
    }

    /// The folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Cameras in ascending order of frame ids, at least one; aligned where the alignment has them.
    pub fn frames(&self) -> &[(FrameId, Rigid3<World, Camera>)] {
        &self.frames
    }

    /// The alignment and its file, where there is one.
    pub fn alignment(&self) -> Option<(&Path, &Alignment)> {
        self.alignment.as_ref().map(|(path, alignment)| (path.as_path(), alignment))
    }

    /// What was found and mended while reading.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }
}
