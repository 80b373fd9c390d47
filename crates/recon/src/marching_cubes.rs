//! From distances to triangles.

use mb_mesh::TriangleMesh;
use nalgebra::Point3;
use rayon::prelude::*;

use crate::TsdfVolume;
use crate::cube_table::CubeTable;
use crate::volume::{Block, SIDE, VOXELS};

/// A block's voxels and the first layer of its upper neighbours, so that each cell finds its eight corners.
const PADDED: usize = SIDE + 1;
/// Vertices keep this share of an edge between themselves and its ends, so that no triangle collapses where a voxel
/// lies exactly on the surface.
const CLEAR_OF_CORNERS: f32 = 1e-3;
const NONE: u32 = u32::MAX;

fn padded_index(x: usize, y: usize, z: usize) -> usize {
    x + PADDED * (y + PADDED * z)
}

/// Distances of a block with its upper border; `None` where the voxel was seen too little.
struct Padded {
    distance_m: [f32; PADDED * PADDED * PADDED],
    color: Option<Box<[[f32; 3]; PADDED * PADDED * PADDED]>>,
}

/// The vertices on the edges that start at a block's voxels.
struct BlockVertices {
    /// Number of the vertex on the edge from voxel `i` along `axis` at `axis * 512 + i`, counted within the block.
    of_edge: Vec<u32>,
    positions: Vec<Point3<f64>>,
    colors: Vec<[u8; 3]>,
}

impl TsdfVolume {
    /// The surface where the distance is zero, in the world frame, metres, as triangles that share their vertices also
    /// across blocks. Vertex colours are present where photographs were integrated. Cells with a corner seen in fewer
    /// than `min_weight` frames have no surface. The order of vertices and triangles follows space, not the order in
    /// which frames came.
    pub fn extract_mesh(&self, min_weight: f32) -> TriangleMesh {
        let table = CubeTable::new();
        let mut order: Vec<usize> = (0..self.blocks.len()).collect();
        order.sort_unstable_by_key(|&i| self.blocks[i].coord);
        let mut rank = vec![0u32; self.blocks.len()];
        order.iter().enumerate().for_each(|(r, &i)| rank[i] = r as u32);

        // Place a vertex on every edge that crosses zero, then connect them cell by cell.
        let vertices: Vec<BlockVertices> =
            order.par_iter().map(|&i| self.place_vertices(&self.blocks[i], min_weight)).collect();
        let mut offsets = Vec::with_capacity(vertices.len());
        let mut total = 0u32;
        for block in &vertices {
            offsets.push(total);
            total += block.positions.len() as u32;
        }
        let triangles: Vec<Vec<[u32; 3]>> = order
            .par_iter()
            .map(|&i| self.connect(&self.blocks[i], min_weight, &table, &rank, &vertices, &offsets))
            .collect();

        let colored = self.blocks.iter().any(|b| b.color.is_some());
        let mut mesh = TriangleMesh::new(
            vertices.iter().flat_map(|b| b.positions.iter().copied()).collect(),
            triangles.into_iter().flatten().collect(),
        );
        mesh.vertex_colors = colored.then(|| vertices.into_iter().flat_map(|b| b.colors).collect());
        without_unused_vertices(mesh)
    }

    /// A block with its upper border; voxels that do not exist or were seen too little hold NaN.
    fn padded(&self, block: &Block, min_weight: f32, with_color: bool) -> Padded {
        let mut padded = Padded {
            distance_m: [f32::NAN; PADDED * PADDED * PADDED],
            color: with_color.then(|| Box::new([[0.0; 3]; PADDED * PADDED * PADDED])),
        };
        for neighbour in 0..8usize {
            let offset = [neighbour & 1, neighbour >> 1 & 1, neighbour >> 2];
            let coord = std::array::from_fn(|a| block.coord[a] + offset[a] as i32);
            let source =
                if neighbour == 0 { Some(block) } else { self.index_of(coord).map(|i| &self.blocks[i as usize]) };
            let Some(source) = source else { continue };
            let extent = offset.map(|o| if o == 1 { 1 } else { SIDE });
            for z in 0..extent[2] {
                for y in 0..extent[1] {
                    for x in 0..extent[0] {
                        let from = x + SIDE * (y + SIDE * z);
                        if source.weight[from] > 0.0 && source.weight[from] >= min_weight {
                            let to = padded_index(x + SIDE * offset[0], y + SIDE * offset[1], z + SIDE * offset[2]);
                            padded.distance_m[to] = source.distance_m[from];
                            if let (Some(to_color), Some(from_color)) = (&mut padded.color, &source.color) {
                                to_color[to] = from_color[from];
                            }
                        }
                    }
                }
            }
        }
        padded
    }

