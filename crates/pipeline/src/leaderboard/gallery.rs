//! The pictures of a sequence: the truth, each method's surface, what is wrong with it and what it lacks.

use std::path::{Path, PathBuf};

use mb_capture::Sequence;
use mb_eval::{FileHash, SurfaceProtocol, SurfaceTruth};
use mb_geometry::ImageSize;
use mb_image::write_jpeg;
use mb_job::Result;
use nalgebra::Vector3;

use super::board::{SurfaceBoard, sequence_folder};
use crate::pictures::{Studio, heated};

const PICTURE: ImageSize = ImageSize::new(720, 560);
const AZIMUTH: f64 = 0.6;
const QUALITY: u8 = 88;

/// The pictures of one sequence; paths are relative to the site.
#[derive(Default)]
pub(super) struct Gallery {
    pub truth: Option<PathBuf>,
    pub methods: Vec<MethodPictures>,
    /// Why something could not be drawn.
    pub notes: Vec<String>,
    /// Pictures that were drawn now; others were there already.
    pub drawn: usize,
}

/// One method's pictures.
pub(super) struct MethodPictures {
    pub method: String,
    /// The surface as it is; coloured by the distance to the truth; the truth coloured by the distance to it.
    pub surface: PathBuf,
    pub wrong: PathBuf,
    pub lacking: PathBuf,
}

/// Draws what is not there yet. Pictures are named by the content of the files that they show, so that a site is brought
/// up to date, or a stopped run goes on, without drawing anything twice.
pub(super) fn draw(board: &SurfaceBoard, sequence: &str, site: &Path) -> Result<Gallery> {
    let mut gallery = Gallery::default();
    let mut truth: Option<(SurfaceTruth, Vector3<f64>, String)> = None;
    for method in &board.methods {
        let Some(scores) = method.sequences.get(sequence) else { continue };
        let (Some(provenance), Some(folder)) = (&scores.provenance, sequence_folder(scores)) else { continue };
        let path = &provenance.prediction.path;
        let changed =
            |what: &str| format!("{}: no pictures, {} {what} since it was scored", method.name, path.display());
        match FileHash::of(path) {
            Ok(now) if now.sha256 == provenance.prediction.sha256 => {}
            Ok(_) => {
                gallery.notes.push(changed("has changed"));
                continue;
            }
            Err(_) => {
                gallery.notes.push(changed("has gone"));
                continue;
            }
        }
        if truth.is_none() {
            match read_truth(folder) {
                Ok(read) => truth = Some(read),
                Err(error) => {
                    gallery.notes.push(format!("no pictures: {error}"));
                    return Ok(gallery);
                }
            }
        }
        let Some((truth, up, truth_hash)) = &truth else { continue };
        let studio = Studio { truth, up: *up, size: PICTURE };
        let truth_picture = PathBuf::from(format!("images/{truth_hash}.jpg"));
        if !site.join(&truth_picture).exists() {
            write_jpeg(site.join(&truth_picture), &studio.look(&truth.mesh, AZIMUTH, true), QUALITY)?;
            gallery.drawn += 1;
        }
        gallery.truth = Some(truth_picture);
        let hash = &provenance.prediction.sha256[..12];
        let name = |kind: &str| PathBuf::from(format!("images/{truth_hash}-{hash}-{kind}.jpg"));
        let pictures = MethodPictures {
            method: method.name.clone(),
            surface: name("surface"),
            wrong: name("wrong"),
            lacking: name("lacking"),
        };
        // The last one is written last.
        if !site.join(&pictures.lacking).exists() {
            let prediction = studio.judged_part(mb_mesh::read_mesh(path)?);
            for (name, mesh) in [
                (&pictures.surface, &prediction),
                (&pictures.wrong, &heated(&prediction, &truth.mesh)),
                (&pictures.lacking, &heated(&truth.mesh, &prediction)),
            ] {
                write_jpeg(site.join(name), &studio.look(mesh, AZIMUTH, true), QUALITY)?;
                gallery.drawn += 1;
            }
        }
        gallery.methods.push(pictures);
    }
    Ok(gallery)
}

/// The fused ground truth, whose even triangles show distances well, with up in its world and a short hash.
fn read_truth(folder: &Path) -> Result<(SurfaceTruth, Vector3<f64>, String)> {
    let truth = SurfaceTruth::read(folder, SurfaceProtocol::MobileBrick2023)?;
    let alignment = Sequence::open(folder).and_then(|s| s.read_alignment());
    // Phones put their worlds upright.
    let up = alignment.map_or(Vector3::y(), |a| a.world_from_object.rotate(&Vector3::y()));
    let hash = FileHash::of(&truth.mesh_path)?.sha256[..12].to_owned();
    Ok((truth, up, hash))
}
