//! The region of interest: a ball around the object, which becomes the unit ball of the scene frame.

use mb_capture::ObjectSphere;
use mb_geometry::{Aabb, World};
use nalgebra::{Matrix3, Point2, Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::dataset::View;

/// What the region was found from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RegionSource {
    /// The object's masks.
    Masks,
    /// The sphere of `cameras.npz`, which whoever posed the object drew around it, as NeuS takes it.
    Sphere,
    /// Where the cameras look, and how much they see.
    Cameras,
}

/// A ball in the world frame. The scene frame has its origin at the centre, the world's axes, and the radius as unit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Region {
    /// Centre, world frame, metres.
    pub center: Point3<f64>,
    /// Radius, metres.
    pub radius_m: f64,
    /// What it was found from.
    pub source: RegionSource,
}

impl Region {
    /// Finds the region. The centre is the point nearest to all rays through the masks' centroids, or, without masks,
    /// to all optical axes. With masks the radius reaches the farthest mask border at the centre's depth in nine of ten
    /// views, plus 10 %; without, it is what the median camera sees at that depth to its nearer image border.
    ///
    /// # Errors
    /// The rays do not meet in front of the cameras.
    pub fn find(views: &[View]) -> Result<Self, String> {
        let masked = views.iter().all(|v| v.mask.is_some());
        let mut rays = Vec::with_capacity(views.len());
        for view in views {
            let through = match mask_box(view).filter(|_| masked) {
                Some(bounds) => Point2::new(bounds.center().x, bounds.center().y),
                None if masked => continue,
                None => {
                    let size = view.size();
                    Point2::new((size.width as f64 - 1.0) * 0.5, (size.height as f64 - 1.0) * 0.5)
                }
            };
            rays.push(view.intrinsics.ray::<World>(&through, &view.world_from_cam));
        }
        if rays.len() < 2 {
            return Err("fewer than 2 masks show the object".to_owned());
        }
        // Sum of (I - d d^T)(x - o) = 0.
        let (mut a, mut b) = (Matrix3::zeros(), Vector3::zeros());
        for ray in &rays {
            let d = ray.direction.normalize();
            let across = Matrix3::identity() - d * d.transpose();
            a += across;
            b += across * ray.origin.coords;
        }
        let smallest = a.symmetric_eigenvalues().min() / rays.len() as f64;
        let center = a.cholesky().filter(|_| smallest > 1e-4).map(|c| Point3::from(c.solve(&b)));
        let center = center.ok_or("the cameras all look the same way, so nothing fixes the depth of the object")?;
        let in_front = rays.iter().filter(|r| (center - r.origin).dot(&r.direction) > 0.0).count();
        if 2 * in_front < rays.len() {
            return Err(format!("the viewing rays meet behind {} of {} cameras", rays.len() - in_front, rays.len()));
        }
        let shown = views.iter().filter(|view| shows(view, &center)).count();
        if 2 * shown < views.len() {
            return Err(format!(
                "the photographs show no common place: the point nearest to all viewing rays is in {shown} of {} pictures",
                views.len()
            ));
        }
        let mut radii: Vec<f64> = Vec::with_capacity(views.len());
        for view in views {
            let c = view.world_from_cam.inverse() * center;
            if c.z <= 0.0 {
                continue;
            }
            let k = &view.intrinsics;
            if masked {
                let Some(bounds) = mask_box(view) else { continue };
                let middle = k.img_from_cam(&c).unwrap_or_default();
                let reach = [bounds.min, bounds.max].map(|p| {
                    let d = p - Point3::new(middle.x, middle.y, 0.0);
                    ((d.x / k.fx).powi(2) + (d.y / k.fy).powi(2)).sqrt() * c.z
                });
                radii.push(reach[0].max(reach[1]));
            } else {
                let size = view.size();
                radii.push(c.z * (0.5 * size.width as f64 / k.fx).min(0.5 * size.height as f64 / k.fy));
            }
        }
        radii.sort_by(f64::total_cmp);
        let radius_m = match masked {
            true => 1.1 * radii[(radii.len() * 9 / 10).min(radii.len() - 1)],
            false => {
                let nearest = rays.iter().map(|r| (r.origin - center).norm()).fold(f64::INFINITY, f64::min);
                radii[radii.len() / 2].min(0.8 * nearest)
            }
        };
        if !(radius_m.is_finite() && radius_m > 0.0) {
            return Err("the cameras stand in the middle of what they look at".to_owned());
        }
        let source = if masked { RegionSource::Masks } else { RegionSource::Cameras };
        Ok(Self { center, radius_m, source })
    }

    /// The sphere around the object that a sequence names; `None` where most photographs do not show its centre.
    pub fn from_sphere(sphere: &ObjectSphere, views: &[View]) -> Option<Self> {
        let shown = views.iter().filter(|view| shows(view, &sphere.center)).count();
        let (center, radius_m) = (sphere.center, sphere.radius_m);
        (2 * shown >= views.len()).then_some(Self { center, radius_m, source: RegionSource::Sphere })
    }

    /// A world point in the scene frame.
    pub fn scene_from_world(&self, p_in_world: &Point3<f64>) -> Point3<f64> {
        Point3::from((p_in_world - self.center) / self.radius_m)
    }

    /// A scene point in the world frame, metres.
    pub fn world_from_scene(&self, p_in_scene: &Point3<f64>) -> Point3<f64> {
        self.center + p_in_scene.coords * self.radius_m
    }
}

/// Whether a point of the world lies in a view's picture.
fn shows(view: &View, p_in_world: &Point3<f64>) -> bool {
    let size = view.size();
    view.intrinsics
        .img_from_cam(&(view.world_from_cam.inverse() * *p_in_world))
        .is_some_and(|p| p.x >= -0.5 && p.y >= -0.5 && p.x < size.width as f64 - 0.5 && p.y < size.height as f64 - 0.5)
}

/// The box around a view's mask, in pixels (z = 0); `None` where the mask is empty.
fn mask_box(view: &View) -> Option<Aabb> {
    let mask = view.mask.as_ref()?;
    let mut bounds = Aabb::empty();
    for (i, m) in mask.data().iter().enumerate() {
        if *m >= 128 {
            bounds.add(&Point3::new((i % mask.width()) as f64, (i / mask.width()) as f64, 0.0));
        }
    }
    (!bounds.is_empty()).then_some(bounds)
}
