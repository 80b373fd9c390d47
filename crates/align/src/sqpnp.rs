//! The pose of an object from 3D points and the rays that they were seen along, by SQPnP's cost.

use mb_geometry::{Object, Rigid3, World};
use nalgebra::{Matrix3, Point3, SMatrix, SVector, UnitQuaternion, Vector3};

type Matrix9 = SMatrix<f64, 9, 9>;
type Vector9 = SVector<f64, 9>;
type Matrix9x3 = SMatrix<f64, 9, 3>;

/// A point of the object and the ray that it was seen along.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sighting {
    /// The camera's centre, metres.
    pub origin_in_world: Point3<f64>,
    /// Towards the point; the length does not matter.
    pub direction_in_world: Vector3<f64>,
    /// The point seen, metres.
    pub point_in_object: Point3<f64>,
}

/// One local minimum of the cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Solution {
    /// The pose.
    pub world_from_object: Rigid3<World, Object>,
    /// Sum of squared distances of the points to their rays, square metres.
    pub cost_m2: f64,
    /// How many points lie in front of their camera.
    pub in_front: usize,
}

/// Minimises the sum of squared distances between points and their rays over all rigid poses of the object.
///
/// This is the cost of SQPnP (Terzakis and Lourakis, "A Consistently Fast and Globally Optimal Solution to the
/// Perspective-n-Point Problem", ECCV 2020, eq. 6 to 11): the translation is eliminated, which leaves a quadratic
/// `r' W r + 2 g' r + k` in the nine entries of the rotation. With one camera `g` vanishes and the starts are theirs,
/// the rotations nearest to the eigenvectors of `W`. With several cameras `g` does not vanish, and the starts are the
/// rotation nearest to the free minimum and the 24 rotations of a cube. From each start Newton's method runs on SO(3),
/// which needs 3x3 systems where sequential quadratic programming needs 9x9 ones.
///
/// Returns the distinct local minima that were met, those with all points in front of their cameras first, then by
/// cost. Empty for degenerate input: fewer than four sightings (three leave several exact solutions), parallel rays,
/// numbers that are not finite. Points on one line are not told apart here; their rotation about it is arbitrary.
pub fn solve(sightings: &[Sighting]) -> Vec<Solution> {
    let Some(cost) = Cost::new(sightings) else { return Vec::new() };
    let mut minima: Vec<(Matrix3<f64>, f64)> = Vec::new();
    let mut keep = |rotation: Matrix3<f64>, value: f64| {
        let known = minima.iter().any(|(r, _)| (r - rotation).norm_squared() < 1e-8);
        if value.is_finite() && !known {
            minima.push((rotation, value));
        }
    };
    if cost.is_homogeneous {
        let eigen = cost.w.symmetric_eigen();
        let mut order: [usize; 9] = std::array::from_fn(|i| i);
        order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
        let mut best = f64::INFINITY;
        for (rank, &i) in order.iter().enumerate() {
            // A rotation has squared norm 3, so its cost inside the span of the remaining vectors is at least this.
            if rank > 0 && 3.0 * eigen.eigenvalues[i] > best {
                break;
            }
            for sign in [1.0, -1.0] {
                let start = nearest_rotation(&as_matrix(&(eigen.eigenvectors.column(i) * sign)));
                let (rotation, value) = cost.descend(start);
                best = best.min(value);
                keep(rotation, value);
            }
        }
    } else {
        let ridge = 1e-9 * cost.w.trace();
        if let Some(cholesky) = (cost.w + Matrix9::identity() * ridge).cholesky() {
            let (rotation, value) = cost.descend(nearest_rotation(&as_matrix(&cholesky.solve(&-cost.g))));
            keep(rotation, value);
        }
        for start in cube_rotations() {
            let (rotation, value) = cost.descend(start);
            keep(rotation, value);
        }
    }
    let mut solutions: Vec<Solution> =
        minima.into_iter().map(|(rotation, value)| cost.solution(&rotation, value, sightings)).collect();
    let behind = |s: &Solution| s.in_front < sightings.len();
    solutions.sort_by(|a, b| behind(a).cmp(&behind(b)).then(a.cost_m2.total_cmp(&b.cost_m2)));
    solutions
}

