//! What a sequence says about its scene beyond the true surface: cameras, which way is up, where studs are.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use mb_capture::Sequence;
use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
use mb_job::Result;
use mb_mesh::{KdTree, TriangleMesh};
use nalgebra::{Point3, Vector3};

/// Radius of a stud, metres.
const RADIUS_M: f64 = 0.0024;
/// Height of a stud, metres.
const HEIGHT_M: f64 = 0.0016;

/// The scene of a sequence; each part is empty where the sequence does not say.
#[derive(Debug, Clone, Default)]
pub(super) struct Setting {
    /// The cameras, with aligned poses where there are some.
    pub cameras: Vec<Viewpoint>,
    /// Up in the object's frame, unit length. Needs an alignment.
    pub up_in_world: Option<Vector3<f64>>,
    /// The studs of the model. Needs the model and an alignment.
    pub studs: Vec<Stud>,
    /// Why something is missing that was there in part.
    pub notes: Vec<String>,
}

/// A camera that filmed.
#[derive(Debug, Clone)]
pub(super) struct Viewpoint {
    pub intrinsics: Intrinsics,
    pub cam_from_world: Rigid3<Camera, World>,
    pub size: ImageSize,
}

impl Viewpoint {
    /// The camera's centre, where the point falls into its image.
    pub fn sees(&self, p_in_world: &Point3<f64>) -> Option<Point3<f64>> {
        let pixel = self.intrinsics.img_from_cam(&(self.cam_from_world * *p_in_world))?;
        let inside = |v: f64, length: usize| v >= -0.5 && v < length as f64 - 0.5;
        let seen = inside(pixel.x, self.size.width) && inside(pixel.y, self.size.height);
        seen.then(|| Point3::from(self.cam_from_world.inverse().translation()))
    }
}

/// A stud of a brick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Stud {
    /// Middle of its foot.
    pub foot: Point3<f64>,
    /// Unit vector to its tip.
    pub axis: Vector3<f64>,
}

impl Stud {
    /// Whether a surface point belongs to it: inside the cylinder with 0.05 mm to spare, above the foot.
    fn holds(&self, p: &Point3<f64>) -> bool {
        const SPARE_M: f64 = 5e-5;
        let arm = p - self.foot;
        let height = arm.dot(&self.axis);
        let radius = (arm - self.axis * height).norm();
        height > SPARE_M / 2.0 && height < HEIGHT_M + SPARE_M && radius < RADIUS_M + SPARE_M
    }
}

impl Setting {
    /// Reads what is there. A sequence that is only ground truth has no setting, which is no fault; what is there and
    /// damaged is noted.
    pub fn read(folder: &Path) -> Self {
        let mut setting = Self::default();
        if !folder.join("pose").is_dir() {
            return setting;
        }
        if let Err(error) = setting.fill(folder) {
            setting.notes.push(format!("no breakdown by region or view: {error}"));
        }
        setting
    }

    fn fill(&mut self, folder: &Path) -> Result<()> {
        let sequence = Sequence::open(folder)?;
        let aligned = folder.join(mb_capture::Alignment::FILE).exists();
        let alignment = if aligned { Some(sequence.read_alignment()?) } else { None };
        let frames = match &alignment {
            Some(alignment) => sequence.aligned_frames(alignment),
            None => sequence.frames().to_vec(),
        };
        let size = sequence.image_size();
        self.cameras = frames
            .iter()
            .map(|f| Viewpoint { intrinsics: f.intrinsics, cam_from_world: f.world_from_cam.inverse(), size })
            .collect();
        let Some(alignment) = alignment else { return Ok(()) };
        self.up_in_world = Some(alignment.world_from_object.rotate(&Vector3::y()));
        if sequence.model_mesh_path().exists() {
            let model = mb_mesh::read_mesh(sequence.model_mesh_path())?;
            let place = |stud: Stud| Stud {
                foot: alignment.world_from_object * stud.foot,
                axis: alignment.world_from_object.rotate(&stud.axis),
            };
            self.studs = find_studs(&model).into_iter().map(place).collect();
        }
        Ok(())
    }
}

/// Finds the stud that a point of the surface belongs to.
pub(super) struct StudFinder<'a> {
    studs: &'a [Stud],
    middles: KdTree,
}

impl<'a> StudFinder<'a> {
    pub fn new(studs: &'a [Stud]) -> Self {
        let middles: Vec<Point3<f64>> = studs.iter().map(|s| s.foot + s.axis * (HEIGHT_M / 2.0)).collect();
        Self { studs, middles: KdTree::new(&middles) }
    }

    pub fn is_on_stud(&self, p: &Point3<f64>) -> bool {
        let reach = RADIUS_M.hypot(HEIGHT_M);
        self.middles.nearest_within(p, reach).is_some_and(|(stud, _)| self.studs[stud].holds(p))
    }
}

/// Finds studs by their tips: flat discs or rings of a stud's radius. `model` is in metres, its faces carry parts.
///
/// A disc of this radius that is no stud, such as the end of an axle, is taken for one.
fn find_studs(model: &TriangleMesh) -> Vec<Stud> {
    // Rounded off the usual grid of models, so that equal numbers do not fall on both sides of a border.
    let cell = |v: f64, step: f64| (v / step + 0.31).round() as i64;
    let mut planes: BTreeMap<(u32, [i64; 4]), Vec<usize>> = BTreeMap::new();
    for t in 0..model.triangles.len() {
        let Some(normal) = model.scaled_normal(t).try_normalize(0.0) else { continue };
        let offset = normal.dot(&model.triangle(t)[0].coords);
        let part = model.triangle_parts.as_ref().map_or(0, |parts| parts[t]);
        let key = [cell(normal.x, 1e-3), cell(normal.y, 1e-3), cell(normal.z, 1e-3), cell(offset, 1e-5)];
        planes.entry((part, key)).or_default().push(t);
    }
    planes.values().flat_map(|triangles| discs(model, triangles, cell)).collect()
}

