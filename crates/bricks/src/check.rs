//! Can it be built, and does it stand?

use std::collections::BTreeMap;

use mb_geometry::Aabb;
use mb_job::{Error, Result};
use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::build_order::build_order;
use crate::collisions::{Collision, collisions};
use crate::connections::{Connection, Group, connections_with};
use crate::flat::{METRES_PER_LDU, Shapes};
use crate::model::Model;
use crate::neighbors::Neighbors;
use crate::statics::{Body, Equilibrium, equilibrium};

/// A brick stands on the ground when it comes this close to the model's lowest point, LDraw units.
const GROUND_LDU: f64 = 0.1;

/// What bricks are like.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CheckOptions {
    /// Force with which one stud is held, newtons. 0.98 is what Liu et al. (2024) measured and use.
    pub clutch_n: f64,
    /// Density of the plastic, kilograms per cubic metre (ABS: 1050).
    pub density_kg_m3: f64,
}

impl Default for CheckOptions {
    fn default() -> Self {
        Self { clutch_n: 0.98, density_kg_m3: 1050.0 }
    }
}

/// The pair of bricks whose studs bear most.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WeakestConnection {
    /// The brick with the studs: index into [`Model::instances`].
    pub stud_brick: usize,
    /// The brick that grips them.
    pub grip_brick: usize,
    /// How many studs join the two.
    pub studs: usize,
    /// Share of the clutch force that the hardest pulled of them bears; above 1 it comes off.
    pub load: f64,
}

/// The document of `model check`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CheckReport {
    /// Bricks of the model.
    pub parts: usize,
    /// Bricks with stud data or held by a stud; about the others nothing is known but their place.
    pub covered_parts: usize,
    /// Whether all covered bricks hold together.
    pub connected: bool,
    /// Whether everything that holds to a brick on the ground is in equilibrium within the clutch force, and no
    /// covered brick is left in the air.
    pub stable: bool,
    /// Pairs of bricks in the same place.
    pub collisions: Vec<Collision>,
    /// Where it would break first; `null` where no stud is pulled or nothing balances.
    pub weakest: Option<WeakestConnection>,
    /// Indices of the bricks in an order in which each can be put in.
    pub build_order: Vec<usize>,
    /// Whether in that order each brick can be put in along its studs from a free side, as far as boxes tell.
    pub buildable: bool,
    /// Gripped studs.
    pub connections: usize,
    /// How many groups of bricks hold together, single covered bricks included.
    pub groups: usize,
    /// Covered bricks in groups that no brick on the ground carries.
    pub loose_parts: Vec<usize>,
    /// What the figures leave out, and why it does not stand, for people.
    pub notes: Vec<String>,
}

impl Model {
    /// Collisions, connections, equilibrium and a build order. Indices are those of [`Model::instances`].
    ///
    /// # Errors
    /// `Error::Input` for a model that lacks parts; `Error::Failed` where the solver finds no answer.
    pub fn check(&self, options: &CheckOptions) -> Result<CheckReport> {
        self.require_complete()?;
        let shapes = Shapes::of(self);
        let neighbors = Neighbors::of(self, &shapes);
        let connections = connections_with(self, &shapes, &neighbors);
        let collisions = collisions(self, &shapes, &neighbors);
        let ground = neighbors.boxes.iter().map(|b| b.max.y).fold(f64::NEG_INFINITY, f64::max);
        let covered = |group: &&Group| group.bricks.iter().any(|&b| connections.covered[b]);
        let groups = connections.groups();
        let groups: Vec<&Group> = groups.iter().filter(covered).collect();
        let on_ground = |brick: usize| neighbors.boxes[brick].max.y > ground - GROUND_LDU;
        let (standing, loose): (Vec<&Group>, Vec<&Group>) =
            groups.iter().copied().partition(|group| group.bricks.iter().any(|&brick| on_ground(brick)));
        let mut carried: Vec<usize> = standing.iter().flat_map(|group| group.bricks.iter().copied()).collect();
        carried.sort_unstable();
        let mut loose_parts: Vec<usize> = loose.iter().flat_map(|group| group.bricks.iter().copied()).collect();
        loose_parts.sort_unstable();

        let mut notes = vec![];
        let covered_parts = connections.covered.iter().filter(|&&c| c).count();
        let parts = self.instances().len();
        if covered_parts < parts {
            notes.push(format!(
                "{} of {parts} parts have no studs and sit on none (hinges, clips, axles, figures): they are left out of \
                 connections and equilibrium",
                parts - covered_parts
            ));
        }
        if !loose_parts.is_empty() {
            notes.push(format!("{} parts hold to nothing that stands on the ground by studs", loose_parts.len()));
        }
        let bodies: Vec<Body> = carried
            .iter()
            .map(|&brick| self.body(brick, &shapes, &neighbors.boxes[brick], ground, options.density_kg_m3))
            .collect();
        let body_of_brick: BTreeMap<usize, usize> = carried.iter().enumerate().map(|(body, &b)| (b, body)).collect();
        let of_bodies: Vec<Connection> = connections
            .studs
            .iter()
            .filter_map(|c| {
                let (stud_brick, grip_brick) = (*body_of_brick.get(&c.stud_brick)?, *body_of_brick.get(&c.grip_brick)?);
                Some(Connection { stud_brick, grip_brick, ..*c })
            })
            .collect();
        let (stands, weakest) = match equilibrium(&bodies, &of_bodies, options.clutch_n) {
            Equilibrium::Balanced { load, load_of_stud } => {
                if load > 1.0 {
                    notes.push(format!("a stud would have to bear {load:.2} times its clutch force"));
                }
                (load <= 1.0, weakest(&of_bodies, &load_of_stud, &carried))
            }
            Equilibrium::Tips => {
                notes.push("it tips over: no forces of studs and ground balance the weights".to_owned());
                (false, None)
            }
            Equilibrium::Unknown => {
                return Err(Error::Failed("the equilibrium of the model could not be computed".to_owned()));
            }
        };
        let (build_order, buildable) = build_order(&neighbors.boxes, &connections.studs, ground - GROUND_LDU);
        Ok(CheckReport {
            parts,
            covered_parts,
            connected: groups.len() <= 1,
            stable: stands && loose_parts.is_empty(),
            collisions,
            weakest,
            build_order,
            buildable,
            connections: connections.studs.len(),
            groups: groups.len(),
            loose_parts,
            notes,
        })
    }

