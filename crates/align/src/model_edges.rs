//! The edges of a model that a photograph may show: creases, borders of colours, and contours.

use mb_geometry::{Camera, ImageSize, Intrinsics, Object, Rigid3};
use mb_job::rng;
use mb_mesh::TriangleMesh;
use mb_render::{NO_TRIANGLE, Raster, Scene, View};
use nalgebra::{Point2, Point3, Unit, Vector2, Vector3};
use rand::RngExt;
use rand::seq::SliceRandom;

/// Edges whose faces meet at less than this angle are flat: an artefact of the triangulation.
const FLAT_RAD: f64 = 0.1;
/// Distance between samples of an edge, metres.
const SPACING_M: f64 = 1e-3;
/// Samples kept of a model; more make no difference to the result.
const MAX_SAMPLES: usize = 120_000;

/// A point on an edge of the model.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EdgeSample {
    pub point_in_object: Point3<f64>,
    pub direction: Unit<Vector3<f64>>,
    /// Which edge; samples of one edge err together.
    pub edge: u32,
    /// From the edge into each of its two faces, across it; zero where there are not two.
    into_faces: [Vector3<f64>; 2],
}

/// What a view shows on the two sides of an edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum EdgeKind {
    /// The model before what is behind it.
    Silhouette,
    /// A surface of the model before another one.
    Contour,
    /// Two parts that touch: a photograph shows the dark gap between them.
    Seam,
    /// Two faces of a part: a photograph may show a bright line where the edge is rounded.
    Crease,
}

impl EdgeKind {
    pub const COUNT: usize = 4;
}

/// An edge sample as a view shows it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct VisibleSample {
    pub sample: EdgeSample,
    pub kind: EdgeKind,
    pub pixel: Point2<f64>,
    /// Across the edge in the image, unit length.
    pub normal: Vector2<f64>,
}

/// A model prepared for comparing its edges with photographs.
pub(crate) struct ModelEdges {
    scene: Scene,
    /// Unit normals of the triangles; zero where degenerate.
    normals: Vec<Vector3<f64>>,
    colors: Option<Vec<[u8; 3]>>,
    parts: Option<Vec<u32>>,
    samples: Vec<EdgeSample>,
    pub centroid_in_object: Point3<f64>,
}

impl ModelEdges {
    /// Finds every edge at which two faces of a part meet at an angle, or that only one face has, and spreads samples
    /// over them in random order (which edges of a dense model are kept does not depend on their order in the file).
    pub fn new(mesh: &TriangleMesh, seed: u64) -> Self {
        let normals: Vec<Vector3<f64>> = (0..mesh.triangles.len())
            .map(|t| mesh.scaled_normal(t).try_normalize(1e-18).unwrap_or_else(Vector3::zeros))
            .collect();
        // (part, lower corner, upper corner, triangle), so that sorting brings the faces of an edge together.
        let corner_ids = weld(mesh);
        let mut sides: Vec<(u32, u32, u32, u32)> = Vec::with_capacity(mesh.triangles.len() * 3);
        for (t, triangle) in mesh.triangles.iter().enumerate() {
            let part = mesh.triangle_parts.as_ref().map_or(0, |parts| parts[t]);
            for k in 0..3 {
                let (a, b) = (corner_ids[triangle[k] as usize], corner_ids[triangle[(k + 1) % 3] as usize]);
                if a != b {
                    sides.push((part, a.min(b), a.max(b), t as u32));
                }
            }
        }
        sides.sort_unstable();
        let mut edges: Vec<(u32, u32, [u32; 2])> = sides
            .chunk_by(|a, b| (a.0, a.1, a.2) == (b.0, b.1, b.2))
            .filter(|faces| {
                let first = &normals[faces[0].3 as usize];
                faces.len() == 1 || faces[1..].iter().any(|f| normals[f.3 as usize].dot(first).abs() < FLAT_RAD.cos())
            })
            .map(|faces| {
                let two = if faces.len() == 2 { [faces[0].3, faces[1].3] } else { [NO_TRIANGLE; 2] };
                (faces[0].1, faces[0].2, two)
            })
            .collect();
        edges.shuffle(&mut rng(seed, 0));
        let mut lots = rng(seed, 2);
        let mut samples = Vec::new();
        for (edge, &(a, b, faces)) in edges.iter().enumerate() {
            let (a, b) = (mesh.vertices[a as usize], mesh.vertices[b as usize]);
            let Some(direction) = Unit::try_new(b - a, 1e-9) else { continue };
            let into_faces = faces.map(|t| {
                let Some(corners) = mesh.triangles.get(t as usize) else { return Vector3::zeros() };
                // From the edge to the face's middle, less the part along the edge.
                let middle = corners.iter().map(|v| mesh.vertices[*v as usize].coords).sum::<Vector3<f64>>() / 3.0;
                let to_middle = middle - a.coords;
                to_middle - *direction * direction.dot(&to_middle)
            });
            // Short edges are drawn by lot, so that finely modelled parts have no more samples than their length's worth.
            let count = ((b - a).norm() / SPACING_M + lots.random::<f64>()).floor().min(1000.0) as usize;
            for i in 0..count {
                let along = (i as f64 + 0.5) / count as f64;
                let point_in_object = a + (b - a) * along;
                samples.push(EdgeSample { point_in_object, direction, edge: edge as u32, into_faces });
            }
        }
        samples.shuffle(&mut rng(seed, 1));
        Self {
            scene: Scene::new(mesh),
            normals,
            colors: mesh.triangle_colors.clone(),
            parts: mesh.triangle_parts.clone(),
            samples,
            centroid_in_object: mesh.bounds().center(),
        }
    }

