//! Axis-aligned boxes.

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

/// An axis-aligned box. The empty box has `min` at +infinity and `max` at -infinity.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Aabb {
    /// Smallest corner.
    pub min: Point3<f64>,
    /// Largest corner.
    pub max: Point3<f64>,
}

impl Aabb {
    /// The box that holds nothing.
    pub fn empty() -> Self {
        Self { min: Point3::from([f64::INFINITY; 3]), max: Point3::from([f64::NEG_INFINITY; 3]) }
    }

    /// The smallest box around `points`.
    pub fn of<'a>(points: impl IntoIterator<Item = &'a Point3<f64>>) -> Self {
        let mut aabb = Self::empty();
        points.into_iter().for_each(|p| aabb.add(p));
        aabb
    }

    /// Grows the box to hold `p`.
    pub fn add(&mut self, p: &Point3<f64>) {
        self.min = self.min.inf(p);
        self.max = self.max.sup(p);
    }

    /// The smallest box around both.
    pub fn union(&self, other: &Self) -> Self {
        Self { min: self.min.inf(&other.min), max: self.max.sup(&other.max) }
    }

    /// The box grown by `margin` on every side.
    pub fn grown(&self, margin: f64) -> Self {
        let margin = Vector3::repeat(margin);
        Self { min: self.min - margin, max: self.max + margin }
    }

    /// Whether the box holds no point.
    pub fn is_empty(&self) -> bool {
        (0..3).any(|axis| self.min[axis] > self.max[axis])
    }

    /// Edge lengths.
    pub fn extent(&self) -> Vector3<f64> {
        self.max - self.min
    }

    /// Middle point.
    pub fn center(&self) -> Point3<f64> {
        nalgebra::center(&self.min, &self.max)
    }

    /// Whether `p` lies inside or on the border.
    pub fn contains(&self, p: &Point3<f64>) -> bool {
        (0..3).all(|axis| self.min[axis] <= p[axis] && p[axis] <= self.max[axis])
    }

    /// The eight corners.
    pub fn corners(&self) -> [Point3<f64>; 8] {
        std::array::from_fn(|i| {
            let pick = |axis: usize| if i >> axis & 1 == 0 { self.min[axis] } else { self.max[axis] };
            Point3::new(pick(0), pick(1), pick(2))
        })
    }
}