/// The quadratic in the row-major entries `r` of the rotation.
struct Cost {
    w: Matrix9,
    g: Vector9,
    k: f64,
    is_homogeneous: bool,
    /// The best translation is `translation_of_r * r + translation_free`, in the centred frames below.
    translation_of_r: SMatrix<f64, 3, 9>,
    translation_free: Vector3<f64>,
    /// Origins that keep the numbers small: the mean camera centre and the mean point.
    center_in_world: Vector3<f64>,
    center_in_object: Vector3<f64>,
}

impl Cost {
    fn new(sightings: &[Sighting]) -> Option<Self> {
        if sightings.len() < 4 {
            return None;
        }
        let n = sightings.len() as f64;
        let first = sightings[0].origin_in_world;
        let is_homogeneous = sightings.iter().all(|s| s.origin_in_world == first);
        let center_in_world = if is_homogeneous {
            first.coords
        } else {
            sightings.iter().map(|s| s.origin_in_world.coords).sum::<Vector3<f64>>() / n
        };
        let center_in_object = sightings.iter().map(|s| s.point_in_object.coords).sum::<Vector3<f64>>() / n;
        let mut mqm = Matrix9::zeros();
        let mut mq = Matrix9x3::zeros();
        let mut mqc = Vector9::zeros();
        let (mut q_sum, mut qc_sum, mut cqc) = (Matrix3::zeros(), Vector3::zeros(), 0.0);
        for s in sightings {
            let d = s.direction_in_world.try_normalize(0.0)?;
            // Projects onto the plane across the ray.
            let q = Matrix3::identity() - d * d.transpose();
            let x = s.point_in_object.coords - center_in_object;
            let c = s.origin_in_world.coords - center_in_world;
            let qc = q * c;
            let xx = x * x.transpose();
            // R x = M r with M = I (x) x', hence M' Q M = Q (x) x x', M' Q = Q (x) x, M' Q c = (Q c) (x) x.
            for i in 0..3 {
                for j in 0..3 {
                    let mut block = mqm.fixed_view_mut::<3, 3>(3 * i, 3 * j);
                    block += xx * q[(i, j)];
                    let mut column = mq.fixed_view_mut::<3, 1>(3 * i, j);
                    column += x * q[(i, j)];
                }
                let mut part = mqc.fixed_rows_mut::<3>(3 * i);
                part += x * qc[i];
            }
            q_sum += q;
            qc_sum += qc;
            cqc += c.dot(&qc);
        }
        let q_inverse = q_sum.cholesky()?.inverse();
        let translation_of_r = -q_inverse * mq.transpose();
        let translation_free = q_inverse * qc_sum;
        let w = mqm + mq * translation_of_r;
        let g = mq * translation_free - mqc;
        let k = cqc - qc_sum.dot(&translation_free);
        let finite = w.iter().chain(g.iter()).all(|v| v.is_finite()) && k.is_finite();
        finite.then_some(Self {
            w: (w + w.transpose()) * 0.5,
            g,
            k,
            is_homogeneous,
            translation_of_r,
            translation_free,
            center_in_world,
            center_in_object,
        })
    }

    fn value(&self, r: &Vector9) -> f64 {
        (self.w * r + self.g * 2.0).dot(r) + self.k
    }

