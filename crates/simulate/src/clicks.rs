//! The annotator: clicks on corners of bricks that are plain to see.

use mb_capture::{FrameId, Keypoint, Keypoints};
use mb_geometry::{ImageSize, Intrinsics, Object, Rigid3};
use mb_job::{Progress, Result, Steps, rng};
use mb_mesh::TriangleMesh;
use mb_render::View;
use nalgebra::{Matrix3, Point2, Point3, Vector3};
use rand::RngExt;

use crate::lens::Distortion;
use crate::random::normal;
use crate::stage::Stage;
use crate::streams;

/// A corner that a person can name and find: three faces of a part meet in it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Corner {
    point: Point3<f64>,
    part: u32,
    /// How square it is: the volume that its three most different face normals span, 1 for a box's corner.
    squareness: f64,
}

/// The corners of a mesh, most square first; at least the squarer half of all when the model has few true corners.
fn corners(model: &TriangleMesh) -> Vec<Corner> {
    let part = |t: usize| model.triangle_parts.as_ref().map_or(0, |parts| parts[t]);
    let mut fans: Vec<([i64; 3], u32, u32, Point3<f64>)> = Vec::with_capacity(3 * model.triangles.len());
    for (t, triangle) in model.triangles.iter().enumerate() {
        for v in triangle {
            let p = model.vertices[*v as usize];
            fans.push(([p.x, p.y, p.z].map(|c| (c * 1e5).round() as i64), part(t), t as u32, p));
        }
    }
    fans.sort_unstable_by_key(|a| (a.0, a.1, a.2));
    let mut corners = Vec::new();
    for fan in fans.chunk_by(|a, b| a.0 == b.0 && a.1 == b.1) {
        let mut normals: Vec<Vector3<f64>> = Vec::new();
        for &(_, _, t, _) in fan {
            let n = model.scaled_normal(t as usize);
            if n.norm() > 0.0 && !normals.iter().any(|m| m.dot(&n.normalize()) > 0.95) && normals.len() < 8 {
                normals.push(n.normalize());
            }
        }
        let mut squareness = 0.0f64;
        for (i, a) in normals.iter().enumerate() {
            for (j, b) in normals.iter().enumerate().skip(i + 1) {
                for c in &normals[j + 1..] {
                    squareness = squareness.max(Matrix3::from_columns(&[*a, *b, *c]).determinant().abs());
                }
            }
        }
        corners.push(Corner { point: fan[0].3, part: fan[0].1, squareness });
    }
    corners.sort_by(|a, b| b.squareness.total_cmp(&a.squareness));
    let square = corners.partition_point(|c| c.squareness > 0.5);
    corners.truncate(square.max(corners.len().div_ceil(2).min(200)));
    corners
}

/// A camera that the annotator may click in.
pub(crate) struct ClickView {
    pub frame: FrameId,
    pub intrinsics: Intrinsics,
    pub size: ImageSize,
    pub distortion: Distortion,
    pub object_from_cam: Rigid3<Object, mb_geometry::Camera>,
}

/// How many frames the annotator opens.
const FRAMES: usize = 4;

/// Clicks `count` points, spread over up to four frames round the object, with normal errors of `noise_px`.
///
/// A point is clicked where the model's rendering shows it: its pixel or one beside it has its depth.
pub(crate) fn click(
    stage: &Stage,
    model: &TriangleMesh,
    views: &[ClickView],
    count: usize,
    noise_px: f64,
    seed: u64,
    progress: &dyn Progress,
) -> Result<Keypoints> {
    let corners = corners(model);
    let opened = FRAMES.min(views.len()).min(count.max(1));
    let steps = Steps::new(progress, "keypoints", opened);
    let mut keypoints = Vec::with_capacity(count);
    for k in 0..opened {
        let view = &views[k * views.len() / opened];
        let mut rng = rng(seed, streams::CLICKS + k as u64);
        let mut visible = visible_corners(stage, &corners, view);
        let wanted = count * (k + 1) / opened - count * k / opened;
        for _ in 0..wanted {
            // The best of a few at random, far in the image from those already clicked in this frame.
            let clicked: Vec<Point2<f64>> =
                keypoints.iter().filter(|c: &&Keypoint| c.frame == view.frame).map(|c| c.pixel).collect();
            let apart = |pixel: &Point2<f64>| clicked.iter().map(|c| (c - pixel).norm()).fold(f64::INFINITY, f64::min);
            let Some(best) = (0..24.min(visible.len()))
                .map(|_| rng.random_range(0..visible.len()))
                .max_by(|a, b| apart(&visible[*a].1).total_cmp(&apart(&visible[*b].1)))
            else {
                break;
            };
            let (corner, pixel) = visible.swap_remove(best);
            let error = nalgebra::Vector2::new(normal(&mut rng), normal(&mut rng)) * noise_px;
            keypoints.push(Keypoint {
                frame: view.frame,
                pixel: view.distortion.distorted(&view.intrinsics, &pixel) + error,
                point_in_object_m: corner.point,
                name: format!("corner of part {}", corner.part),
            });
        }
        steps.step()?;
    }
    Ok(Keypoints {
        version: 1,
        author: format!("mobilebrick {} simulated annotator", env!("CARGO_PKG_VERSION")),
        time: String::new(),
        keypoints,
    })
}

/// The corners that a view shows, with their exact pixels.
fn visible_corners(stage: &Stage, corners: &[Corner], view: &ClickView) -> Vec<(Corner, Point2<f64>)> {
    let cam_from_object = view.object_from_cam.inverse();
    let depth = stage
        .scene
        .render(&View { intrinsics: view.intrinsics, size: view.size, cam_from_frame: cam_from_object })
        .depth;
    let margin = 8.0;
    corners
        .iter()
        .filter_map(|corner| {
            let p = cam_from_object * corner.point;
            let pixel = view.intrinsics.img_from_cam(&p)?;
            let (x, y) = (pixel.x.round(), pixel.y.round());
            let inside = x >= margin
                && y >= margin
                && x < view.size.width as f64 - margin
                && y < view.size.height as f64 - margin;
            if !inside {
                return None;
            }
            let (x, y) = (x as usize, y as usize);
            // At a corner the pixel's own centre may fall beside the part.
            let seen = (y - 1..=y + 1)
                .flat_map(|v| (x - 1..=x + 1).map(move |u| (u, v)))
                .any(|at| (f64::from(depth[at]) - p.z).abs() < 4e-4);
            // Nothing may stand before it.
            let covered = f64::from(depth[(x, y)]) < p.z - 4e-4;
            (seen && !covered).then_some((*corner, pixel))
        })
        .collect()
}