/// The tips of studs among triangles of one plane.
fn discs(model: &TriangleMesh, triangles: &[usize], cell: impl Fn(f64, f64) -> i64) -> Vec<Stud> {
    // Triangles that share a corner belong together.
    let mut corner_at: HashMap<[i64; 3], usize> = HashMap::new();
    let mut groups = Groups::new(triangles.len());
    for (i, &t) in triangles.iter().enumerate() {
        for corner in model.triangle(t) {
            let key = [cell(corner.x, 1e-6), cell(corner.y, 1e-6), cell(corner.z, 1e-6)];
            let first = *corner_at.entry(key).or_insert(i);
            groups.join(first, i);
        }
    }
    let mut pieces: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (i, &t) in triangles.iter().enumerate() {
        pieces.entry(groups.root(i)).or_default().push(t);
    }
    pieces.values().filter_map(|piece| disc(model, piece)).collect()
}

fn disc(model: &TriangleMesh, piece: &[usize]) -> Option<Stud> {
    let normal = model.scaled_normal(piece[0]).normalize();
    let corners: Vec<Point3<f64>> = piece.iter().flat_map(|&t| model.triangle(t)).collect();
    // The middle of the box in the plane: corners repeat, so their mean would lean.
    let side = normal.cross(&if normal.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() }).normalize();
    let middle_along = |axis: &Vector3<f64>| {
        let along = corners.iter().map(|c| axis.dot(&c.coords));
        let (low, high) = along.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        0.5 * (low + high)
    };
    let other = normal.cross(&side);
    let middle = Point3::from(
        side * middle_along(&side) + other * middle_along(&other) + normal * normal.dot(&corners[0].coords),
    );
    let reach = corners.iter().map(|c| (c - middle).norm()).fold(0.0, f64::max);
    let area: f64 = piece.iter().map(|&t| 0.5 * model.scaled_normal(t).norm()).sum();
    let round = (reach - RADIUS_M).abs() < 5e-5 && area > 0.4 * std::f64::consts::PI * RADIUS_M * RADIUS_M;
    round.then(|| Stud { foot: middle - normal * HEIGHT_M, axis: normal })
}

/// Disjoint sets of the numbers 0..n.
pub(super) struct Groups {
    parent: Vec<u32>,
}

impl Groups {
    /// Every number by itself.
    pub fn new(n: usize) -> Self {
        Self { parent: (0..n as u32).collect() }
    }

    /// The smallest number of the set that holds `i`.
    pub fn root(&mut self, i: usize) -> usize {
        let mut i = i as u32;
        while self.parent[i as usize] != i {
            self.parent[i as usize] = self.parent[self.parent[i as usize] as usize];
            i = self.parent[i as usize];
        }
        i as usize
    }

    /// Makes one set of two.
    pub fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.parent[a.max(b)] = a.min(b) as u32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A stud of 16 sides on a plate of 8 mm, its axis along y.
    fn plate_with_stud(radius: f64) -> TriangleMesh {
        let (y, turn) = (0.0032, std::f64::consts::TAU / 16.0);
        let ring = |height: f64| {
            (0..16).map(move |i| {
                let angle = f64::from(i) * turn;
                Point3::new(0.004 + radius * angle.cos(), height, 0.004 + radius * angle.sin())
            })
        };
        let mut vertices: Vec<_> = ring(y).chain(ring(y + HEIGHT_M)).collect();
        let mut triangles = Vec::new();
        for i in 0..16u32 {
            let next = (i + 1) % 16;
            triangles.extend([[i, i + 16, next], [next, i + 16, next + 16]]);
        }
        triangles.extend((1..15).map(|i| [16, 16 + i + 1, 16 + i]));
        let first = vertices.len() as u32;
        vertices.extend([[0.0, 0.0], [0.008, 0.0], [0.008, 0.008], [0.0, 0.008]].map(|[x, z]| Point3::new(x, y, z)));
        triangles.extend([[first, first + 2, first + 1], [first, first + 3, first + 2]]);
        TriangleMesh::new(vertices, triangles)
    }

    #[test]
    fn a_stud_is_found_by_its_tip_and_other_discs_are_not() {
        let studs = find_studs(&plate_with_stud(RADIUS_M));
        assert_eq!(studs.len(), 1);
        assert!((studs[0].foot - Point3::new(0.004, 0.0032, 0.004)).norm() < 1e-5, "{:?}", studs[0]);
        assert!((studs[0].axis - Vector3::y()).norm() < 1e-9);
        assert!(find_studs(&plate_with_stud(0.003)).is_empty());
        let finder = StudFinder::new(&studs);
        assert!(finder.is_on_stud(&Point3::new(0.004, 0.0048, 0.005)));
        assert!(finder.is_on_stud(&Point3::new(0.004, 0.004, 0.0064)));
        assert!(!finder.is_on_stud(&Point3::new(0.004, 0.0032, 0.0075)));
        assert!(!StudFinder::new(&[]).is_on_stud(&Point3::origin()));
    }
}