    /// Leaves only the samples that some of `views` shows, so that hidden ones cost nothing later.
    pub fn keep_visible(&mut self, views: &[View<Object>]) {
        let mut seen = vec![false; self.samples.len()];
        for view in views {
            let raster = self.scene.render(view);
            for (seen, sample) in seen.iter_mut().zip(&self.samples) {
                *seen = *seen || self.visible(sample, view, &raster).is_some();
            }
        }
        let mut seen = seen.into_iter();
        self.samples.retain(|_| seen.next().unwrap_or(false));
        self.samples.truncate(MAX_SAMPLES);
    }

    /// Up to `limit` samples that the view shows as an edge; first those with no other edge of the model beside them, whose
    /// images nothing pulls to one side.
    pub fn visible_samples(&self, view: &View<Object>, limit: usize) -> Vec<VisibleSample> {
        let raster = self.scene.render(view);
        let (mut alone, mut crowded) = (Vec::new(), Vec::new());
        for visible in self.samples.iter().filter_map(|s| self.visible(s, view, &raster)) {
            if self.is_alone(&visible, view, &raster) {
                alone.push(visible);
            } else {
                crowded.push(visible);
            }
            if alone.len() == limit || alone.len() + crowded.len() == LOOKED_AT * limit {
                break;
            }
        }
        // Where nearly everything is crowded (small or far models, coarse pictures) crowded ones are better than none.
        let wanted = (limit / 2).saturating_sub(alone.len()).min(crowded.len());
        alone.extend_from_slice(&crowded[..wanted]);
        alone
    }

    fn visible(&self, sample: &EdgeSample, view: &View<Object>, raster: &Raster) -> Option<VisibleSample> {
        let p = view.cam_from_frame * sample.point_in_object;
        let pixel = view.intrinsics.img_from_cam(&p)?;
        let margin = BESIDE_PX + 1.0;
        let inside = |v: f64, count: usize| v >= margin && v <= count as f64 - 1.0 - margin;
        if !inside(pixel.x, view.size.width) || !inside(pixel.y, view.size.height) {
            return None;
        }
        let normal = image_normal(&view.intrinsics, &view.cam_from_frame, sample, &p)?;
        let sides = [ASIDE_PX, -ASIDE_PX].map(|by| Look::new(raster, &(pixel + normal * by)));
        // One pixel of depth at this distance, as wide as the two looks are apart, on a steep face.
        let tolerance = 8.0 * p.z / view.intrinsics.fx + 1e-4;
        let shows = |look: &Look| look.triangle != NO_TRIANGLE && (look.z - p.z).abs() < tolerance;
        let covers = |look: &Look| look.triangle != NO_TRIANGLE && look.z < p.z - tolerance;
        if sides.iter().any(covers) || !sides.iter().any(shows) {
            return None;
        }
        let kind = self.edge_between(&sides[0], &sides[1], view)?;
        if matches!(kind, EdgeKind::Silhouette | EdgeKind::Contour) {
            // The outline of a round part lies where its facets turn away; other edges of facets are a pixel beside it.
            let faces = sample.into_faces.map(|into| {
                let into = view.cam_from_frame.rotate(&into);
                let k = &view.intrinsics;
                normal.dot(&Vector2::new(k.fx * (into.x * p.z - into.z * p.x), k.fy * (into.y * p.z - into.z * p.y)))
            });
            if faces[0] * faces[1] < 0.0 {
                return None;
            }
        }
        Some(VisibleSample { sample: *sample, kind, pixel, normal })
    }

    /// Whether no other edge crosses the line across the sample's within [`BESIDE_PX`].
    fn is_alone(&self, visible: &VisibleSample, view: &View<Object>, raster: &Raster) -> bool {
        [1.0, -1.0].into_iter().all(|sign| {
            let looks = [ASIDE_PX, 0.5 * (ASIDE_PX + BESIDE_PX), BESIDE_PX]
                .map(|by| Look::new(raster, &(visible.pixel + visible.normal * (sign * by))));
            looks.windows(2).all(|pair| self.edge_between(&pair[0], &pair[1], view).is_none())
        })
    }

