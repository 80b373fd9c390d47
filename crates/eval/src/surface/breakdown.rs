//! Where a score comes from: by brick, by kind of surface, by how well the cameras saw it; normals, floaters, coverage.

use std::collections::BTreeMap;

use mb_geometry::Ray;
use mb_mesh::{Bvh, TriangleMesh};
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::curve::Curve;
use super::score::f1;
use super::setting::{Groups, Setting, StudFinder};

/// The score in pieces. Points of the ground truth count for the piece that they lie on, points of the prediction for the
/// piece that the closest point of the ground truth lies on. A split is `None` where the sequence does not say what it
/// needs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Breakdown {
    /// By brick; needs the ground truth's triangles to carry parts, as `mesh/visible_surface.ply` does.
    pub by_part: Option<Vec<Group<OfPart>>>,
    /// By kind of surface; needs an alignment, which says where up is (and the model, which shows the studs).
    pub by_region: Option<Vec<Group<OfRegion>>>,
    /// By the best angle at which a camera saw the place; needs poses.
    pub by_viewing_angle: Option<Vec<Group<OfAngle>>>,
    /// By the number of cameras that saw the place; needs poses.
    pub by_views: Option<Vec<Group<OfViews>>>,
    /// Whether the surfaces face the same way; `None` for point clouds.
    pub normals: Option<Normals>,
    /// What the prediction has where nothing is.
    pub floaters: Floaters,
    /// What of the ground truth was found at all.
    pub coverage: Coverage,
}

/// The score of one piece.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Group<K> {
    /// Which piece.
    #[serde(flatten)]
    pub of: K,
    /// Points of the ground truth in it.
    pub gt_points: usize,
    /// Points of the prediction in it.
    pub pred_points: usize,
    /// Mean distance from the ground truth to the prediction, millimetres.
    pub gt_to_pred_mm: Option<f64>,
    /// Mean distance from the prediction to the ground truth, millimetres.
    pub pred_to_gt_mm: Option<f64>,
    /// Shares at each threshold.
    pub thresholds: Vec<GroupThreshold>,
}

/// Shares of a piece's points within a threshold; `None` where the piece has no points.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GroupThreshold {
    /// The threshold, millimetres.
    pub threshold_mm: f64,
    /// Share of the prediction's points.
    pub accuracy: Option<f64>,
    /// Share of the ground truth's points.
    pub recall: Option<f64>,
    /// Harmonic mean of both.
    pub f1: Option<f64>,
}

/// A brick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct OfPart {
    /// Its number in the model.
    pub part: u32,
}

/// A kind of surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct OfRegion {
    /// Which kind.
    pub region: Region,
}

/// Kinds of surface of a brick model. A place is of the first kind that fits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Region {
    /// Studs, tips and sides.
    Studs,
    /// Faces of a brick that look at the same brick less than 8 mm away: pin holes, tubes, slots, narrow hollows.
    Holes,
    /// Faces that look up within 45 degrees.
    Tops,
    /// Faces that look down within 45 degrees.
    Undersides,
    /// All other faces.
    Walls,
}

/// A range of viewing angles, between the surface's normal and the line to the camera, lower bound included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct OfAngle {
    /// From, degrees.
    pub from_deg: u32,
    /// To, degrees.
    pub to_deg: u32,
}

/// A range of numbers of views, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct OfViews {
    /// From.
    pub from_views: u32,
    /// To; `None` is without end.
    pub to_views: Option<u32>,
}

/// Consistency of normals: the mean absolute cosine between a point's normal and that of the closest point of the other
/// surface (Mescheder et al. 2019, "Occupancy Networks", section 4); 1 is perfect, 0.5 is chance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Normals {
    /// Over the prediction's points.
    pub pred_to_gt: f64,
    /// Over the ground truth's points.
    pub gt_to_pred: f64,
    /// Mean of the two.
    pub consistency: f64,
    /// Share of the prediction's points whose normal looks away from the true one by more than 90 degrees: near 1 the
    /// triangles are wound the wrong way round.
    pub opposed_share: f64,
}

/// Pieces of the prediction that float in the air.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Floaters {
    /// Share of the prediction's points farther than 20 mm from the ground truth.
    pub share: f64,
    /// Connected pieces of the prediction (triangles that share vertices) with judged points, all of them that far away.
    /// `None` for point clouds and for triangles that share no vertices.
    pub pieces: Option<usize>,
}

/// What of the ground truth was found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Coverage {
    /// Share of the ground truth's points with any prediction within 20 mm.
    pub share: f64,
    /// Bricks that have at least ten points, of which less than half have any prediction within 5 mm. `None` where the
    /// ground truth carries no parts.
    pub missed_parts: Option<Vec<u32>>,
}

