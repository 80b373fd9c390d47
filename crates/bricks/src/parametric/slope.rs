//! Slopes, inverted slopes and curved tops.
//!
//! All run along x with the same section, and fall towards -z. Sections are those of the official parts; heights are
//! counted downwards from the top of the brick.

use nalgebra::{Point3, Vector3};

use super::block::{BRICK, OVERLAP, PIN_RADIUS, STUD_RADIUS, WALL, hollow_stud, stud, tube};
use super::columns::{Columns, Outline, Plane, circle, circle_corner, rectangle};
use crate::ldraw::file::StudSite;

/// The upright back part of a slope: outside and inside.
const BACK: [f64; 2] = [-10.0, 10.0];
const INNER_BACK: f64 = 6.0;

/// A strip along x.
fn strip(half_x: f64, z: [f64; 2]) -> Outline {
    rectangle([-half_x, half_x], z)
}

/// The outside of a slope: upright behind, then down to a lip at `toe`.
fn ramp(half_x: f64, height: f64, toe: f64) -> Columns {
    let mut solid = Columns::default();
    solid.fill(strip(half_x, BACK), [0.0, height]);
    let slope = Plane::along_x([0.0, BACK[0]], [height - WALL, toe]);
    solid.fill_between(strip(half_x, [toe, BACK[0]]), slope, Plane::level(height));
    solid
}

/// Empties a strip under a ceiling given as `[y, z]` points with falling z.
fn hollow(solid: &mut Columns, half_x: f64, ceiling: &[[f64; 2]], bottom: f64) {
    for ends in ceiling.windows(2) {
        let outline = strip(half_x, [ends[1][1], ends[0][1]]);
        solid.empty_between(outline, Plane::along_x(ends[0], ends[1]), Plane::level(bottom + OVERLAP));
    }
}

fn row_of_studs(solid: &mut Columns, half_x: f64) {
    squares(half_x).for_each(|x| stud(solid, [x, 0.0], 0.0));
}

/// Where studs stand along x.
fn squares(half_x: f64) -> impl Iterator<Item = f64> {
    (0..(half_x / 10.0) as usize).map(move |index| 20.0 * index as f64 + 10.0 - half_x)
}

/// 45 degrees, two studs deep.
pub(crate) fn slope_45(half_x: f64) -> Columns {
    let mut solid = ramp(half_x, BRICK, -30.0);
    hollow(&mut solid, half_x - WALL, &[[WALL, INNER_BACK], [WALL, -10.0], [20.0, -26.0]], BRICK);
    if half_x > 10.0 {
        squares(half_x - 10.0).for_each(|x| tube(&mut solid, [x, -10.0], BRICK));
    } else {
        solid.post(circle([0.0, -10.0], PIN_RADIUS), BRICK);
    }
    row_of_studs(&mut solid, half_x);
    solid
}

/// 33 degrees, three studs deep.
pub(crate) fn slope_33(half_x: f64) -> Columns {
    let mut solid = ramp(half_x, BRICK, -50.0);
    let ceiling = [[WALL, INNER_BACK], [WALL, -10.0], [20.0, -42.0], [20.0, -46.0]];
    hollow(&mut solid, half_x - WALL, &ceiling, BRICK);
    if half_x > 10.0 {
        tube(&mut solid, [0.0, -10.0], BRICK);
        tube(&mut solid, [0.0, -30.0], BRICK);
    } else {
        // A wall crosses behind the first stud, with a rib in its middle.
        solid.post(strip(half_x - WALL, [-10.0, -6.0]), BRICK);
        solid.post(rectangle([-2.0, 2.0], [-14.0, -10.0]), BRICK);
        solid.post(circle([0.0, -30.0], PIN_RADIUS), BRICK);
    }
    row_of_studs(&mut solid, half_x);
    solid
}

