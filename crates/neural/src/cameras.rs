//! Corrections of the cameras, learned with the scene: a rigid motion and a focal length for each photograph.
//!
//! A camera with rotation R and centre c (scene frame) sees pixel (x, y) along `w = exp([omega]) R v`,
//! `v = ((x - cx) / (f e^phi), (y - cy) / (f e^phi), 1)`, `d = w / |w|`, from `o = exp([omega]) c + tau`. A loss with
//! derivatives `g_o` and `g_d` on a ray has
//!
//! `dtau = g_o`, `domega = J(omega)^T ((o - tau) x g_o + d x g_d)`,
//! `dphi = -(R^T exp(-[omega]) g_w) . (v_x, v_y, 0)`, `g_w = (g_d - d (d . g_d)) / |w|`,
//!
//! with J the left Jacobian of the rotation group. The camera turns about the middle of the region of interest, not about
//! itself: there a turn and a shift look almost alike, and an optimiser that scales each number by itself finds neither.
//! Nothing fixes the frame as a whole, so the means of omega, tau and phi over the trained photographs are taken away after
//! each step. A photograph that is held out gets the mean of the corrections of its trained neighbours in time: a phone
//! drifts slowly.

use mb_geometry::{Camera, Rigid3, World};
use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::adam::{AdamOptions, Parameters};
use crate::dataset::{RayDataset, SceneRay, TargetRay, View};

/// How cameras are corrected in training; off by default. The learning rates follow the method's schedule.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraOptions {
    /// Correct rotation and centre of each camera.
    pub refine_poses: bool,
    /// Correct the focal length of each camera.
    pub refine_focal: bool,
    /// Radians a step (BARF has 1e-3 at its start, NeRF-- 1e-3).
    pub rotation_learning_rate: f32,
    /// Radii of the region a step.
    pub center_learning_rate: f32,
    /// Natural logarithm of the focal length, a step.
    pub focal_learning_rate: f32,
    /// Steps before the cameras may move: a scene has to be there first.
    pub start: u64,
}

impl Default for CameraOptions {
    fn default() -> Self {
        Self {
            refine_poses: false,
            refine_focal: false,
            rotation_learning_rate: 3e-4,
            center_learning_rate: 3e-4,
            focal_learning_rate: 1e-4,
            start: 200,
        }
    }
}

/// What a loss asks of a ray.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RayGradient {
    /// With respect to the origin.
    pub origin: [f32; 3],
    /// With respect to the unit direction.
    pub direction: [f32; 3],
}

impl RayGradient {
    /// Adds the derivative `g` with respect to the point at distance `t`.
    #[inline]
    pub fn add_point(&mut self, t: f32, g: [f32; 3]) {
        for d in 0..3 {
            self.origin[d] += g[d];
            self.direction[d] += t * g[d];
        }
    }
}

/// The corrections, all zero at the start.
#[derive(Debug, Clone, Default)]
pub struct CameraResiduals {
    options: CameraOptions,
    active: bool,
    /// omega, three numbers a view.
    rotations: Parameters,
    /// tau, three numbers a view.
    centers: Parameters,
    /// phi.
    focals: Parameters,
}

impl CameraResiduals {
    /// For all views of a data set.
    pub fn new(options: &CameraOptions, data: &RayDataset) -> Self {
        let n = data.views().len();
        let active = options.refine_poses || options.refine_focal;
        let zeros = |n: usize| Parameters::new(vec![0.0; if active { n } else { 0 }]);
        Self { options: *options, active, rotations: zeros(3 * n), centers: zeros(3 * n), focals: zeros(n) }
    }

    /// Whether rays need derivatives in `step`.
    pub fn wants_gradients(&self, step: u64) -> bool {
        self.active && step >= self.options.start
    }

    fn three(from: &[f32], view: usize) -> [f32; 3] {
        [from[3 * view], from[3 * view + 1], from[3 * view + 2]]
    }

    /// The point on the plane at depth 1 in the camera frame, and the (long) direction in the scene frame.
    fn directions(&self, view: &View, index: usize, pixel: [f32; 2]) -> ([f32; 3], [f32; 3]) {
        let shrink = (-self.focals.values[index]).exp();
        let v = view.through(pixel);
        let v = [v[0] * shrink, v[1] * shrink, 1.0];
        (v, rotate(Self::three(&self.rotations.values, index), view.rotated(v)))
    }

