//! The 256 cases of marching cubes, derived instead of tabulated.
//!
//! A corner is a number from 0 to 7 whose bits are its x, y and z; an edge starts at a corner whose bit of its axis is
//! zero and runs along that axis. On every face of the cube the surface cuts off each run of inside corners, also where
//! two of them face each other diagonally. That rule looks at nothing but the four corners of the face, so two cells
//! always agree on the face they share, and the mesh has no cracks (Dürst's ambiguity cannot arise).

/// An edge of the cell: its lower corner and its axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CubeEdge {
    /// The end whose bit of `axis` is zero.
    pub corner: u8,
    /// 0 = x, 1 = y, 2 = z.
    pub axis: u8,
}

impl CubeEdge {
    /// Whether some face of the cube holds both edges.
    fn shares_face_with(self, other: Self) -> bool {
        (0..3).any(|axis| {
            axis != self.axis && axis != other.axis && (self.corner >> axis & 1) == (other.corner >> axis & 1)
        })
    }
}

/// The triangles of each case: index by the bits of the inside corners.
pub struct CubeTable(Vec<Vec<[CubeEdge; 3]>>);

impl CubeTable {
    /// Derives all cases.
    pub fn new() -> Self {
        Self((0..=255).map(triangles_of_case).collect())
    }

    /// The triangles of a case, counter-clockwise seen from the outside corners.
    pub fn triangles(&self, inside: u8) -> &[[CubeEdge; 3]] {
        &self.0[inside as usize]
    }
}

/// Edges are numbered `axis * 8 + corner` while loops are traced.
const EDGE_SLOTS: usize = 24;

fn triangles_of_case(inside: u8) -> Vec<[CubeEdge; 3]> {
    // Each face links the edge where its outline leaves an inside run to the edge where it entered it. An edge is left
    // on one of its faces and entered on the other, so the links form closed loops.
    let mut next = [None; EDGE_SLOTS];
    for face in 0..6 {
        let outline = face_outline(face);
        let is_inside = |i: usize| inside >> outline[i % 4] & 1 == 1;
        for entry in (0..4).filter(|&i| !is_inside(i) && is_inside(i + 1)) {
            let exit = (entry + 1..entry + 5).find(|&i| is_inside(i) && !is_inside(i + 1));
            if let Some(exit) = exit {
                let slot = |i: usize| edge_slot(outline[i % 4], outline[(i + 1) % 4]);
                next[slot(entry)] = Some(slot(exit));
            }
        }
    }
    let mut triangles = Vec::new();
    for start in 0..EDGE_SLOTS {
        let mut polygon = Vec::new();
        let mut at = start;
        while let Some(following) = next[at].take() {
            polygon.push(CubeEdge { corner: (at % 8) as u8, axis: (at / 8) as u8 });
            at = following;
        }
        if polygon.len() >= 3 {
            triangulate(&polygon, &mut triangles);
        }
    }
    triangles
}

/// The corners of face `axis * 2 + side`, counter-clockwise seen from outside the cube.
fn face_outline(face: usize) -> [u8; 4] {
    let (axis, side) = (face / 2, face % 2);
    let (u, v) = (1 << ((axis + 1) % 3), 1 << ((axis + 2) % 3));
    let base = (side << axis) as u8;
    if side == 1 { [base, base | u, base | u | v, base | v] } else { [base, base | v, base | u | v, base | u] }
}

fn edge_slot(a: u8, b: u8) -> usize {
    (a ^ b).trailing_zeros() as usize * 8 + a.min(b) as usize
}

/// Cuts a polygon into triangles without a diagonal inside a face of the cube: the neighbouring cell could cut the same
/// face along the same line, and four triangles would meet there. Such a cut exists for all cases.
fn triangulate(polygon: &[CubeEdge], triangles: &mut Vec<[CubeEdge; 3]>) -> bool {
    let n = polygon.len();
    if n < 3 {
        return true;
    }
    let (first, last) = (polygon[0], polygon[n - 1]);
    for apex in 1..n - 1 {
        let allowed = (apex == 1 || !first.shares_face_with(polygon[apex]))
            && (apex == n - 2 || !last.shares_face_with(polygon[apex]));
        let before = triangles.len();
        if allowed && triangulate(&polygon[..=apex], triangles) && triangulate(&polygon[apex..], triangles) {
            triangles.push([first, polygon[apex], last]);
            return true;
        }
        triangles.truncate(before);
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn midpoint(edge: CubeEdge) -> Vector3<f64> {
        let mut p = Vector3::from_fn(|axis, _| f64::from(edge.corner >> axis & 1));
        p[edge.axis as usize] += 0.5;
        p
    }

    #[test]
    fn every_crossed_edge_of_every_case_is_used() {
        let table = CubeTable::new();
        for inside in 0..=255u8 {
            let mut used = [false; EDGE_SLOTS];
            for triangle in table.triangles(inside) {
                triangle.iter().for_each(|e| used[e.axis as usize * 8 + e.corner as usize] = true);
            }
            for axis in 0..3 {
                for corner in (0..8u8).filter(|c| c >> axis & 1 == 0) {
                    let crossed = (inside >> corner ^ inside >> (corner | 1 << axis)) & 1 == 1;
                    assert_eq!(used[axis * 8 + corner as usize], crossed, "case {inside:08b}");
                }
            }
        }
    }

    #[test]
    fn a_single_inside_corner_is_cut_off_by_a_triangle_that_faces_away_from_it() {
        let table = CubeTable::new();
        for corner in 0..8u8 {
            let [triangle] = table.triangles(1 << corner) else { panic!("one triangle cuts off one corner") };
            let [a, b, c] = triangle.map(midpoint);
            let position = Vector3::from_fn(|axis, _| f64::from(corner >> axis & 1));
            assert!((b - a).cross(&(c - a)).dot(&(a - position)) > 0.0);
        }
    }
}