/// 65 degrees, two bricks high, one wide.
pub(crate) fn slope_65() -> Columns {
    let height = 2.0 * BRICK;
    let mut solid = ramp(10.0, height, -30.0);
    hollow(&mut solid, 6.0, &[[WALL, INNER_BACK], [WALL, -8.0], [44.0, -26.0]], height);
    // The ribs that hold studs end a little above the rim.
    side_ribs(&mut solid, &[[6.0, -1.5], [5.0, -1.5], [3.5, 0.0], [5.0, 1.5], [6.0, 1.5]], height - 0.1);
    row_of_studs(&mut solid, 10.0);
    solid
}

/// 75 degrees, three bricks high, one wide, with a hollow stud.
pub(crate) fn slope_75() -> Columns {
    let height = 3.0 * BRICK;
    let mut solid = ramp(10.0, height, -30.0);
    hollow(&mut solid, 6.0, &[[WALL, INNER_BACK], [WALL, -8.0], [67.0, -26.0]], height);
    side_ribs(&mut solid, &[[6.0, -2.0], [4.0, 0.0], [6.0, 2.0]], height);
    hollow_stud(&mut solid, [0.0, 0.0], 0.0, 0.0);
    solid
}

/// Ribs on both inner side walls of a narrow slope, given as `[x, dz]` for the one on the right.
fn side_ribs(solid: &mut Columns, rib: &[[f64; 2]], bottom: f64) {
    for z in [-5.0, -15.0] {
        for side in [-1.0, 1.0] {
            solid.post(rib.iter().map(|&[x, dz]| [side * x, z + dz]).collect(), bottom);
        }
    }
}

/// 45 degrees, upside down: the underside falls back. The upper half has a pocket with hollow studs in it.
pub(crate) fn inverted_slope_45(half_x: f64) -> Columns {
    let mut solid = Columns::default();
    solid.fill(strip(half_x, BACK), [0.0, BRICK]);
    let underside = Plane::along_x([BRICK, -10.0], [WALL, -30.0]);
    solid.fill_between(strip(half_x, [-30.0, BACK[0]]), Plane::level(0.0), underside);
    solid.empty(strip(half_x - WALL, [-INNER_BACK, INNER_BACK]), [WALL, BRICK + OVERLAP]);
    if half_x > 10.0 {
        solid.post(circle([0.0, 0.0], PIN_RADIUS), BRICK);
    }
    let floor = Plane::along_x([20.0, -10.0], [WALL, -26.0]);
    solid.empty_between(strip(half_x - 2.0, [-26.0, -10.0]), Plane::level(-OVERLAP), floor);
    row_of_studs(&mut solid, half_x);
    for x in squares(half_x) {
        let below_floor = floor.raised(-OVERLAP);
        solid.fill_between(circle([x, -20.0], STUD_RADIUS), Plane::level(-4.0), below_floor);
        // The stud would touch the front wall along one line; a web makes them one.
        solid.fill_between(rectangle([x - 0.5, x + 0.5], [-26.5, -25.5]), Plane::level(0.0), below_floor);
        solid.empty_between(circle([x, -20.0], PIN_RADIUS), Plane::level(-5.0), floor);
        solid.studs.push(StudSite { foot: Point3::new(x, 0.0, -20.0), axis: -Vector3::y() });
    }
    solid
}