    fn body(&self, brick: usize, shapes: &Shapes, bounds: &Aabb, ground: f64, density_kg_m3: f64) -> Body {
        let instance = &self.instances()[brick];
        let shape = shapes.get(instance.part);
        let corner = |v: u32| instance.ldraw_from_part.apply(&shape.vertices[v as usize]);
        // Volume and centroid by the divergence theorem, about the middle of the box; nearly right for surfaces that
        // are nearly closed.
        let middle = bounds.center();
        let (mut volume, mut moment) = (0.0, Vector3::zeros());
        for triangle in &shape.triangles {
            let [a, b, c] = triangle.map(|v| corner(v) - middle);
            let piece = a.dot(&b.cross(&c)) / 6.0;
            volume += piece;
            moment += (a + b + c) * (piece / 4.0);
        }
        let box_volume = bounds.extent().product();
        let plausible = (0.02..=1.0).contains(&(volume.abs() / box_volume));
        let center = if plausible { middle + moment / volume } else { middle };
        let center = if bounds.contains(&center) { center } else { middle };
        // A quarter of its box is what a hollow brick fills.
        let filled = if plausible { volume.abs() } else { 0.25 * box_volume };
        let mass_kg = filled * METRES_PER_LDU.powi(3) * density_kg_m3;
        let feet: Vec<Point3<f64>> = shape
            .vertices
            .iter()
            .map(|p| instance.ldraw_from_part.apply(p))
            .filter(|p| p.y > ground - GROUND_LDU)
            .collect();
        Body { mass_kg, center, ground: convex_hull(feet) }
    }
}

fn weakest(connections: &[Connection], loads: &[f64], carried: &[usize]) -> Option<WeakestConnection> {
    let (hardest, load) = connections.iter().zip(loads).max_by(|a, b| a.1.total_cmp(b.1))?;
    let same = |c: &&Connection| (c.stud_brick, c.grip_brick) == (hardest.stud_brick, hardest.grip_brick);
    (*load > 1e-6).then(|| WeakestConnection {
        stud_brick: carried[hardest.stud_brick],
        grip_brick: carried[hardest.grip_brick],
        studs: connections.iter().filter(same).count(),
        load: *load,
    })
}

/// The corners of the convex hull of points on the ground (Andrew's monotone chain in x and z).
fn convex_hull(mut points: Vec<Point3<f64>>) -> Vec<Point3<f64>> {
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.z.total_cmp(&b.z)));
    points.dedup_by(|a, b| (a.x - b.x).abs() < 1e-6 && (a.z - b.z).abs() < 1e-6);
    if points.len() < 3 {
        return points;
    }
    let turn =
        |o: &Point3<f64>, a: &Point3<f64>, b: &Point3<f64>| (a.x - o.x) * (b.z - o.z) - (a.z - o.z) * (b.x - o.x);
    let half = |points: &mut dyn Iterator<Item = &Point3<f64>>| {
        let mut chain: Vec<Point3<f64>> = vec![];
        for p in points {
            while chain.len() > 1 && turn(&chain[chain.len() - 2], &chain[chain.len() - 1], p) <= 1e-9 {
                chain.pop();
            }
            chain.push(*p);
        }
        chain.pop();
        chain
    };
    let mut hull = half(&mut points.iter());
    hull.extend(half(&mut points.iter().rev()));
    hull
}
