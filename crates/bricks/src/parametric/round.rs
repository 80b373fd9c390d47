//! Round bricks, plates, tiles and cones.

use super::block::{BRICK, OVERLAP, PLATE, STUD_RADIUS, TUBE_RADIUS, WALL, hollow_stud, stud, tube};
use super::columns::{CIRCLE_SIDES, Columns, Outline, Plane, circle, circle_corner, rectangle};

const AXIS: [f64; 2] = [0.0, 0.0];
/// Radius of parts that are one stud and two studs wide.
const ONE: f64 = 10.0;
const TWO: f64 = 20.0;

/// 1 x 1 plate: a disc on a ring.
pub(crate) fn round_plate() -> Columns {
    let mut solid = Columns::default();
    solid.fill(circle(AXIS, ONE), [0.0, 3.0]);
    tube(&mut solid, AXIS, PLATE);
    stud(&mut solid, AXIS, 0.0);
    solid
}

/// The ring on which round 1 x 1 parts stand, from `top` to the bottom of a brick, and the bore above it.
fn foot(solid: &mut Columns, top: f64, bore_top: f64) {
    solid.fill(circle(AXIS, TUBE_RADIUS), [top - OVERLAP, BRICK]);
    solid.empty(circle(AXIS, STUD_RADIUS), [bore_top, BRICK + OVERLAP]);
}

/// 1 x 1 brick, bored through.
pub(crate) fn round_brick() -> Columns {
    let mut solid = Columns::default();
    solid.fill(circle(AXIS, ONE), [0.0, 19.0]);
    foot(&mut solid, 19.0, WALL);
    hollow_stud(&mut solid, AXIS, 0.0, WALL + OVERLAP);
    solid
}

/// 1 x 1 cone, bored for an axle.
pub(crate) fn cone() -> Columns {
    let mut solid = Columns::default();
    // Height and radius, from the top.
    let profile = [[0.0, 6.5], [3.0, 7.0], [8.5, 8.0], [19.0, 10.0]];
    solid.fill(circle(AXIS, profile[0][1]), [0.0, 19.0]);
    for ring in profile.windows(2) {
        let [[y0, r0], [y1, r1]] = [ring[0], ring[1]];
        for side in 0..CIRCLE_SIDES {
            let [a, b, c, d] = [(r0, side), (r0, side + 1), (r1, side + 1), (r1, side)]
                .map(|(radius, index)| circle_corner(AXIS, radius, index));
            let plane = Plane::through([a[0], y0, a[1]], [b[0], y0, b[1]], [d[0], y1, d[1]]);
            solid.fill_between(vec![a, b, c, d], plane, Plane::level(19.0));
        }
    }
    foot(&mut solid, 19.0, 18.0);
    hollow_stud(&mut solid, AXIS, 0.0, 8.0);
    solid.empty(reduced_axle_hole(), [8.0, 18.0 + OVERLAP]);
    solid
}

/// The section of a hole for a cross axle, two of its teeth worn thin.
fn reduced_axle_hole() -> Outline {
    let half = [
        [6.0, 0.0],
        [5.6023, 2.0],
        [4.0, 2.0],
        [2.5, 2.5],
        [2.0, 4.0],
        [2.0, 5.6023],
        [0.0, 6.0],
        [-2.296, 5.543],
        [-2.791, 5.213],
        [-2.5, 2.5],
        [-5.213, 2.791],
        [-5.543, 2.296],
    ];
    half.into_iter().chain(half.map(|[x, z]| [-x, -z])).collect()
}

/// The section of a hole for a cross axle.
fn axle_hole() -> Outline {
    let arm = [[6.0, 0.0], [5.6023, 2.0], [4.0, 2.0], [2.5, 2.5], [2.0, 4.0], [2.0, 5.6023]];
    let mut outline = vec![];
    for quarter in 0..4 {
        outline.extend(arm.map(|[x, z]| match quarter {
            0 => [x, z],
            1 => [-z, x],
            2 => [-x, -z],
            _ => [z, -x],
        }));
    }
    outline
}

/// Studs on a 2 x 2 round top, cut off where they would stand over its rim.
fn four_studs(solid: &mut Columns) {
    for (quarter, [x, z]) in [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]].into_iter().enumerate() {
        stud(solid, [10.0 * x, 10.0 * z], 0.0);
        let rim = [1, 2, 3].map(|index| circle_corner(AXIS, TWO, 4 * quarter + index));
        let mut outside = rim.to_vec();
        outside.push([TWO * x, TWO * z]);
        solid.empty(outside, [-5.0, OVERLAP]);
    }
}

/// 2 x 2 plate with a hole for an axle.
pub(crate) fn round_plate_2x2() -> Columns {
    let mut solid = Columns::default();
    solid.fill(circle(AXIS, TWO), [0.0, PLATE]);
    solid.empty(rectangle([-16.0, 16.0], [-16.0, 16.0]), [WALL, PLATE + OVERLAP]);
    tube(&mut solid, AXIS, PLATE);
    solid.empty(axle_hole(), [-OVERLAP, WALL + OVERLAP]);
    four_studs(&mut solid);
    solid
}

/// 2 x 2 brick with a hole for an axle.
pub(crate) fn round_brick_2x2() -> Columns {
    let mut solid = Columns::default();
    solid.fill(circle(AXIS, TWO), [0.0, BRICK]);
    solid.empty(circle(AXIS, 16.0), [WALL, BRICK - WALL + OVERLAP]);
    solid.empty(rectangle([-16.0, 16.0], [-16.0, 16.0]), [BRICK - WALL, BRICK + OVERLAP]);
    solid.post(circle(AXIS, TUBE_RADIUS), BRICK);
    solid.empty(circle(AXIS, STUD_RADIUS), [BRICK - WALL, BRICK + OVERLAP]);
    solid.empty(axle_hole(), [-OVERLAP, BRICK - WALL + OVERLAP]);
    four_studs(&mut solid);
    solid
}

/// 2 x 2 tile with a cross below.
pub(crate) fn round_tile_2x2() -> Columns {
    let mut solid = Columns::default();
    solid.fill(circle(AXIS, TWO), [0.0, 7.0]);
    solid.fill(circle(AXIS, TWO - 1.0), [7.0 - OVERLAP, PLATE]);
    solid.empty(circle(AXIS, 16.0), [WALL, PLATE + OVERLAP]);
    // The rim is open towards the corners, where studs come from below.
    let half = [[14.6347, 6.3442], [15.5434, 7.7038], [16.0, 10.0], [15.4, 13.0], [18.0, 18.0]];
    for [x, z] in [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]] {
        let mut outline = vec![[0.0, 0.0]];
        outline.extend(half.map(|[a, b]| [x * a, z * b]));
        outline.extend(half[..4].iter().rev().map(|[a, b]| [x * b, z * a]));
        solid.empty(outline, [WALL, PLATE + OVERLAP]);
    }
    for [x, z] in [[1.0, 1.0], [1.0, -1.0]] {
        // A bar 2 wide along a diagonal, 8.142 to each side.
        let (along, across) = (8.142 * std::f64::consts::FRAC_1_SQRT_2, std::f64::consts::FRAC_1_SQRT_2);
        let corner = |a: f64, b: f64| [x * (a * along + b * across), z * (a * along - b * across)];
        solid.post(vec![corner(1.0, 1.0), corner(1.0, -1.0), corner(-1.0, -1.0), corner(-1.0, 1.0)], PLATE);
    }
    solid
}