    /// `exp([omega]) c`.
    fn turned_center(&self, view: &View, index: usize) -> [f32; 3] {
        rotate(Self::three(&self.rotations.values, index), view.center())
    }

    /// The ray through a pixel of a view.
    #[inline]
    pub fn ray(&self, view: &View, index: usize, pixel: [f32; 2]) -> SceneRay {
        if !self.active {
            return view.ray(pixel[0], pixel[1]);
        }
        let (_, w) = self.directions(view, index, pixel);
        let length = dot(w, w).sqrt();
        let (center, tau) = (self.turned_center(view, index), Self::three(&self.centers.values, index));
        SceneRay { origin: std::array::from_fn(|d| center[d] + tau[d]), direction: w.map(|c| c / length) }
    }

    /// Adds what the rays' losses ask of the cameras, in the order given.
    pub fn add<'a>(&mut self, data: &RayDataset, rays: impl Iterator<Item = (&'a TargetRay, &'a RayGradient)>) {
        for (target, g) in rays {
            let index = target.view as usize;
            let view = &data.views()[index];
            let (v, w) = self.directions(view, index, target.pixel);
            let d = target.ray.direction;
            let omega = Self::three(&self.rotations.values, index);
            let (by_center, by_direction) = (cross(self.turned_center(view, index), g.origin), cross(d, g.direction));
            let turn = left_jacobian_transposed(omega, std::array::from_fn(|i| by_center[i] + by_direction[i]));
            let along = dot(d, g.direction);
            let length = dot(w, w).sqrt();
            let g_w: [f32; 3] = std::array::from_fn(|i| (g.direction[i] - d[i] * along) / length);
            let back = view.rotated_back(rotate(omega.map(|c| -c), g_w));
            for i in 0..3 {
                self.rotations.grads[3 * index + i] += turn[i];
                self.centers.grads[3 * index + i] += g.origin[i];
            }
            self.focals.grads[index] -= back[0] * v[0] + back[1] * v[1];
        }
    }

    /// One Adam step, number `step` of the run from 0, with the schedule's factor.
    pub fn step(&mut self, data: &RayDataset, factor: f32, step: u64) {
        if !self.wants_gradients(step) {
            return;
        }
        let o = self.options;
        let t = step - o.start + 1;
        let adam = AdamOptions { beta2: 0.99, ..AdamOptions::default() };
        if o.refine_poses {
            self.rotations.step(&adam, o.rotation_learning_rate * factor, t);
            self.centers.step(&adam, o.center_learning_rate * factor, t);
        }
        if o.refine_focal {
            self.focals.step(&adam, o.focal_learning_rate * factor, t);
        }
        for grads in [&mut self.rotations.grads, &mut self.centers.grads, &mut self.focals.grads] {
            grads.fill(0.0);
        }
        remove_mean(&mut self.rotations.values, 3, data.training());
        remove_mean(&mut self.centers.values, 3, data.training());
        remove_mean(&mut self.focals.values, 1, data.training());
        for values in [(&mut self.rotations.values, 3), (&mut self.centers.values, 3), (&mut self.focals.values, 1)] {
            fill_held_out(values.0, values.1, data);
        }
    }

    /// Root mean square of the corrections of the trained views: degrees, radii of the region, and of the natural
    /// logarithm of the focal length. `None` where cameras are not corrected.
    pub fn size(&self) -> Option<[f64; 3]> {
        let views = (self.focals.values.len()).max(1) as f64;
        let rms = |v: &[f32]| (v.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / views).sqrt();
        self.active
            .then(|| [rms(&self.rotations.values).to_degrees(), rms(&self.centers.values), rms(&self.focals.values)])
    }

    /// Checks what a checkpoint has filled the buffers with.
    ///
    /// # Errors
    /// The buffers do not fit the data.
    pub fn restored(&self, data: &RayDataset) -> Result<(), String> {
        let n = if self.active { data.views().len() } else { 0 };
        let fits = |p: &Parameters, n: usize| p.values.len() == n && p.m.len() == n && p.v.len() == n;
        if fits(&self.rotations, 3 * n) && fits(&self.centers, 3 * n) && fits(&self.focals, n) {
            Ok(())
        } else {
            Err("the checkpoint belongs to other cameras".to_owned())
        }
    }

    /// The corrected pose of a view, in the sequence's world frame.
    pub fn world_from_cam(&self, data: &RayDataset, index: usize) -> Rigid3<World, Camera> {
        let pose = data.views()[index].world_from_cam;
        if !self.active {
            return pose;
        }
        let three = |p: &Parameters| Vector3::from(Self::three(&p.values, index)).map(f64::from);
        let turn = UnitQuaternion::from_scaled_axis(three(&self.rotations));
        let region = data.region();
        let center = turn * region.scene_from_world(&pose.translation().into()).coords + three(&self.centers);
        Rigid3::from_parts(turn * pose.rotation(), region.world_from_scene(&center.into()).coords)
    }

    /// All buffers that a checkpoint holds.
    pub fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
        [&mut self.rotations, &mut self.centers, &mut self.focals]
            .into_iter()
            .flat_map(|p| [&mut p.values, &mut p.m, &mut p.v])
            .collect()
    }
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// `sin(a) / a`, `(1 - cos(a)) / a^2` and `(a - sin(a)) / a^3`.
fn rodrigues(omega: [f32; 3]) -> (f32, f32, f32) {
    let a2 = dot(omega, omega);
    if a2 < 1e-4 {
        return (1.0 - a2 / 6.0, 0.5 - a2 / 24.0, 1.0 / 6.0 - a2 / 120.0);
    }
    let a = a2.sqrt();
    (a.sin() / a, (1.0 - a.cos()) / a2, (a - a.sin()) / (a2 * a))
}