/// A judged point with what it was compared to.
#[derive(Debug, Clone, Copy)]
pub(super) struct Judged {
    /// The point, world frame.
    pub point: Point3<f64>,
    /// Triangle of its own surface; `None` in a cloud.
    pub triangle: Option<u32>,
    /// Closest point of the other surface.
    pub partner: Point3<f64>,
    /// Its triangle; `None` in a cloud.
    pub partner_triangle: Option<u32>,
    /// How far that is, metres.
    pub distance_m: f64,
}

/// What the breakdown is made from.
pub(super) struct Parts<'a> {
    pub gt: &'a TriangleMesh,
    /// The search tree of `gt`; `None` where the mesh is too large for one.
    pub gt_bvh: Option<&'a Bvh>,
    /// How far the true surface may be off itself, metres: rays start this far away from it.
    pub lift_m: f64,
    pub prediction: &'a TriangleMesh,
    pub setting: &'a Setting,
    pub gt_points: &'a [Judged],
    pub pred_points: &'a [Judged],
    pub thresholds_mm: &'a [f64],
}

/// A face that looks at its own brick nearer than this is in a hole, metres: the pitch of studs.
const HOLE_M: f64 = 0.008;
/// Points of each side for which cameras are counted, spread over all.
const VIEWED_POINTS: usize = 4_000;
/// Width of a range of viewing angles, degrees.
const ANGLE_STEP_DEG: u32 = 15;
/// First number of views of each range.
const VIEW_RANGES: [u32; 6] = [0, 1, 3, 6, 11, 21];
/// A floater is farther away than this, millimetres.
const FAR_MM: f64 = Curve::LIMIT_MM;

impl Breakdown {
    pub(super) fn of(parts: &Parts) -> Self {
        let far = |judged: &[Judged]| judged.iter().filter(|j| 1000.0 * j.distance_m > FAR_MM).count();
        let by_part = parts.by_part();
        let missed = by_part.as_ref().map(|groups| {
            // Below half at 5 mm, which is always among the thresholds.
            let at = |g: &Group<OfPart>| g.thresholds.iter().find(|t| t.threshold_mm == 5.0).and_then(|t| t.recall);
            let missed = groups.iter().filter(|g| g.gt_points >= 10 && at(g).is_some_and(|recall| recall < 0.5));
            missed.map(|g| g.of.part).collect()
        });
        let seen = parts.seen();
        Self {
            by_part,
            by_region: parts.by_region(),
            by_viewing_angle: seen.as_ref().map(|(gt, pred)| {
                let key = |s: &Seen| s.angle_deg.map(angle_range);
                split(parts, gt, pred, key)
            }),
            by_views: seen.as_ref().map(|(gt, pred)| split(parts, gt, pred, |s| Some(view_range(s.views)))),
            normals: parts.normals(),
            floaters: Floaters {
                share: far(parts.pred_points) as f64 / parts.pred_points.len() as f64,
                pieces: parts.floating_pieces(),
            },
            coverage: Coverage {
                share: 1.0 - far(parts.gt_points) as f64 / parts.gt_points.len() as f64,
                missed_parts: missed,
            },
        }
    }
}

fn angle_range(angle_deg: f64) -> OfAngle {
    let from_deg = (angle_deg / f64::from(ANGLE_STEP_DEG)).floor().clamp(0.0, 5.0) as u32 * ANGLE_STEP_DEG;
    OfAngle { from_deg, to_deg: from_deg + ANGLE_STEP_DEG }
}

fn view_range(views: u32) -> OfViews {
    let at = VIEW_RANGES.partition_point(|&first| first <= views);
    OfViews { from_views: VIEW_RANGES[at - 1], to_views: VIEW_RANGES.get(at).map(|next| next - 1) }
}

/// A place on the true surface.
#[derive(Clone, Copy)]
struct Place {
    point: Point3<f64>,
    triangle: usize,
}

impl Judged {
    /// Where a point of the ground truth lies on it.
    fn own_place(&self) -> Place {
        Place { point: self.point, triangle: self.triangle.unwrap_or(0) as usize }
    }

    /// Where the closest point of the ground truth lies on it.
    fn partner_place(&self) -> Place {
        Place { point: self.partner, triangle: self.partner_triangle.unwrap_or(0) as usize }
    }
}

/// How cameras saw a place.
struct Seen {
    /// Index of the point.
    at: usize,
    views: u32,
    /// The smallest angle; `None` where no camera saw it.
    angle_deg: Option<f64>,
}