    fn place_vertices(&self, block: &Block, min_weight: f32) -> BlockVertices {
        let padded = self.padded(block, min_weight, block.color.is_some());
        let mut result = BlockVertices { of_edge: vec![NONE; 3 * VOXELS], positions: Vec::new(), colors: Vec::new() };
        for voxel in 0..VOXELS {
            let at = [voxel % SIDE, voxel / SIDE % SIDE, voxel / (SIDE * SIDE)];
            let here = padded_index(at[0], at[1], at[2]);
            let a = padded.distance_m[here];
            for axis in 0..3 {
                let there = here + [1, PADDED, PADDED * PADDED][axis];
                let b = padded.distance_m[there];
                if a.is_nan() || b.is_nan() || (a < 0.0) == (b < 0.0) {
                    continue;
                }
                let t = (a / (a - b)).clamp(CLEAR_OF_CORNERS, 1.0 - CLEAR_OF_CORNERS);
                let mut position = Point3::from(std::array::from_fn::<f64, 3, _>(|i| {
                    f64::from(block.coord[i]) * SIDE as f64 + at[i] as f64
                }));
                position[axis] += f64::from(t);
                result.of_edge[axis * VOXELS + voxel] = result.positions.len() as u32;
                result.positions.push(position * self.voxel_size_m());
                if let Some(color) = &padded.color {
                    result.colors.push(std::array::from_fn(|i| {
                        (color[here][i] + (color[there][i] - color[here][i]) * t).round() as u8
                    }));
                }
            }
        }
        result
    }

    fn connect(
        &self,
        block: &Block,
        min_weight: f32,
        table: &CubeTable,
        rank: &[u32],
        vertices: &[BlockVertices],
        offsets: &[u32],
    ) -> Vec<[u32; 3]> {
        let padded = self.padded(block, min_weight, false);
        let neighbours: [Option<u32>; 8] = std::array::from_fn(|n| {
            let coord = [n & 1, n >> 1 & 1, n >> 2];
            self.index_of(std::array::from_fn(|a| block.coord[a] + coord[a] as i32)).map(|i| rank[i as usize])
        });
        let mut triangles = Vec::new();
        for voxel in 0..VOXELS {
            let at = [voxel % SIDE, voxel / SIDE % SIDE, voxel / (SIDE * SIDE)];
            let corners: [f32; 8] = std::array::from_fn(|c| {
                padded.distance_m[padded_index(at[0] + (c & 1), at[1] + (c >> 1 & 1), at[2] + (c >> 2))]
            });
            if corners.iter().any(|d| d.is_nan()) {
                continue;
            }
            let inside = (0..8).fold(0u8, |bits, c| bits | u8::from(corners[c] < 0.0) << c);
            for triangle in table.triangles(inside) {
                triangles.push(triangle.map(|edge| {
                    // The edge starts at a voxel of this block or of an upper neighbour.
                    let start: [usize; 3] = std::array::from_fn(|a| at[a] + (edge.corner as usize >> a & 1));
                    let neighbour = (0..3).fold(0, |n, a| n | (start[a] / SIDE) << a);
                    let local = start[0] % SIDE + SIDE * (start[1] % SIDE + SIDE * (start[2] % SIDE));
                    let owner = neighbours[neighbour].expect("a corner with a distance lies in a block") as usize;
                    offsets[owner] + vertices[owner].of_edge[edge.axis as usize * VOXELS + local]
                }));
            }
        }
        triangles
    }
}