    /// Newton's method on SO(3) with Levenberg's damping. For `R exp([a]x)` the gradient with respect to `a` is
    /// `2 J'(W r + g)`, and the Hessian `2 J' W J + sym(R'G) - tr(R'G) I` with `G` the gradient as a matrix, since the
    /// second-order term of the exponential is `[a]x^2 / 2 = (a a' - |a|^2 I) / 2`.
    fn descend(&self, mut rotation: Matrix3<f64>) -> (Matrix3<f64>, f64) {
        let mut r = as_vector(&rotation);
        let mut value = self.value(&r);
        let mut damping = 0.0;
        let scale = self.w.trace().max(f64::MIN_POSITIVE);
        for _ in 0..50 {
            let half_gradient = self.w * r + self.g;
            let jacobian = rotation_jacobian(&rotation);
            let slope = jacobian.transpose() * half_gradient * 2.0;
            if slope.norm() < 1e-13 * scale {
                break;
            }
            let m = rotation.transpose() * as_matrix(&half_gradient) * 2.0;
            let curvature = jacobian.transpose() * self.w * jacobian * 2.0 + (m + m.transpose()) * 0.5
                - Matrix3::identity() * m.trace();
            let Some(cholesky) = (curvature + Matrix3::identity() * damping).cholesky() else {
                damping = (damping * 4.0).max(1e-4 * scale);
                continue;
            };
            let step = cholesky.solve(&-slope);
            let next = rotation * UnitQuaternion::from_scaled_axis(step).to_rotation_matrix().into_inner();
            let next_r = as_vector(&next);
            let next_value = self.value(&next_r);
            if next_value <= value {
                (rotation, r, value) = (next, next_r, next_value);
                damping = if damping > 1e-6 * scale { damping * 0.1 } else { 0.0 };
                if step.norm() < 1e-10 {
                    break;
                }
            } else if step.norm() < 1e-8 {
                break;
            } else {
                damping = (damping * 4.0).max(1e-4 * scale);
            }
        }
        (rotation, value)
    }

    fn solution(&self, rotation: &Matrix3<f64>, value: f64, sightings: &[Sighting]) -> Solution {
        let t = self.translation_of_r * as_vector(rotation) + self.translation_free + self.center_in_world
            - rotation * self.center_in_object;
        let world_from_object = Rigid3::from_parts(UnitQuaternion::from_matrix(&nearest_rotation(rotation)), t);
        let in_front = sightings
            .iter()
            .filter(|s| (world_from_object * s.point_in_object - s.origin_in_world).dot(&s.direction_in_world) > 0.0)
            .count();
        Solution { world_from_object, cost_m2: value.max(0.0), in_front }
    }
}

/// Derivative of the row-major entries of `R exp([a]x)` with respect to `a` at 0: column k is `R [e_k]x`.
fn rotation_jacobian(rotation: &Matrix3<f64>) -> Matrix9x3 {
    let (c0, c1, c2) = (rotation.column(0), rotation.column(1), rotation.column(2));
    let mut jacobian = Matrix9x3::zeros();
    for row in 0..3 {
        // R [e_0]x = (0, c2, -c1), R [e_1]x = (-c2, 0, c0), R [e_2]x = (c1, -c0, 0), as columns.
        jacobian[(3 * row + 1, 0)] = c2[row];
        jacobian[(3 * row + 2, 0)] = -c1[row];
        jacobian[(3 * row, 1)] = -c2[row];
        jacobian[(3 * row + 2, 1)] = c0[row];
        jacobian[(3 * row, 2)] = c1[row];
        jacobian[(3 * row + 1, 2)] = -c0[row];
    }
    jacobian
}

fn as_vector(m: &Matrix3<f64>) -> Vector9 {
    Vector9::from_fn(|i, _| m[(i / 3, i % 3)])
}

fn as_matrix(v: &Vector9) -> Matrix3<f64> {
    Matrix3::from_fn(|row, col| v[3 * row + col])
}

/// The rotation nearest to a matrix in the Frobenius norm.
fn nearest_rotation(m: &Matrix3<f64>) -> Matrix3<f64> {
    let svd = m.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return Matrix3::identity() };
    let sign = if (u * v_t).determinant() < 0.0 { -1.0 } else { 1.0 };
    // nalgebra sorts singular values in descending order, so the last one is the cheapest to flip.
    u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t
}

