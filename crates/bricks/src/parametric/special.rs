//! Corners, jumpers, a grille, a panel, a brick with a stud on its side.

use nalgebra::{Point3, Vector3};

use super::block::{
    BRICK, Footprint, OVERLAP, PIN_RADIUS, PLATE, STUD_RADIUS, WALL, hollow, hollow_stud, stud, studded, tile,
};
use super::columns::{CIRCLE_SIDES, Columns, Plane, circle, circle_corner, rectangle};
use super::slope::stud_holders;
use crate::ldraw::file::StudSite;

/// A plate or tile with one hollow stud in its middle.
pub(crate) fn jumper(footprint: Footprint, groove: bool) -> Columns {
    let mut solid = tile(footprint, groove);
    hollow_stud(&mut solid, [0.0, 0.0], 0.0, 0.0);
    solid
}

/// Two arms at a right angle, two studs long.
pub(crate) fn corner(height: f64) -> Columns {
    let mut solid = Columns::default();
    let arms =
        |near: f64, far: f64| vec![[-near, -near], [far, -near], [far, near], [near, near], [near, far], [-near, far]];
    solid.fill(arms(10.0, 30.0), [0.0, height]);
    solid.empty(arms(6.0, 26.0), [WALL, height + OVERLAP]);
    for center in [[0.0, 10.0], [10.0, 0.0]] {
        solid.post(circle(center, PIN_RADIUS), height);
    }
    if height > PLATE {
        // A rib in the inner corner.
        let rib = vec![[3.5355, 4.9497], [4.9497, 3.5355], [7.4142, 6.0], [6.0, 7.4142]];
        solid.post(rib, height - 0.5);
    }
    for center in [[0.0, 0.0], [20.0, 0.0], [0.0, 20.0]] {
        stud(&mut solid, center, 0.0);
    }
    solid
}

/// A 1 x 2 brick three bricks high, with ribs instead of pins.
pub(crate) fn tall_brick() -> Columns {
    let (footprint, height) = (Footprint { length: 2, width: 1 }, 3.0 * BRICK);
    let mut solid = Columns::default();
    solid.fill(footprint.outline(0.0), [0.0, height]);
    solid.empty(footprint.outline(WALL), [WALL, height + OVERLAP]);
    stud_holders(&mut solid, height);
    footprint.squares().into_iter().for_each(|center| stud(&mut solid, center, 0.0));
    solid
}

/// A 2 x 8 brick, its long walls stiffened by ribs from every other tube.
pub(crate) fn long_brick() -> Columns {
    let mut solid = studded(Footprint { length: 8, width: 2 }, BRICK);
    for x in [-40.0, 0.0, 40.0] {
        for side in [-1.0, 1.0] {
            // From within the tube to within the wall.
            let z = [side * 7.0, side * (16.0 + OVERLAP)];
            solid.fill(rectangle([x - 1.0, x + 1.0], z), [WALL - OVERLAP, 18.5]);
        }
    }
    solid
}

/// A 1 x 2 brick with ridges: lying ones on its front, standing ones on its back.
pub(crate) fn grille() -> Columns {
    let footprint = Footprint { length: 2, width: 1 };
    let mut solid = Columns::default();
    solid.fill(rectangle([-20.0, 20.0], [-8.0, 8.0]), [0.0, BRICK]);
    for index in 0..10 {
        let x = -20.0 + 4.0 * f64::from(index);
        solid.fill(vec![[x, 8.0], [x + 4.0, 8.0], [x + 2.0, 10.0]], [0.0, BRICK]);
    }
    for index in 0..6 {
        let y = 4.0 * f64::from(index);
        let upper = Plane::along_x([y, -8.0], [y + 2.0, -10.0]);
        let lower = Plane::along_x([y + 4.0, -8.0], [y + 2.0, -10.0]);
        solid.fill_between(rectangle([-20.0, 20.0], [-10.0, -8.0]), upper, lower);
    }
    hollow(&mut solid, footprint, BRICK);
    footprint.squares().into_iter().for_each(|center| stud(&mut solid, center, 0.0));
    solid
}

/// Two low walls on a 1 x 1 base, their free upper corners rounded.
pub(crate) fn corner_panel() -> Columns {
    let mut solid = Columns::default();
    let square = Footprint { length: 1, width: 1 };
    let base = Plane::level(16.0 + OVERLAP);
    solid.fill(square.outline(0.0), [16.0, BRICK]);
    hollow_above(&mut solid, square);
    solid.fill(rectangle([-10.0, 8.0], [6.0, 10.0]), [0.0, 16.0 + OVERLAP]);
    solid.fill(rectangle([-10.0, -6.0], [-8.0, 10.0]), [0.0, 16.0 + OVERLAP]);
    for side in 0..4 {
        // From the top of the quarter circle outwards: how far out and how far down.
        let [a, b] = [side, side + 1].map(|index| circle_corner([0.0, 0.0], 2.0, 4 - index));
        let (a, b) = ([a[0], 2.0 - a[1]], [b[0], 2.0 - b[1]]);
        let along_x = Plane::along_z([8.0 + a[0], a[1]], [8.0 + b[0], b[1]]);
        solid.fill_between(rectangle([8.0 + a[0], 8.0 + b[0]], [6.0, 10.0]), along_x, base);
        let along_z = Plane::along_x([a[1], -8.0 - a[0]], [b[1], -8.0 - b[0]]);
        solid.fill_between(rectangle([-10.0, -6.0], [-8.0 - b[0], -8.0 - a[0]]), along_z, base);
    }
    solid
}

/// The hollow of a base whose top lies at 16 units.
fn hollow_above(solid: &mut Columns, footprint: Footprint) {
    solid.empty(footprint.outline(WALL), [16.0 + WALL, BRICK + OVERLAP]);
}

/// A 1 x 1 brick with a hollow stud on its front.
pub(crate) fn side_stud() -> Columns {
    let footprint = Footprint { length: 1, width: 1 };
    let mut solid = Columns::default();
    solid.fill(footprint.outline(0.0), [0.0, BRICK]);
    hollow(&mut solid, footprint, BRICK);
    stud(&mut solid, [0.0, 0.0], 0.0);
    solid.studs.push(StudSite { foot: Point3::new(0.0, 10.0, -10.0), axis: -Vector3::z() });
    // A lying cylinder is a row of strips between its upper and its lower half.
    let strips = |radius: f64, z: [f64; 2]| {
        (0..CIRCLE_SIDES / 2).map(move |side| {
            let [a, b] = [side, side + 1].map(|index| circle_corner([0.0, 0.0], radius, index));
            let upper = Plane::along_z([a[0], 10.0 - a[1]], [b[0], 10.0 - b[1]]);
            let lower = Plane::along_z([a[0], 10.0 + a[1]], [b[0], 10.0 + b[1]]);
            (rectangle([b[0], a[0]], z), upper, lower)
        })
    };
    for (outline, upper, lower) in strips(STUD_RADIUS, [-14.0, -10.0]) {
        solid.fill_between(outline, upper, lower);
    }
    for (outline, upper, lower) in strips(PIN_RADIUS, [-15.0, -6.0]) {
        solid.empty_between(outline, upper, lower);
    }
    solid
}
