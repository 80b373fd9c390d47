//! The play between real bricks: side walls that stand back from their nominal planes.

use std::collections::BTreeMap;

use crate::ldraw::shape::PartShape;

/// Stud pitch, LDraw units. Side walls of bricks lie on planes of this grid, counted from the outermost one.
const PITCH_LDU: f64 = 20.0;
/// Two planes closer than this are one, LDraw units.
const SAME_PLANE_LDU: f64 = 1e-3;

/// Moves the outer side walls of a part inwards by `clearance_ldu`, as play between neighbours.
///
/// An outer side wall is made of vertical triangles on a plane of the stud grid, counted from the part's outermost
/// walls; every vertex on that plane within the wall's rectangle moves along, so that tops and edges stay attached.
/// Studs, tubes, inner walls, heights and everything off the grid keep their place and size.
pub(crate) fn set_back_side_walls(shape: &mut PartShape, clearance_ldu: f64) {
    for axis in [0, 2] {
        let walls = side_walls(shape, axis);
        let across = [1, 2 - axis];
        let shifts: Vec<f64> = shape
            .vertices
            .iter()
            .map(|p| {
                let on_wall = |wall: &&Wall| {
                    (p[axis] - wall.plane).abs() < SAME_PLANE_LDU
                        && (0..2).all(|i| {
                            let v = p[across[i]];
                            wall.min[i] - SAME_PLANE_LDU <= v && v <= wall.max[i] + SAME_PLANE_LDU
                        })
                };
                let (mut inwards, mut outwards) = (0.0_f64, 0.0_f64);
                for wall in walls.iter().filter(on_wall) {
                    inwards = inwards.min(-wall.outwards * clearance_ldu);
                    outwards = outwards.max(-wall.outwards * clearance_ldu);
                }
                // Walls that face both ways on one plane are a sheet; it stays.
                inwards + outwards
            })
            .collect();
        for (p, shift) in shape.vertices.iter_mut().zip(shifts) {
            p[axis] += shift;
        }
    }
}

/// The walls on one plane that face the same way, as one rectangle.
struct Wall {
    plane: f64,
    outwards: f64,
    min: [f64; 2],
    max: [f64; 2],
}

fn side_walls(shape: &PartShape, axis: usize) -> Vec<Wall> {
    let across = [1, 2 - axis];
    let mut walls: BTreeMap<(i64, bool), Wall> = BTreeMap::new();
    for triangle in &shape.triangles {
        let corners = triangle.map(|v| shape.vertices[v as usize]);
        let plane = corners[0][axis];
        if corners.iter().any(|p| (p[axis] - plane).abs() > SAME_PLANE_LDU) {
            continue;
        }
        let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[0]))[axis];
        if normal.abs() < SAME_PLANE_LDU * SAME_PLANE_LDU {
            continue;
        }
        let key = ((plane / SAME_PLANE_LDU).round() as i64, normal > 0.0);
        let wall = walls.entry(key).or_insert_with(|| Wall {
            plane,
            outwards: normal.signum(),
            min: [f64::INFINITY; 2],
            max: [f64::NEG_INFINITY; 2],
        });
        for p in &corners {
            for i in 0..2 {
                wall.min[i] = wall.min[i].min(p[across[i]]);
                wall.max[i] = wall.max[i].max(p[across[i]]);
            }
        }
    }
    let low = walls.values().map(|w| w.plane).fold(f64::INFINITY, f64::min);
    let high = walls.values().map(|w| w.plane).fold(f64::NEG_INFINITY, f64::max);
    let on_grid = |plane: f64, origin: f64| {
        let steps = (plane - origin) / PITCH_LDU;
        (steps - steps.round()).abs() * PITCH_LDU < SAME_PLANE_LDU
    };
    walls
        .into_values()
        .filter(|wall| if wall.outwards > 0.0 { on_grid(wall.plane, high) } else { on_grid(wall.plane, low) })
        .collect()
}
