//! The hand that holds the phone: true camera poses and intrinsics.

use std::f64::consts::TAU;

use mb_geometry::{Aabb, Camera, ImageSize, Intrinsics, Object, Rigid3};
use mb_job::{Rng, rng};
use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};
use rand::RngExt;

use crate::SimulateOptions;
use crate::streams;

/// A smooth random function of time with unit standard deviation: sinusoids from slow to quick whose amplitudes fall
/// with frequency, as hand motion and autofocus do.
#[derive(Debug, Clone)]
struct Wobble {
    /// Amplitude, frequency (Hz), phase (rad).
    waves: [(f64, f64, f64); 8],
}

impl Wobble {
    fn new(rng: &mut Rng, slow_hz: f64, quick_hz: f64) -> Self {
        let mut waves = [(0.0, 0.0, 0.0); 8];
        let mut power = 0.0;
        for (i, wave) in waves.iter_mut().enumerate() {
            let octave = (i as f64 + rng.random::<f64>()) / 8.0;
            let hz = slow_hz * (quick_hz / slow_hz).powf(octave);
            *wave = (hz.powf(-0.75), hz, rng.random_range(0.0..TAU));
            power += 0.5 * wave.0 * wave.0;
        }
        for wave in &mut waves {
            wave.0 /= power.sqrt();
        }
        Self { waves }
    }

    fn at(&self, t_s: f64) -> f64 {
        self.waves.iter().map(|(a, hz, phase)| a * (TAU * hz * t_s + phase).sin()).sum()
    }
}

/// A hand-held orbit round an object: the pose of the camera and its intrinsics as functions of time.
#[derive(Debug, Clone)]
pub(crate) struct Orbit {
    size: ImageSize,
    elevations_rad: Vec<f64>,
    first_azimuth_rad: f64,
    center_in_object: Point3<f64>,
    /// Mean distance to the object's middle.
    pub radius_m: f64,
    /// Time for all circles.
    circles_s: f64,
    frames: usize,
    frames_per_s: Option<f64>,
    jitter: f64,
    distance: Wobble,
    height: Wobble,
    target: [Wobble; 3],
    roll: Wobble,
    focus: Wobble,
    principal: [Wobble; 2],
}

/// The smallest distance that a phone focuses at and people hold it at.
const NEAREST_M: f64 = 0.25;
/// Speed of the phone along its path; the published sequences move a little faster.
const SPEED_M_PER_S: f64 = 0.2;

impl Orbit {
    /// Plans the orbit round a model with the given bounds.
    pub fn new(options: &SimulateOptions, bounds_in_object: &Aabb) -> Self {
        let mut rng = rng(options.seed, streams::ORBIT);
        let mut wobble = |slow, quick| Wobble::new(&mut rng, slow, quick);
        let mut orbit = Self {
            size: options.size,
            elevations_rad: options.elevations_deg.iter().map(|e| e.to_radians()).collect(),
            first_azimuth_rad: 0.0,
            center_in_object: bounds_in_object.center(),
            radius_m: NEAREST_M,
            circles_s: 0.0,
            frames: options.frames,
            frames_per_s: options.frames_per_s,
            jitter: options.hand_jitter,
            distance: wobble(0.03, 0.5),
            height: wobble(0.03, 0.5),
            target: [wobble(0.05, 1.0), wobble(0.05, 1.0), wobble(0.05, 1.0)],
            roll: wobble(0.03, 0.7),
            focus: wobble(0.02, 0.2),
            principal: [wobble(0.1, 2.0), wobble(0.1, 2.0)],
        };
        orbit.first_azimuth_rad = rng.random_range(0.0..TAU);
        match options.radius_m {
            Some(radius_m) => orbit.set_radius(radius_m),
            None => {
                // Step back by 3 % until the whole model is in view in every frame.
                orbit.set_radius(NEAREST_M);
                while !orbit.sees_all(bounds_in_object) && orbit.radius_m < 100.0 {
                    orbit.set_radius(orbit.radius_m * 1.03);
                }
            }
        }
        orbit
    }

    fn set_radius(&mut self, radius_m: f64) {
        self.radius_m = radius_m;
        let turn_m: f64 = self.elevations_rad.iter().map(|e| TAU * radius_m * e.cos()).sum();
        self.circles_s = turn_m / SPEED_M_PER_S;
    }

    /// When frame `index` is taken, seconds after the first.
    pub fn time_s(&self, index: usize) -> f64 {
        match self.frames_per_s {
            Some(rate) => index as f64 / rate,
            None => self.circles_s * index as f64 / self.frames as f64,
        }
    }

    /// Distance from the camera to the object's middle.
    pub fn distance_m(&self, t_s: f64) -> f64 {
        self.radius_m * (1.0 + 0.04 * (self.jitter * self.distance.at(t_s)).clamp(-2.5, 2.5))
    }

