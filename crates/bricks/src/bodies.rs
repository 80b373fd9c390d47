//! Rigid bodies: how heavy bricks are, where their middle is, and where they touch the ground.

use mb_geometry::Aabb;
use nalgebra::{Point3, Vector3};

use crate::convex_hull::convex_hull;
use crate::flat::{METRES_PER_LDU, Shapes};
use crate::model::Model;
use crate::neighbors::Neighbors;
use crate::statics::Body;

/// A brick stands on the ground when it comes this close to the model's lowest point, LDraw units.
pub(crate) const GROUND_LDU: f64 = 0.1;
/// The share of its box that a brick fills where its surface says nothing: a hollow brick fills a quarter.
const FILLED: f64 = 0.25;
/// What a surface may say about that share without being taken for open or inside out.
const PLAUSIBLE: std::ops::RangeInclusive<f64> = 0.02..=1.0;

/// Several bricks as one body. `ground` is the height (LDraw's y) of the lowest feet.
pub(crate) fn body_of(
    model: &Model,
    shapes: &Shapes,
    neighbors: &Neighbors,
    bricks: &[usize],
    ground: f64,
    density_kg_m3: f64,
) -> Body {
    let (mut mass_kg, mut moment, mut feet) = (0.0, Vector3::zeros(), vec![]);
    for &brick in bricks {
        let (volume, center) = volume_and_center(model, shapes, brick, &neighbors.boxes[brick]);
        let mass = volume * METRES_PER_LDU.powi(3) * density_kg_m3;
        mass_kg += mass;
        moment += center.coords * mass;
        if neighbors.boxes[brick].max.y > ground - GROUND_LDU {
            let instance = &model.instances()[brick];
            let corners = shapes.get(instance.part).vertices.iter().map(|p| instance.ldraw_from_part.apply(p));
            feet.extend(corners.filter(|p| p.y > ground - GROUND_LDU).map(|p| [p.x, p.z]));
        }
    }
    let center = if mass_kg > 0.0 { Point3::from(moment / mass_kg) } else { Point3::origin() };
    let ground = convex_hull(feet).into_iter().map(|[x, z]| Point3::new(x, ground, z)).collect();
    Body { mass_kg, center, ground }
}

/// Volume (cubic LDraw units) and centroid by the divergence theorem, about the middle of the box; nearly right for
/// surfaces that are nearly closed.
fn volume_and_center(model: &Model, shapes: &Shapes, brick: usize, bounds: &Aabb) -> (f64, Point3<f64>) {
    let instance = &model.instances()[brick];
    let shape = shapes.get(instance.part);
    if bounds.is_empty() {
        return (0.0, Point3::origin());
    }
    let middle = bounds.center();
    let (mut volume, mut moment) = (0.0, Vector3::zeros());
    for triangle in &shape.triangles {
        let [a, b, c] = triangle.map(|v| instance.ldraw_from_part.apply(&shape.vertices[v as usize]) - middle);
        let piece = a.dot(&b.cross(&c)) / 6.0;
        volume += piece;
        moment += (a + b + c) * (piece / 4.0);
    }
    let box_volume = bounds.extent().product();
    if !PLAUSIBLE.contains(&(volume.abs() / box_volume)) {
        return (FILLED * box_volume, middle);
    }
    let center = middle + moment / volume;
    (volume.abs(), if bounds.contains(&center) { center } else { middle })
}