/// Drops vertices that no triangle uses (edges whose cells all lack a corner).
fn without_unused_vertices(mesh: TriangleMesh) -> TriangleMesh {
    let mut new_index = vec![NONE; mesh.vertices.len()];
    for &v in mesh.triangles.as_flattened() {
        new_index[v as usize] = 0;
    }
    let kept: Vec<usize> = (0..new_index.len()).filter(|&v| new_index[v] != NONE).collect();
    kept.iter().enumerate().for_each(|(new, &old)| new_index[old] = new as u32);
    let mut result = TriangleMesh::new(
        kept.iter().map(|&v| mesh.vertices[v]).collect(),
        mesh.triangles.iter().map(|t| t.map(|v| new_index[v as usize])).collect(),
    );
    result.vertex_colors = mesh.vertex_colors.map(|colors| kept.iter().map(|&v| colors[v]).collect());
    result
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use rand::RngExt;

    use super::*;

    /// A volume of 3x3x3 blocks around the origin, each voxel from its position in voxels (0 to 23).
    fn volume(mut distance: impl FnMut([usize; 3]) -> Option<f32>) -> TsdfVolume {
        let mut volume = TsdfVolume::new(0.01, 0.04).unwrap();
        for block in 0..27usize {
            let at = [block % 3, block / 3 % 3, block / 9];
            let block = volume.add_block(at.map(|c| c as i32 - 1));
            for voxel in 0..VOXELS {
                let inner = [voxel % SIDE, voxel / SIDE % SIDE, voxel / (SIDE * SIDE)];
                if let Some(d) = distance(std::array::from_fn(|a| at[a] * SIDE + inner[a])) {
                    block.distance_m[voxel] = d;
                    block.weight[voxel] = 1.0;
                }
            }
        }
        volume
    }

    /// Uses of each directed edge.
    fn directed_edges(mesh: &TriangleMesh) -> BTreeMap<(u32, u32), usize> {
        let mut uses = BTreeMap::new();
        for &[a, b, c] in &mesh.triangles {
            for edge in [(a, b), (b, c), (c, a)] {
                *uses.entry(edge).or_insert(0) += 1;
            }
        }
        uses
    }

    #[test]
    fn noise_inside_a_closed_border_becomes_a_closed_manifold_across_blocks() {
        for seed in 0..20 {
            let mut rng = mb_job::rng(seed, 0);
            let mesh = volume(|at| {
                let border = at.iter().any(|&c| c == 0 || c == 3 * SIDE - 1);
                Some(if border { 0.01 } else { rng.random_range(-0.01..0.01) })
            })
            .extract_mesh(1.0);
            assert!(mesh.triangles.len() > 1000);
            let edges = directed_edges(&mesh);
            for (&(a, b), &uses) in &edges {
                assert_eq!(uses, 1, "seed {seed}: edge {a}-{b} has {uses} triangles on one side");
                assert_eq!(edges.get(&(b, a)), Some(&1), "seed {seed}: edge {a}-{b} is open");
            }
        }
    }

    #[test]
    fn unseen_voxels_leave_a_hole_and_no_stray_vertices() {
        let plane = |at: [usize; 3]| 0.01 * (at[2] as f32 - 11.3);
        let whole = volume(|at| Some(plane(at))).extract_mesh(1.0);
        let holed = volume(|at| (at[..2] != [7, 8]).then(|| plane(at))).extract_mesh(1.0);
        assert_eq!(whole.triangles.len(), 2 * 23 * 23);
        // The four cells around the missing column are gone.
        assert_eq!(holed.triangles.len(), whole.triangles.len() - 8);
        assert_eq!(holed.vertices.len(), whole.vertices.len() - 1);
        assert!(volume(|at| Some(plane(at))).extract_mesh(2.0).triangles.is_empty());
    }

    #[test]
    fn voxels_exactly_on_the_surface_do_not_collapse_triangles() {
        let mesh = volume(|at| Some(0.01 * (at[2] as f32 - 11.0))).extract_mesh(1.0);
        assert_eq!(mesh.triangles.len(), 2 * 23 * 23);
        assert!((0..mesh.triangles.len()).all(|t| mesh.scaled_normal(t).z > 0.9e-4));
    }
}
