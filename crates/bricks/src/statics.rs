//! Whether a model stands: static equilibrium as a convex programme.
//!
//! Every brick must be in balance (three forces, three torques) under its weight and the forces of its connections,
//! as in Luo et al., "Legolization: Optimizing LEGO Designs", ACM Transactions on Graphics 34(6), 2015, and Liu et
//! al., "StableLego: Stability Analysis of Block Stacking Assembly", IEEE Robotics and Automation Letters, 2024. For a
//! gripped stud with axis `a` the unknowns are, at four points around its foot,
//!
//! - `c_j >= 0`, pressing the two bricks apart along `a` (the bottom of one rests on the top of the other);
//! - `t_j >= 0`, holding them together along `a` (friction of the clutch);
//! - two forces across the stud (its flank against tubes and walls), of either sign;
//! - a torque about `a` of either sense, which friction gives at the stud's radius `r`: `q+ - q-`, both at least 0.
//!
//! Bricks on the ground are pressed up at the corners of their foot, bricks that lie on others without a stud at the
//! corners of the common patch; neither pulls. With `T` the clutch
//! force of one stud, the programme is
//!
//! ```text
//! minimise   load + (a little of all forces)
//! such that  every brick is in balance,
//!            sum_j t_j + (q+ + q-) / r <= load T  for every stud,
//!            c_j, t_j, q+, q-, ground forces >= 0.
//! ```
//!
//! `load` is then the largest share of the clutch force that any stud must bear, in the distribution that is kindest
//! to the studs. The model stands where there is a solution with `load <= 1`; it tips over where there is none. The
//! solver is Clarabel, an interior-point method. Not modelled: bricks that lean on each other sideways, bending, friction
//! on the ground (loads are vertical).

use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettings, DefaultSolver, IPSolver, SolverStatus, SupportedConeT};
use nalgebra::{Point3, Vector3};

use crate::connections::Connection;

/// Radius of a stud: where it presses and holds, LDraw units.
const STUD_RADIUS_LDU: f64 = 6.0;
/// Standard gravity, metres per square second.
const GRAVITY_M_S2: f64 = 9.80665;
/// Lever arms are counted in studs, which keeps the rows of the programme alike in size.
const LEVER_LDU: f64 = 20.0;
/// How little all forces weigh against the load: it picks one of many equal solutions.
const SMALL: f64 = 1e-6;

/// A rigid body of the programme.
pub(crate) struct Body {
    /// Mass, kilograms.
    pub mass_kg: f64,
    /// Centre of mass, LDraw frame.
    pub center: Point3<f64>,
    /// Corners of its foot on the ground, empty where it does not touch it.
    pub ground: Vec<Point3<f64>>,
}

/// One body lies on another.
pub(crate) struct Contact {
    /// Index of the body above.
    pub upper: usize,
    /// Index of the body below.
    pub lower: usize,
    /// Corners of the patch that they share, LDraw frame.
    pub corners: Vec<Point3<f64>>,
}

/// The outcome.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Equilibrium {
    /// There is a balance.
    Balanced {
        /// Largest share of the clutch force that any stud bears.
        load: f64,
        /// That share for each connection.
        load_of_stud: Vec<f64>,
    },
    /// Nothing holds the model up.
    Tips,
    /// The solver gave up.
    Unknown,
}

/// Solves the programme. The connections' brick indices are those of `bodies`.
pub(crate) fn equilibrium(
    bodies: &[Body],
    connections: &[Connection],
    contacts: &[Contact],
    clutch_n: f64,
) -> Equilibrium {
    let mut programme = Programme::new(bodies.len(), connections.len());
    let load = programme.variable(1.0, false);
    let mut tensions = Vec::with_capacity(connections.len());
    for (index, connection) in connections.iter().enumerate() {
        let (foot, axis) = (connection.foot_in_ldraw, connection.axis_in_ldraw);
        let across = axis.cross(&if axis.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() }).normalize();
        let beside = axis.cross(&across);
        let mut pair = |force: Vector3<f64>, at: Point3<f64>, signed: bool| {
            let variable = programme.variable(if signed { 0.0 } else { SMALL }, !signed);
            programme.force(variable, &bodies[connection.grip_brick], connection.grip_brick, &force, &at);
            programme.force(variable, &bodies[connection.stud_brick], connection.stud_brick, &-force, &at);
            variable
        };
        let mut held = vec![];
        for arm in [across, beside, -across, -beside] {
            let at = foot + arm * STUD_RADIUS_LDU;
            pair(axis, at, false);
            held.push(pair(-axis, at, false));
        }
        for direction in [across, beside] {
            pair(direction, foot + axis * 2.0, true);
        }
        for torque in [axis, -axis] {
            // A variable of one newton at the stud's radius.
            let variable = programme.variable(SMALL, true);
            programme.torque(variable, connection.grip_brick, &(torque * STUD_RADIUS_LDU));
            programme.torque(variable, connection.stud_brick, &(-torque * STUD_RADIUS_LDU));
            held.push(variable);
        }
        for &variable in &held {
            programme.clutch(index, variable, 1.0);
        }
        programme.clutch(index, load, -clutch_n);
        tensions.push(held);
    }
    for (index, body) in bodies.iter().enumerate() {
        // LDraw's y points down.
        let weight = Vector3::new(0.0, body.mass_kg * GRAVITY_M_S2, 0.0);
        programme.weight(index, &weight);
        for corner in &body.ground {
            let variable = programme.variable(SMALL, true);
            programme.force(variable, body, index, &-Vector3::y(), corner);
        }
    }
    for Contact { upper, lower, corners } in contacts {
        for corner in corners {
            let variable = programme.variable(SMALL, true);
            programme.force(variable, &bodies[*upper], *upper, &-Vector3::y(), corner);
            programme.force(variable, &bodies[*lower], *lower, &Vector3::y(), corner);
        }
    }
    match programme.solve() {
        Solution::Found(x) => {
            let load_of_stud: Vec<f64> =
                tensions.iter().map(|held| held.iter().map(|&v| x[v].max(0.0)).sum::<f64>() / clutch_n).collect();
            Equilibrium::Balanced { load: load_of_stud.iter().copied().fold(0.0, f64::max), load_of_stud }
        }
        Solution::None => Equilibrium::Tips,
        Solution::Unknown => Equilibrium::Unknown,
    }
}

