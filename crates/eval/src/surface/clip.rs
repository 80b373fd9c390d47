//! Triangles cut at the border of the visible volume.

use mb_capture::VisibilityVolume;
use mb_mesh::TriangleMesh;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// Triangles cut by one task.
const CHUNK: usize = 16_384;

/// The part of a mesh inside a visibility volume.
pub(super) struct Clipped {
    /// The pieces, in the order of the triangles that they come from.
    pub mesh: TriangleMesh,
    /// `[T]` the triangle of the uncut mesh that each piece comes from.
    pub source: Vec<u32>,
}

/// Cuts meshes at the faces of the voxels: a voxel is the cube of points that are nearest to its centre.
pub(super) struct Clipper<'a> {
    volume: &'a VisibilityVolume,
    /// `[X + 1, Y + 1, Z + 1]`, C order: number of visible voxels below each corner.
    visible_below: Vec<u32>,
}

/// Voxel indices, both included. Index -1 and index N stand for all that lies before and behind the volume.
#[derive(Clone, Copy)]
struct Block {
    from: [i64; 3],
    to: [i64; 3],
}

impl Block {
    /// The smallest block that holds some voxels, at least one.
    fn around(voxels: impl IntoIterator<Item = [i64; 3]>) -> Self {
        let mut block = Self { from: [i64::MAX; 3], to: [i64::MIN; 3] };
        for voxel in voxels {
            for axis in 0..3 {
                block.from[axis] = block.from[axis].min(voxel[axis]);
                block.to[axis] = block.to[axis].max(voxel[axis]);
            }
        }
        block
    }
}

enum Kind {
    Visible,
    Hidden,
    Mixed,
}

impl<'a> Clipper<'a> {
    /// # Panics
    /// Never for volumes that were read: they have less than 2^32 voxels that a computer could hold.
    pub fn new(volume: &'a VisibilityVolume) -> Self {
        let [nx, ny, nz] = volume.resolutions;
        let (sy, sx) = (nz + 1, (ny + 1) * (nz + 1));
        let mut below = vec![0u32; (nx + 1) * sx];
        for x in 0..nx {
            for y in 0..ny {
                let mut row = 0u32;
                for z in 0..nz {
                    row += u32::from(volume.mask[volume.index([x, y, z])]);
                    let at = (x + 1) * sx + (y + 1) * sy + z + 1;
                    below[at] = row + below[at - sx] + below[at - sy] - below[at - sx - sy];
                }
            }
        }
        Self { volume, visible_below: below }
    }

    /// Whether a point lies inside the visible volume.
    pub fn contains(&self, p_in_world: &Point3<f64>) -> bool {
        self.volume.contains(p_in_world)
    }

    /// The part of `mesh` inside the visible volume. Pieces keep their winding.
    pub fn clip(&self, mesh: &TriangleMesh) -> Clipped {
        /// What is left of some triangles: those kept whole, and the pieces of those that were cut.
        #[derive(Default)]
        struct Rest {
            whole: Vec<u32>,
            cut: Vec<(u32, [Point3<f64>; 3])>,
        }
        // A vertex has some six triangles: its voxel is looked up once.
        let voxels: Vec<[i32; 3]> =
            mesh.vertices.par_iter().map(|p| self.index_of(&self.voxel_of(p)).map(|i| i as i32)).collect();
        let clip_chunk = |chunk: usize| {
            let mut rest = Rest::default();
            let mut pieces = Vec::new();
            for t in chunk * CHUNK..((chunk + 1) * CHUNK).min(mesh.triangles.len()) {
                let block = Block::around(mesh.triangles[t].map(|v| voxels[v as usize].map(i64::from)));
                match self.kind(&block) {
                    Kind::Visible => rest.whole.push(t as u32),
                    Kind::Hidden => {}
                    Kind::Mixed => {
                        pieces.clear();
                        let polygon = mesh.triangle(t).map(|p| self.voxel_of(&p)).to_vec();
                        self.cut(polygon, block, &mut pieces);
                        for polygon in &pieces {
                            let at = |i: usize| self.point_of(&polygon[i]);
                            let fan = (1..polygon.len() - 1).map(|i| [at(0), at(i), at(i + 1)]);
                            rest.cut.extend(fan.map(|corners| (t as u32, corners)));
                        }
                    }
                }
            }
            rest
        };
        let chunks: Vec<Rest> = (0..mesh.triangles.len().div_ceil(CHUNK)).into_par_iter().map(clip_chunk).collect();

        const UNUSED: u32 = u32::MAX;
        let mut new_index = vec![UNUSED; mesh.vertices.len()];
        let mut clipped = Clipped { mesh: TriangleMesh::default(), source: Vec::new() };
        let (vertices, triangles) = (&mut clipped.mesh.vertices, &mut clipped.mesh.triangles);
        for rest in chunks {
            let mut cut = rest.cut.into_iter().peekable();
            let mut add_cut_before =
                |limit: u32, vertices: &mut Vec<_>, triangles: &mut Vec<_>, source: &mut Vec<_>| {
                    while let Some((t, corners)) = cut.next_if(|(t, _)| *t < limit) {
                        let first = vertices.len() as u32;
                        vertices.extend(corners);
                        triangles.push([first, first + 1, first + 2]);
                        source.push(t);
                    }
                };
            for t in rest.whole {
                add_cut_before(t, vertices, triangles, &mut clipped.source);
                triangles.push(mesh.triangles[t as usize].map(|v| {
                    let index = &mut new_index[v as usize];
                    if *index == UNUSED {
                        *index = vertices.len() as u32;
                        vertices.push(mesh.vertices[v as usize]);
                    }
                    *index
                }));
                clipped.source.push(t);
            }
            add_cut_before(UNUSED, vertices, triangles, &mut clipped.source);
        }
        clipped
    }