    /// What a photograph may show between two pixels.
    fn edge_between(&self, a: &Look, b: &Look, view: &View<Object>) -> Option<EdgeKind> {
        /// Steps in depth below this are no contour, metres.
        const STEP_M: f64 = 5e-4;
        if a.triangle == b.triangle {
            return None;
        }
        if a.triangle == NO_TRIANGLE || b.triangle == NO_TRIANGLE {
            return Some(EdgeKind::Silhouette);
        }
        let (t_a, t_b) = (a.triangle as usize, b.triangle as usize);
        let (n_a, n_b) = (self.normals[t_a], self.normals[t_b]);
        let way = view.intrinsics.cam_from_img(&a.pixel, a.z) - view.intrinsics.cam_from_img(&b.pixel, b.z);
        let step = view.cam_from_frame.rotate(&n_b).dot(&way).abs();
        let recolored = || self.colors.as_ref().is_some_and(|c| c[t_a] != c[t_b]);
        if step > STEP_M {
            Some(EdgeKind::Contour)
        } else if self.parts.as_ref().is_some_and(|parts| parts[t_a] != parts[t_b]) {
            Some(EdgeKind::Seam)
        } else if n_a.dot(&n_b).abs() < 0.9 || recolored() {
            Some(EdgeKind::Crease)
        } else {
            None
        }
    }
}

/// Distance from an edge at which its two sides are looked at, pixels.
const ASIDE_PX: f64 = 1.6;
/// Distance from an edge within which another one would pull its image, pixels: the reach of a photograph's blur and
/// sharpening.
const BESIDE_PX: f64 = 4.0;
/// How many times more samples are looked at than wanted, in search of those that stand alone.
const LOOKED_AT: usize = 4;

/// What a rendering has at a pixel.
struct Look {
    pixel: Point2<f64>,
    z: f64,
    triangle: u32,
}

impl Look {
    fn new(raster: &Raster, at: &Point2<f64>) -> Self {
        let (x, y) = (at.x.round() as usize, at.y.round() as usize);
        let pixel = Point2::new(x as f64, y as f64);
        Self { pixel, z: f64::from(raster.depth[(x, y)]), triangle: raster.triangle[(x, y)] }
    }
}

/// The direction across a sample's edge in the image; `None` where the edge points at the camera.
pub(crate) fn image_normal(
    k: &Intrinsics,
    cam_from_object: &Rigid3<Camera, Object>,
    sample: &EdgeSample,
    p_in_cam: &Point3<f64>,
) -> Option<Vector2<f64>> {
    let d = cam_from_object.rotate(&sample.direction);
    let along =
        Vector2::new(k.fx * (d.x * p_in_cam.z - d.z * p_in_cam.x), k.fy * (d.y * p_in_cam.z - d.z * p_in_cam.y));
    // Shorter than a fifth of an edge seen square on: too foreshortened to have a direction.
    let shortest = 0.2 * k.fx * p_in_cam.z;
    (along.norm() > shortest).then(|| Vector2::new(-along.y, along.x).normalize())
}

/// For each vertex, the first vertex at the same place (to a micrometre).
fn weld(mesh: &TriangleMesh) -> Vec<u32> {
    let key = |v: u32| mesh.vertices[v as usize].coords.map(|c| (c * 1e6).round() as i64);
    let mut order: Vec<u32> = (0..mesh.vertices.len() as u32).collect();
    order.sort_unstable_by_key(|&v| {
        let k = key(v);
        (k.x, k.y, k.z, v)
    });
    let mut ids = vec![0; mesh.vertices.len()];
    for group in order.chunk_by(|&a, &b| key(a) == key(b)) {
        for &v in group {
            ids[v as usize] = group[0];
        }
    }
    ids
}

/// A view of the object at `1 / 2^level` of the photograph's size.
pub(crate) fn view_at(
    intrinsics: &Intrinsics,
    size: ImageSize,
    cam_from_object: &Rigid3<Camera, Object>,
    level: usize,
) -> View<Object> {
    let scale = 1.0 / f64::from(1u32 << level);
    let intrinsics = Intrinsics {
        fx: intrinsics.fx * scale,
        fy: intrinsics.fy * scale,
        cx: (intrinsics.cx + 0.5) * scale - 0.5,
        cy: (intrinsics.cy + 0.5) * scale - 0.5,
    };
    let size = ImageSize::new(size.width >> level, size.height >> level);
    View { intrinsics, size, cam_from_frame: *cam_from_object }
}