/// The 24 rotations that map a cube onto itself.
fn cube_rotations() -> impl Iterator<Item = Matrix3<f64>> {
    let axes = [Vector3::x(), -Vector3::x(), Vector3::y(), -Vector3::y(), Vector3::z(), -Vector3::z()];
    axes.into_iter().flat_map(move |x| {
        axes.into_iter().filter(move |y| x.dot(y) == 0.0).map(move |y| Matrix3::from_columns(&[x, y, x.cross(&y)]))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_job::rng;
    use rand::RngExt;

    /// Points in a box of 20 cm, seen without noise from `cameras` places about 40 cm away.
    fn sightings(seed: u64, cameras: usize, count: usize) -> (Rigid3<World, Object>, Vec<Sighting>) {
        let mut rng = rng(seed, 0);
        let mut uniform = |low: f64, high: f64| rng.random_range(low..high);
        let axis = Vector3::new(uniform(-1.0, 1.0), uniform(-1.0, 1.0), uniform(-1.0, 1.0)).normalize();
        let rotation = UnitQuaternion::from_scaled_axis(axis * uniform(0.0, std::f64::consts::PI));
        let truth = Rigid3::from_parts(rotation, Vector3::new(uniform(-3.0, 3.0), uniform(-1.0, 1.0), 2.0));
        let centers: Vec<Point3<f64>> = (0..cameras)
            .map(|_| {
                let away = Vector3::new(uniform(-1.0, 1.0), uniform(-1.0, 1.0), uniform(-1.0, 1.0)).normalize();
                Point3::from(truth.translation() + away * 0.4)
            })
            .collect();
        let sightings = (0..count)
            .map(|i| {
                let x = Point3::new(uniform(-0.1, 0.1), uniform(-0.1, 0.1), uniform(-0.1, 0.1));
                let origin = centers[i % cameras];
                Sighting { origin_in_world: origin, direction_in_world: truth * x - origin, point_in_object: x }
            })
            .collect();
        (truth, sightings)
    }

    #[test]
    fn exact_rays_give_the_exact_pose_from_one_camera_and_from_many() {
        for (cameras, count) in [(1, 4), (1, 5), (1, 15), (2, 6), (4, 8), (8, 8)] {
            for seed in 0..100 {
                let (truth, sightings) = sightings(seed, cameras, count);
                let best = solve(&sightings)[0];
                let error = (best.world_from_object.inverse() * truth).log();
                assert!(error.norm() < 1e-6, "{cameras} cameras, {count} points, seed {seed}: {error:?}");
                assert_eq!(best.in_front, count);
            }
        }
    }

    #[test]
    fn the_rotation_jacobian_is_the_derivative() {
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, -1.0, 0.7)).to_rotation_matrix().into_inner();
        let jacobian = rotation_jacobian(&rotation);
        let h = 1e-6;
        for axis in 0..3 {
            let moved = |h: f64| {
                let mut a = Vector3::zeros();
                a[axis] = h;
                as_vector(&(rotation * UnitQuaternion::from_scaled_axis(a).to_rotation_matrix().into_inner()))
            };
            let numeric = (moved(h) - moved(-h)) / (2.0 * h);
            assert!((numeric - jacobian.column(axis)).amax() < 1e-9);
        }
    }

    #[test]
    fn degenerate_rays_have_no_solution() {
        let (_, mut many) = sightings(0, 1, 6);
        assert!(solve(&many[..3]).is_empty());
        many[3].point_in_object.x = f64::NAN;
        assert!(solve(&many).is_empty());
        for s in &mut many {
            *s = Sighting { direction_in_world: Vector3::z(), point_in_object: Point3::new(0.1, 0.0, 0.0), ..*s };
        }
        assert!(solve(&many).is_empty());
        assert_eq!(cube_rotations().count(), 24);
        assert!(cube_rotations().all(|r| (r.determinant() - 1.0).abs() < 1e-12));
    }
}