    /// A point in units of voxels: voxel i reaches from i - 0.5 to i + 0.5.
    fn voxel_of(&self, p_in_world: &Point3<f64>) -> Vector3<f64> {
        (p_in_world - self.volume.min_pt_in_world) / self.volume.voxel_size_m
    }

    fn point_of(&self, voxel: &Vector3<f64>) -> Point3<f64> {
        self.volume.min_pt_in_world + voxel * self.volume.voxel_size_m
    }

    /// The voxel that holds a point.
    fn index_of(&self, voxel: &Vector3<f64>) -> [i64; 3] {
        let along = |axis: usize| ((voxel[axis] + 0.5).floor() as i64).clamp(-1, self.volume.resolutions[axis] as i64);
        [0, 1, 2].map(along)
    }

    fn kind(&self, block: &Block) -> Kind {
        let resolutions = self.volume.resolutions;
        // Corners of the part of the block inside the volume, upper ones excluded.
        let low: [usize; 3] = std::array::from_fn(|a| block.from[a].max(0) as usize);
        let high: [usize; 3] = std::array::from_fn(|a| ((block.to[a] + 1).max(0) as usize).min(resolutions[a]));
        if (0..3).any(|a| low[a] >= high[a]) {
            return Kind::Hidden;
        }
        let at = |x: usize, y: usize, z: usize| {
            i64::from(self.visible_below[(x * (resolutions[1] + 1) + y) * (resolutions[2] + 1) + z])
        };
        let ([x0, y0, z0], [x1, y1, z1]) = (low, high);
        let visible = at(x1, y1, z1) - at(x0, y1, z1) - at(x1, y0, z1) - at(x1, y1, z0)
            + at(x0, y0, z1)
            + at(x0, y1, z0)
            + at(x1, y0, z0)
            - at(x0, y0, z0);
        let voxels: i64 = (0..3).map(|a| block.to[a] - block.from[a] + 1).product();
        match visible {
            0 => Kind::Hidden,
            v if v == voxels => Kind::Visible,
            _ => Kind::Mixed,
        }
    }

    /// Collects the parts of a convex polygon that lie in visible voxels, halving the block until it is uniform.
    fn cut(&self, polygon: Vec<Vector3<f64>>, block: Block, visible: &mut Vec<Vec<Vector3<f64>>>) {
        match self.kind(&block) {
            Kind::Visible => visible.push(polygon),
            Kind::Hidden => {}
            Kind::Mixed => {
                let length = |axis: usize| block.to[axis] - block.from[axis];
                let axis = (0..3).max_by_key(|&axis| length(axis)).expect("three axes");
                let middle = block.from[axis] + length(axis) / 2;
                let plane = middle as f64 + 0.5;
                for (sign, low) in [(1.0, true), (-1.0, false)] {
                    let half = half_of(&polygon, axis, plane, sign);
                    if half.len() >= 3 {
                        let mut half_block = block;
                        if low {
                            half_block.to[axis] = middle;
                        } else {
                            half_block.from[axis] = middle + 1;
                        }
                        // The half may touch fewer voxels than its block, but by rounding also none of them.
                        let touched = Block::around(half.iter().map(|v| self.index_of(v)));
                        for a in 0..3 {
                            half_block.from[a] = half_block.from[a].max(touched.from[a]).min(half_block.to[a]);
                            half_block.to[a] = half_block.to[a].min(touched.to[a]).max(half_block.from[a]);
                        }
                        self.cut(half, half_block, visible);
                    }
                }
            }
        }
    }
}