    /// The true pose of the camera.
    pub fn object_from_cam(&self, t_s: f64) -> Rigid3<Object, Camera> {
        let circles = self.elevations_rad.len();
        let along = t_s / self.circles_s * circles as f64;
        // Who has walked all circles goes on along the last.
        let circle = (along.max(0.0) as usize).min(circles - 1);
        // The last fifth of each circle climbs to the next.
        let climb = ((along - circle as f64 - 0.8) / 0.2).clamp(0.0, 1.0);
        let climb = climb * climb * (3.0 - 2.0 * climb);
        let next = self.elevations_rad[(circle + 1).min(circles - 1)];
        let elevation = self.elevations_rad[circle] * (1.0 - climb) + next * climb;
        let elevation = (elevation + 0.03 * self.jitter * self.height.at(t_s)).min(1.52);
        let azimuth = self.first_azimuth_rad + TAU * along;
        let distance = self.distance_m(t_s);
        let outward = Vector3::new(elevation.cos() * azimuth.cos(), elevation.sin(), elevation.cos() * azimuth.sin());
        let center = self.center_in_object + outward * distance;

        let sway = Vector3::from_fn(|i, _| self.target[i].at(t_s)) * (0.02 * self.jitter * self.radius_m);
        let forward = (self.center_in_object + sway - center).normalize();
        let right = forward.cross(&Vector3::y()).normalize();
        let down = forward.cross(&right);
        // A phone held upright: its sensor lies on its side, x points down and y to the left. Portrait images are
        // taken as they are displayed.
        let axes = if self.size.width >= self.size.height {
            Matrix3::from_columns(&[down, -right, forward])
        } else {
            Matrix3::from_columns(&[right, down, forward])
        };
        let roll =
            Rotation3::from_axis_angle(&Vector3::z_axis(), 2.5f64.to_radians() * self.jitter * self.roll.at(t_s));
        let rotation = Rotation3::from_matrix_unchecked(axes) * roll;
        Rigid3::from_parts(UnitQuaternion::from_rotation_matrix(&rotation), center.coords)
    }

    /// The intrinsics: a phone's at 1920x1440, scaled; the focal length breathes with autofocus and the principal
    /// point moves with the lens stabiliser.
    pub fn intrinsics(&self, t_s: f64) -> Intrinsics {
        let (width, height) = (self.size.width as f64, self.size.height as f64);
        let scale = width.max(height) / 1920.0;
        let focal = (1460.0 + 2.0 * self.focus.at(t_s)) * scale;
        let cx = (width - 1.0) / 2.0 + (2.6 + 0.05 * self.principal[0].at(t_s)) * scale;
        let cy = (height - 1.0) / 2.0 + (5.1 + 0.05 * self.principal[1].at(t_s)) * scale;
        Intrinsics { fx: focal, fy: focal, cx, cy }
    }

    /// Whether every frame shows the whole box, with a margin of 3 % of the image.
    pub fn sees_all(&self, bounds_in_object: &Aabb) -> bool {
        let margin = 0.03 * self.size.width.max(self.size.height) as f64;
        let inside = |v: f64, extent: usize| v >= margin && v <= extent as f64 - margin;
        (0..self.frames).all(|i| {
            let t_s = self.time_s(i);
            let cam_from_object = self.object_from_cam(t_s).inverse();
            let intrinsics = self.intrinsics(t_s);
            bounds_in_object.corners().iter().all(|corner| {
                intrinsics
                    .img_from_cam(&(cam_from_object * *corner))
                    .is_some_and(|p| inside(p.x, self.size.width) && inside(p.y, self.size.height))
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> Aabb {
        Aabb { min: Point3::new(-0.08, 0.0, -0.06), max: Point3::new(0.08, 0.1, 0.06) }
    }

    #[test]
    fn the_whole_model_is_in_view_at_the_papers_distances() {
        for seed in 0..10 {
            let options = SimulateOptions { seed, ..SimulateOptions::default() };
            let orbit = Orbit::new(&options, &model());
            assert!(orbit.sees_all(&model()));
            for i in 0..options.frames {
                let camera = orbit.object_from_cam(orbit.time_s(i));
                let distance = (Point3::from(camera.translation()) - model().center()).norm();
                assert!((0.2..0.55).contains(&distance), "{distance} m");
            }
        }
    }

    #[test]
    fn the_scene_lies_on_its_side_with_up_to_the_left() {
        let orbit = Orbit::new(&SimulateOptions::default(), &model());
        for i in 0..60 {
            let up = orbit.object_from_cam(orbit.time_s(i)).inverse().rotate(&Vector3::y());
            assert!(up.x < -0.4 && up.y.abs() < 0.2, "up is {up:?} in the camera");
        }
    }

    #[test]
    fn intrinsics_are_a_phones_and_scale_with_the_size() {
        let full = Orbit::new(&SimulateOptions::default(), &model());
        let size = ImageSize::new(960, 720);
        let half = Orbit::new(&SimulateOptions { size, ..SimulateOptions::default() }, &model());
        for t_s in [0.0, 3.0, 17.0] {
            let (k, k_half) = (full.intrinsics(t_s), half.intrinsics(t_s));
            assert!((k.fx - 1460.0).abs() < 10.0 && (k.cx - 962.1).abs() < 1.0 && (k.cy - 724.6).abs() < 1.0);
            let scaled = k.resized(SimulateOptions::default().size, size);
            assert!((scaled.fx - k_half.fx).abs() < 1e-9 && (scaled.cx - k_half.cx).abs() < 1e-9);
        }
        assert_ne!(full.intrinsics(0.0), full.intrinsics(0.3));
    }
}