/// `exp([omega]) v`.
fn rotate(omega: [f32; 3], v: [f32; 3]) -> [f32; 3] {
    let (s, c, _) = rodrigues(omega);
    let once = cross(omega, v);
    let twice = cross(omega, once);
    std::array::from_fn(|d| v[d] + s * once[d] + c * twice[d])
}

/// `J(omega)^T v`, with `J = I + c [omega] + e [omega]^2`.
fn left_jacobian_transposed(omega: [f32; 3], v: [f32; 3]) -> [f32; 3] {
    let (_, c, e) = rodrigues(omega);
    let once = cross(omega, v);
    let twice = cross(omega, once);
    std::array::from_fn(|d| v[d] - c * once[d] + e * twice[d])
}

fn remove_mean(values: &mut [f32], width: usize, training: &[usize]) {
    for d in 0..width {
        let mean = training.iter().map(|i| values[i * width + d]).sum::<f32>() / training.len().max(1) as f32;
        training.iter().for_each(|i| values[i * width + d] -= mean);
    }
}

/// Held-out views get the mean of the nearest trained views before and after them.
fn fill_held_out(values: &mut [f32], width: usize, data: &RayDataset) {
    let training = data.training();
    for (index, view) in data.views().iter().enumerate() {
        if !view.held_out {
            continue;
        }
        let after = training.partition_point(|i| *i < index);
        let neighbours: Vec<usize> = [after.checked_sub(1), Some(after)]
            .into_iter()
            .flatten()
            .filter_map(|i| training.get(i).copied())
            .collect();
        for d in 0..width {
            values[index * width + d] =
                neighbours.iter().map(|i| values[i * width + d]).sum::<f32>() / neighbours.len() as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_geometry::{ImageSize, Intrinsics};
    use mb_image::Image;

    fn data() -> RayDataset {
        let images = (0..9)
            .map(|i| {
                let (sin, cos) = (f64::from(i) * 0.4).sin_cos();
                let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), -f64::from(i) * 0.4);
                let pose = Rigid3::from_parts(turn, Vector3::new(2.0 * sin, 0.1, -2.0 * cos));
                let rgb = Image::from_fn(ImageSize::new(40, 30), |_, _| [128; 3]);
                (rgb, None, Intrinsics { fx: 50.0, fy: 52.0, cx: 19.0, cy: 14.5 }, pose)
            })
            .collect();
        RayDataset::from_images(images, 8).expect("nine good views")
    }

    const OPTIONS: CameraOptions = CameraOptions {
        refine_poses: true,
        refine_focal: true,
        rotation_learning_rate: 1e-3,
        center_learning_rate: 1e-3,
        focal_learning_rate: 1e-3,
        start: 0,
    };

    #[test]
    fn derivatives_agree_with_finite_differences() {
        let data = data();
        let mut cameras = CameraResiduals::new(&OPTIONS, &data);
        for (i, v) in cameras.rotations.values.iter_mut().enumerate() {
            *v = 0.3 * (i as f32).sin();
        }
        for (i, v) in cameras.centers.values.iter_mut().enumerate() {
            *v = 0.1 * (i as f32).cos();
        }
        for (i, v) in cameras.focals.values.iter_mut().enumerate() {
            *v = 0.05 * (i as f32).sin();
        }
        let (index, pixel) = (3, [31.0, 4.0]);
        let g = RayGradient { origin: [0.3, -0.8, 0.5], direction: [-0.6, 0.2, 0.9] };
        let loss = |cameras: &CameraResiduals| {
            let ray = cameras.ray(&data.views()[index], index, pixel);
            (0..3).map(|d| f64::from(ray.origin[d] * g.origin[d] + ray.direction[d] * g.direction[d])).sum::<f64>()
        };
        let ray = cameras.ray(&data.views()[index], index, pixel);
        let target = TargetRay { ray, view: index as u32, pixel, rgb: [0.0; 3], mask: None };
        let mut with = cameras.clone();
        with.add(&data, std::iter::once((&target, &g)));
        let pick: [fn(&mut CameraResiduals) -> &mut Parameters; 3] =
            [|c| &mut c.rotations, |c| &mut c.centers, |c| &mut c.focals];
        for (b, pick) in pick.into_iter().enumerate() {
            for i in 0..pick(&mut with).values.len() {
                let at = |h: f32| {
                    let mut c = cameras.clone();
                    pick(&mut c).values[i] += h;
                    loss(&c)
                };
                let (found, expected) = (pick(&mut with).grads[i], (at(2e-3) - at(-2e-3)) / 4e-3);
                assert!((f64::from(found) - expected).abs() < 1e-3, "{b} {i}: {found} is not {expected}");
            }
        }
    }

    #[test]
    fn corrections_move_rays_as_the_corrected_pose_says_and_held_out_views_follow_their_neighbours() {
        let data = data();
        let mut cameras = CameraResiduals::new(&OPTIONS, &data);
        let rays: Vec<TargetRay> = (1..8)
            .map(|view| TargetRay {
                ray: cameras.ray(&data.views()[view], view, [5.0, 6.0]),
                view: view as u32,
                pixel: [5.0, 6.0],
                rgb: [0.0; 3],
                mask: None,
            })
            .collect();
        let gradients: Vec<RayGradient> = (0..7)
            .map(|i| RayGradient { origin: [f32::from(i % 2 == 0) - 0.5, 0.0, 0.1], direction: [0.0, 1.0, 0.2] })
            .collect();
        cameras.add(&data, rays.iter().zip(&gradients));
        cameras.step(&data, 1.0, 0);
        let [degrees, centers, _] = cameras.size().expect("cameras are corrected");
        assert!(degrees > 1e-3 && centers > 1e-4);
        // View 8 is held out, and 7 is its only neighbour; view 0 follows view 1.
        for (held_out, neighbour) in [(8, 7), (0, 1)] {
            assert_eq!(
                CameraResiduals::three(&cameras.centers.values, held_out),
                CameraResiduals::three(&cameras.centers.values, neighbour)
            );
        }
        cameras.focals.values.fill(0.0);
        cameras.rotations.values.iter_mut().enumerate().for_each(|(i, v)| *v = 0.2 * (i as f32).cos());
        for index in [2, 5] {
            let pose = cameras.world_from_cam(&data, index);
            let view = &data.views()[index];
            let ray = cameras.ray(view, index, [30.0, 20.0]);
            let expected = view.intrinsics.ray(&nalgebra::Point2::new(30.0, 20.0), &pose);
            let direction = expected.direction.normalize();
            let origin = data.region().scene_from_world(&expected.origin);
            for d in 0..3 {
                assert!((f64::from(ray.direction[d]) - direction[d]).abs() < 1e-5);
                assert!((f64::from(ray.origin[d]) - origin[d]).abs() < 1e-5);
            }
        }
    }
}