/// The part of a convex polygon with `sign * v[axis] <= sign * plane` (Sutherland and Hodgman 1974).
fn half_of(polygon: &[Vector3<f64>], axis: usize, plane: f64, sign: f64) -> Vec<Vector3<f64>> {
    let mut half = Vec::with_capacity(polygon.len() + 1);
    for (i, a) in polygon.iter().enumerate() {
        let b = &polygon[(i + 1) % polygon.len()];
        let (side_a, side_b) = (sign * (a[axis] - plane), sign * (b[axis] - plane));
        if side_a <= 0.0 {
            half.push(*a);
        }
        if (side_a < 0.0 && side_b > 0.0) || (side_a > 0.0 && side_b < 0.0) {
            let mut crossing = a + (b - a) * (side_a / (side_a - side_b));
            crossing[axis] = plane;
            half.push(crossing);
        }
    }
    half
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn volume(resolutions: [usize; 3], visible: impl Fn([usize; 3]) -> bool) -> VisibilityVolume {
        let [nx, ny, nz] = resolutions;
        let cells = (0..nx * ny * nz).map(|i| visible([i / (ny * nz), i / nz % ny, i % nz]));
        VisibilityVolume {
            mask: cells.collect(),
            resolutions,
            voxel_size_m: 0.1,
            min_pt_in_world: Point3::new(0.05, 0.05, 0.05),
        }
    }

    /// A square in the plane z = 0.25, from -1 to 2.
    fn sheet() -> TriangleMesh {
        let corners = [[-1., -1., 0.25], [2., -1., 0.25], [2., 2., 0.25], [-1., 2., 0.25]].map(Point3::from);
        TriangleMesh::new(corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]])
    }

    #[test]
    fn a_large_triangle_keeps_exactly_its_visible_area() {
        // Ten by ten columns of which a checkerboard is visible: 50 squares of 0.01 m2.
        let board = volume([10, 10, 10], |[x, y, _]| (x + y) % 2 == 0);
        let clipped = Clipper::new(&board).clip(&sheet());
        assert!((clipped.mesh.area() - 0.5).abs() < 1e-12, "{}", clipped.mesh.area());
        let all = volume([10, 10, 10], |_| true);
        assert!((Clipper::new(&all).clip(&sheet()).mesh.area() - 1.0).abs() < 1e-12);
        let none = volume([10, 10, 10], |_| false);
        assert!(Clipper::new(&none).clip(&sheet()).mesh.triangles.is_empty());
    }

    #[test]
    fn what_is_wholly_visible_stays_as_it_is() {
        let mut mesh = sheet();
        mesh.vertices
            .iter_mut()
            .for_each(|v| *v = Point3::new(0.5, 0.5, 0.25) + (*v - Point3::new(0.5, 0.5, 0.25)) * 0.3);
        let all = volume([10, 10, 10], |_| true);
        let clipped = Clipper::new(&all).clip(&mesh);
        assert_eq!(clipped.mesh, mesh);
        assert_eq!(clipped.source, [0, 1]);
    }

    proptest! {
        /// Random triangles, some far larger than the volume: pieces cover what a fine sampling says is visible.
        #[test]
        fn pieces_are_visible_and_complete(
            corners in prop::array::uniform3(prop::array::uniform3(-0.5..1.0f64)),
            bits in prop::collection::vec(any::<bool>(), 125),
        ) {
            let volume = volume([5, 5, 5], |[x, y, z]| bits[x * 25 + y * 5 + z]);
            let mesh = TriangleMesh::new(corners.map(Point3::from).to_vec(), vec![[0, 1, 2]]);
            prop_assume!(mesh.area() > 1e-3);
            let clipped = Clipper::new(&volume).clip(&mesh);
            for t in 0..clipped.mesh.triangles.len() {
                let corners = clipped.mesh.triangle(t);
                if clipped.mesh.scaled_normal(t).norm() > 1e-9 {
                    prop_assert!(volume.contains(&Point3::from(corners.iter().map(|p| p.coords).sum::<Vector3<f64>>() / 3.0)));
                    prop_assert!(clipped.mesh.scaled_normal(t).dot(&mesh.scaled_normal(0)) > 0.0);
                }
            }
            let samples = mb_mesh::sample_uniform(&mesh, 20_000, 0);
            let share = samples.iter().filter(|s| volume.contains(&s.point)).count() as f64 / samples.len() as f64;
            prop_assert!((clipped.mesh.area() / mesh.area() - share).abs() < 0.02);
        }
    }
}
