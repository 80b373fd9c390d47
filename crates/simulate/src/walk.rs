//! Where the phone was, and where it says it was.

use mb_geometry::{Aabb, Camera, Intrinsics, Object, Rigid3, World};
use mb_job::{Result, rng};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use rand::RngExt;

use crate::drift::{PairwiseError, drift, pairwise_error};
use crate::orbit::Orbit;
use crate::{SimulateOptions, streams};

/// The way of a hand-held phone round an object, frame by frame.
#[derive(Debug, Clone)]
pub struct Walk {
    /// When each frame is taken, seconds after the first.
    pub times_s: Vec<f64>,
    /// Intrinsics of each photograph.
    pub intrinsics: Vec<Intrinsics>,
    /// Where the object stands in the phone's world.
    pub world_from_object: Rigid3<World, Object>,
    /// The true camera of each frame.
    pub true_world_from_cam: Vec<Rigid3<World, Camera>>,
    /// The camera of each frame as the phone reports it.
    pub reported_world_from_cam: Vec<Rigid3<World, Camera>>,
    pub(crate) orbit: Orbit,
    /// Of the reported cameras against the true ones.
    pub(crate) error: PairwiseError,
}

impl Walk {
    /// Walks round an object of these bounds (object frame, metres).
    ///
    /// # Errors
    /// An option is out of range.
    pub fn new(bounds_in_object: &Aabb, options: &SimulateOptions) -> Result<Self> {
        options.validate()?;
        let orbit = Orbit::new(options, bounds_in_object);
        let world_from_object = place_object(options.seed, orbit.radius_m);
        let times_s: Vec<f64> = (0..options.frames).map(|i| orbit.time_s(i)).collect();
        let truth: Vec<_> = times_s.iter().map(|t| world_from_object * orbit.object_from_cam(*t)).collect();
        let middle: Point3<f64> = world_from_object * bounds_in_object.center();
        let reported = drift(&truth, &times_s, &middle, &options.drift, options.seed);
        Ok(Self {
            intrinsics: times_s.iter().map(|t| orbit.intrinsics(*t)).collect(),
            error: pairwise_error(&truth, &reported),
            times_s,
            world_from_object,
            true_world_from_cam: truth,
            reported_world_from_cam: reported,
            orbit,
        })
    }
}

/// Where the object stands in the phone's world: some way off the place where the session began, turned, upright up
/// to the error of the phone's gravity.
fn place_object(seed: u64, radius_m: f64) -> Rigid3<World, Object> {
    let mut rng = rng(seed, streams::PLACE);
    let heading = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), rng.random_range(0.0..std::f64::consts::TAU));
    let mut tilt = || rng.random_range(-0.4..0.4f64).to_radians();
    let lean = UnitQuaternion::from_euler_angles(tilt(), 0.0, tilt());
    let towards = rng.random_range(0.0..std::f64::consts::TAU);
    let reach = radius_m * rng.random_range(0.8..1.2);
    let place = Vector3::new(reach * towards.cos(), -0.7 * radius_m, reach * towards.sin());
    Rigid3::from_parts(lean * heading, place)
}