/// 31 degrees, two plates high, without studs. Its origin lies at its bottom.
pub(crate) fn cheese_slope(half_x: f64) -> Columns {
    let mut solid = Columns::default();
    let foot = Plane::level(-1.0);
    // The upper side edges are rounded off, in two facets.
    let (a, b, c) = (half_x, half_x - 0.59, half_x - 2.0);
    let edge = [[a, 6.0], [b, 8.35], [c, 28.0 / 3.0]];
    let mut front = vec![[-a, -10.0], [a, -10.0]];
    front.extend(edge);
    front.extend(edge.iter().rev().map(|&[x, z]| [-x, z]));
    solid.fill_between(front, Plane::along_x([-4.0, -10.0], [-13.6, 6.0]), foot);
    solid.fill_between(rectangle([-c, c], [28.0 / 3.0, 10.0]), Plane::level(-15.6), foot);
    for side in [-1.0, 1.0] {
        let upper = Plane::along_z([side * c, -15.6], [side * b, -15.01]);
        let lower = Plane::along_z([side * b, -15.01], [side * a, -13.6]);
        let outline = |corners: [[f64; 2]; 4]| corners.map(|[x, z]| [side * x, z]).to_vec();
        solid.fill_between(outline([[c, 28.0 / 3.0], [b, 8.35], [b, 10.0], [c, 10.0]]), upper, foot);
        solid.fill_between(outline([[b, 8.35], [a, 6.0], [a, 10.0], [b, 10.0]]), lower, foot);
    }
    solid.fill(strip(half_x - 1.0, [-9.0, 9.0]), [-1.0 - OVERLAP, 0.0]);
    let ceiling = Plane::along_x([-3.4, -6.0], [-10.6, 6.0]);
    solid.empty_between(strip(half_x - WALL, [-6.0, 6.0]), ceiling, Plane::level(OVERLAP));
    for x in squares(half_x) {
        // Room for the stud below, where the ceiling is too low for it.
        let segment = [[3.1092, -5.0], [2.2961, -5.5433], [0.0, -6.0], [-2.2961, -5.5433], [-3.1092, -5.0]];
        solid.empty(segment.map(|[dx, z]| [x + dx, z]).to_vec(), [-4.0, OVERLAP]);
    }
    if half_x > 10.0 {
        solid.post(circle([0.0, 0.0], PIN_RADIUS), 0.0);
    }
    solid
}

/// A quarter circle as a chain of `[y, z]` points, from its top down towards -z.
fn quarter_round(radius: f64, center: [f64; 2]) -> Vec<[f64; 2]> {
    // As [y, z] corners, the circle runs from down (0) over back (4) to up (8) and front (12).
    (8..=12).map(|index| circle_corner(center, radius, index)).collect()
}

/// One brick high and two long, the top a quarter round.
pub(crate) fn curved_top() -> Columns {
    let mut solid = Columns::default();
    for ends in quarter_round(20.0, [20.0, 10.0]).windows(2) {
        let outline = strip(20.0, [ends[1][1], ends[0][1]]);
        solid.fill_between(outline, Plane::along_x(ends[0], ends[1]), Plane::level(BRICK));
    }
    hollow(&mut solid, 16.0, &quarter_round(12.0, [18.0, 6.0]), BRICK);
    stud_holders(&mut solid, BRICK);
    solid
}

/// Ribs along the long inner walls of a 1 x 2 brick that hold studs.
pub(crate) fn stud_holders(solid: &mut Columns, bottom: f64) {
    for x in [-5.0, 5.0] {
        for side in [-1.0, 1.0] {
            let rib = [[-1.5, 6.0], [-1.5, 5.0], [0.0, 3.5], [1.5, 5.0], [1.5, 6.0]];
            solid.post(rib.map(|[dx, z]| [x + dx, side * z]).to_vec(), bottom);
        }
    }
}

/// Three faces at 45 degrees that meet in one point over the middle of the back.
pub(crate) fn triple_slope() -> Columns {
    let mut solid = Columns::default();
    let bottom = Plane::level(BRICK);
    let below = Plane::level(BRICK + OVERLAP);
    solid.fill_between(
        vec![[-20.0, -10.0], [20.0, -10.0], [0.0, 10.0]],
        Plane::along_x([20.0, -10.0], [0.0, 10.0]),
        bottom,
    );
    let inner = vec![[-16.0, -6.0], [16.0, -6.0], [4.0, 6.0], [-4.0, 6.0]];
    for side in [-1.0, 1.0] {
        let outline = vec![[side * 20.0, -10.0], [side * 20.0, 10.0], [0.0, 10.0]];
        solid.fill_between(outline, Plane::along_z([side * 20.0, 20.0], [0.0, 0.0]), bottom);
    }
    solid.empty_between(inner, Plane::along_x([20.0, -6.0], [8.0, 6.0]), below);
    for side in [-1.0, 1.0] {
        let outline = vec![[side * 16.0, -6.0], [side * 16.0, 6.0], [side * 4.0, 6.0]];
        solid.empty_between(outline, Plane::along_z([side * 16.0, 20.0], [side * 4.0, 8.0]), below);
    }
    stud_holders(&mut solid, BRICK);
    solid
}