impl Parts<'_> {
    fn by_part(&self) -> Option<Vec<Group<OfPart>>> {
        let parts = self.gt.triangle_parts.as_ref()?;
        let key = |place: Place| OfPart { part: parts[place.triangle] };
        Some(self.split_all(key))
    }

    fn by_region(&self) -> Option<Vec<Group<OfRegion>>> {
        let up = self.setting.up_in_world?;
        let bvh = self.gt_bvh?;
        let studs = StudFinder::new(&self.setting.studs);
        let part = |triangle: usize| self.gt.triangle_parts.as_ref().map(|parts| parts[triangle]);
        let region = |place: Place| {
            let Some(normal) = self.gt.scaled_normal(place.triangle).try_normalize(0.0) else { return Region::Walls };
            if studs.is_on_stud(&place.point) {
                return Region::Studs;
            }
            let ray = Ray { origin: place.point + normal * self.lift_m, direction: normal };
            let faced = bvh.cast(&ray, HOLE_M).map(|hit| hit.triangle as usize);
            if faced.is_some_and(|triangle| part(triangle) == part(place.triangle)) {
                return Region::Holes;
            }
            match normal.dot(&up) {
                v if v > std::f64::consts::FRAC_1_SQRT_2 => Region::Tops,
                v if v < -std::f64::consts::FRAC_1_SQRT_2 => Region::Undersides,
                _ => Region::Walls,
            }
        };
        Some(self.split_all(|place| OfRegion { region: region(place) }))
    }

    /// Splits all points by a property of the place.
    fn split_all<K: Ord + Copy + Send>(&self, key: impl Fn(Place) -> K + Sync) -> Vec<Group<K>> {
        let keys = |points: &[Judged], place: fn(&Judged) -> Place| -> Vec<(usize, K)> {
            points
                .par_iter()
                .with_min_len(256)
                .map(|j| key(place(j)))
                .collect::<Vec<K>>()
                .into_iter()
                .enumerate()
                .collect()
        };
        let gt = keys(self.gt_points, Judged::own_place);
        let pred = keys(self.pred_points, Judged::partner_place);
        let numbered = |(at, key): &(usize, K)| (*at, *key);
        groups(self, gt.iter().map(numbered), pred.iter().map(numbered))
    }

    /// How cameras saw some points of either side; `None` without cameras.
    fn seen(&self) -> Option<(Vec<Seen>, Vec<Seen>)> {
        let bvh = self.gt_bvh.filter(|_| !self.setting.cameras.is_empty())?;
        let side = |points: &[Judged], place: fn(&Judged) -> Place| {
            let step = points.len().div_ceil(VIEWED_POINTS).max(1);
            let indices: Vec<usize> = (0..points.len()).step_by(step).collect();
            indices.par_iter().map(|&at| self.look_at(bvh, at, place(&points[at]))).collect::<Vec<Seen>>()
        };
        Some((side(self.gt_points, Judged::own_place), side(self.pred_points, Judged::partner_place)))
    }

    /// A camera sees a place that falls into its image where nothing lies between. Which side a face shows is left to
    /// what lies between: a place seen from behind is hidden by its own brick.
    fn look_at(&self, bvh: &Bvh, at: usize, place: Place) -> Seen {
        let normal = self.gt.scaled_normal(place.triangle).try_normalize(0.0).unwrap_or_else(Vector3::zeros);
        let mut seen = Seen { at, views: 0, angle_deg: None };
        for camera in &self.setting.cameras {
            let Some(centre) = camera.sees(&place.point) else { continue };
            let to_camera = centre - place.point;
            let distance = to_camera.norm();
            let ray = Ray { origin: place.point + to_camera * (self.lift_m / distance), direction: to_camera };
            if bvh.occluded(&ray, 1.0 - self.lift_m / distance) {
                continue;
            }
            seen.views += 1;
            let angle = (normal.dot(&to_camera).abs() / distance).min(1.0).acos().to_degrees();
            seen.angle_deg = Some(seen.angle_deg.map_or(angle, |best: f64| best.min(angle)));
        }
        seen
    }

    fn normals(&self) -> Option<Normals> {
        if self.prediction.triangles.is_empty() {
            return None;
        }
        let cosine = |own: &TriangleMesh, other: &TriangleMesh, j: &Judged| {
            let normal = |mesh: &TriangleMesh, t: Option<u32>| mesh.scaled_normal(t? as usize).try_normalize(0.0);
            Some(normal(own, j.triangle)?.dot(&normal(other, j.partner_triangle)?))
        };
        let pred: Vec<f64> = self.pred_points.iter().filter_map(|j| cosine(self.prediction, self.gt, j)).collect();
        let gt: Vec<f64> = self.gt_points.iter().filter_map(|j| cosine(self.gt, self.prediction, j)).collect();
        if pred.is_empty() || gt.is_empty() {
            return None;
        }
        let mean = |cosines: &[f64]| cosines.iter().map(|c| c.abs()).sum::<f64>() / cosines.len() as f64;
        let (pred_to_gt, gt_to_pred) = (mean(&pred), mean(&gt));
        Some(Normals {
            pred_to_gt,
            gt_to_pred,
            consistency: 0.5 * (pred_to_gt + gt_to_pred),
            opposed_share: pred.iter().filter(|c| **c < 0.0).count() as f64 / pred.len() as f64,
        })
    }

    fn floating_pieces(&self) -> Option<usize> {
        if self.prediction.vertices.len() >= 3 * self.prediction.triangles.len() {
            return None;
        }
        let mut pieces = Groups::new(self.prediction.vertices.len());
        for &[a, b, c] in &self.prediction.triangles {
            pieces.join(a as usize, b as usize);
            pieces.join(b as usize, c as usize);
        }
        let mut floats: BTreeMap<usize, bool> = BTreeMap::new();
        for judged in self.pred_points {
            let Some(triangle) = judged.triangle else { continue };
            let piece = pieces.root(self.prediction.triangles[triangle as usize][0] as usize);
            *floats.entry(piece).or_insert(true) &= 1000.0 * judged.distance_m > FAR_MM;
        }
        Some(floats.values().filter(|floats| **floats).count())
    }
}