enum Solution {
    Found(Vec<f64>),
    None,
    Unknown,
}

/// Rows: balance (six for each body), clutch (one for each stud), signs (one for each signless variable).
struct Programme {
    clutch_row: usize,
    sign_row: usize,
    /// Row, column, value.
    entries: Vec<(usize, usize, f64)>,
    costs: Vec<f64>,
    signs: Vec<usize>,
    right_side: Vec<f64>,
}

impl Programme {
    fn new(bodies: usize, studs: usize) -> Self {
        let (clutch_row, sign_row) = (6 * bodies, 6 * bodies + studs);
        Self { clutch_row, sign_row, entries: vec![], costs: vec![], signs: vec![], right_side: vec![0.0; sign_row] }
    }

    fn variable(&mut self, cost: f64, nonnegative: bool) -> usize {
        self.costs.push(cost);
        if nonnegative {
            self.signs.push(self.costs.len() - 1);
        }
        self.costs.len() - 1
    }

    /// A force of one newton times the variable, on a body.
    fn force(&mut self, variable: usize, body: &Body, index: usize, force: &Vector3<f64>, at: &Point3<f64>) {
        let torque = (at - body.center).cross(force) / LEVER_LDU;
        for (offset, value) in force.iter().chain(torque.iter()).enumerate() {
            if value.abs() > 1e-12 {
                self.entries.push((6 * index + offset, variable, *value));
            }
        }
    }

    /// A torque of one newton times LDraw unit times the variable, on a body.
    fn torque(&mut self, variable: usize, index: usize, torque: &Vector3<f64>) {
        for (offset, value) in (torque / LEVER_LDU).iter().enumerate() {
            if value.abs() > 1e-12 {
                self.entries.push((6 * index + 3 + offset, variable, *value));
            }
        }
    }

    fn weight(&mut self, index: usize, weight: &Vector3<f64>) {
        for (offset, value) in weight.iter().enumerate() {
            self.right_side[6 * index + offset] -= value;
        }
    }

    fn clutch(&mut self, stud: usize, variable: usize, value: f64) {
        self.entries.push((self.clutch_row + stud, variable, value));
    }

    fn solve(mut self) -> Solution {
        let variables = self.costs.len();
        for (row, &variable) in self.signs.iter().enumerate() {
            self.entries.push((self.sign_row + row, variable, -1.0));
        }
        let rows = self.sign_row + self.signs.len();
        self.right_side.resize(rows, 0.0);
        let columns = |entries: &[(usize, usize, f64)], rows: usize| {
            let (i, rest): (Vec<_>, Vec<_>) = entries.iter().map(|&(i, j, v)| (i, (j, v))).unzip();
            let (j, v) = rest.into_iter().unzip();
            CscMatrix::new_from_triplets(rows, variables, i, j, v)
        };
        let constraints = columns(&self.entries, rows);
        let diagonal: Vec<_> = (0..variables).map(|v| (v, v, SMALL)).collect();
        let quadratic = columns(&diagonal, variables);
        let cones =
            [SupportedConeT::ZeroConeT(self.clutch_row), SupportedConeT::NonnegativeConeT(rows - self.clutch_row)];
        let settings = DefaultSettings { verbose: false, ..DefaultSettings::default() };
        let solver = DefaultSolver::new(&quadratic, &self.costs, &constraints, &self.right_side, &cones, settings);
        let Ok(mut solver) = solver else { return Solution::Unknown };
        solver.solve();
        match solver.solution.status {
            SolverStatus::Solved | SolverStatus::AlmostSolved => Solution::Found(solver.solution.x.clone()),
            SolverStatus::PrimalInfeasible | SolverStatus::AlmostPrimalInfeasible => Solution::None,
            _ => Solution::Unknown,
        }
    }
}