/// Splits some points by how cameras saw them.
fn split<K: Ord + Copy>(parts: &Parts, gt: &[Seen], pred: &[Seen], key: impl Fn(&Seen) -> Option<K>) -> Vec<Group<K>> {
    let keyed = |seen: &Seen| key(seen).map(|key| (seen.at, key));
    groups(parts, gt.iter().filter_map(keyed), pred.iter().filter_map(keyed))
}

/// Groups in ascending order of their keys, from (index of the point, key) of either side.
fn groups<K: Ord + Copy>(
    parts: &Parts,
    gt: impl Iterator<Item = (usize, K)>,
    pred: impl Iterator<Item = (usize, K)>,
) -> Vec<Group<K>> {
    let empty = || [Tally::new(parts.thresholds_mm.len()), Tally::new(parts.thresholds_mm.len())];
    let mut tallies: BTreeMap<K, [Tally; 2]> = BTreeMap::new();
    for (at, key) in gt {
        tallies.entry(key).or_insert_with(empty)[0].add(parts.gt_points[at].distance_m, parts.thresholds_mm);
    }
    for (at, key) in pred {
        tallies.entry(key).or_insert_with(empty)[1].add(parts.pred_points[at].distance_m, parts.thresholds_mm);
    }
    let group = |(of, [gt, pred]): (K, [Tally; 2])| {
        let threshold = |(i, &threshold_mm): (usize, &f64)| {
            let (accuracy, recall) = (pred.share(i), gt.share(i));
            GroupThreshold { threshold_mm, accuracy, recall, f1: accuracy.zip(recall).map(|(a, r)| f1(a, r)) }
        };
        Group {
            of,
            gt_points: gt.count,
            pred_points: pred.count,
            gt_to_pred_mm: gt.mean_mm(),
            pred_to_gt_mm: pred.mean_mm(),
            thresholds: parts.thresholds_mm.iter().enumerate().map(threshold).collect(),
        }
    };
    tallies.into_iter().map(group).collect()
}

/// Running sums over points.
struct Tally {
    count: usize,
    distance_m: f64,
    below: Vec<usize>,
}

impl Tally {
    fn new(thresholds: usize) -> Self {
        Self { count: 0, distance_m: 0.0, below: vec![0; thresholds] }
    }

    fn add(&mut self, distance_m: f64, thresholds_mm: &[f64]) {
        self.count += 1;
        self.distance_m += distance_m;
        self.below.iter_mut().zip(thresholds_mm).for_each(|(n, t)| *n += usize::from(distance_m < t / 1000.0));
    }

    fn mean_mm(&self) -> Option<f64> {
        (self.count > 0).then(|| 1000.0 * self.distance_m / self.count as f64)
    }

    fn share(&self, threshold: usize) -> Option<f64> {
        (self.count > 0).then(|| self.below[threshold] as f64 / self.count as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_have_no_gaps() {
        for views in 0..60 {
            let range = view_range(views);
            assert!(range.from_views <= views && range.to_views.is_none_or(|to| views <= to), "{views}: {range:?}");
        }
        assert_eq!(view_range(2), OfViews { from_views: 1, to_views: Some(2) });
        assert_eq!(view_range(21).to_views, None);
        assert_eq!(angle_range(0.0).from_deg, 0);
        assert_eq!(angle_range(29.9), OfAngle { from_deg: 15, to_deg: 30 });
        assert_eq!(angle_range(90.0), OfAngle { from_deg: 75, to_deg: 90 });
    }
}
