//! From a trained model to a mesh in the world frame.

use mb_job::{Error, Progress, Result, Steps};
use mb_mesh::TriangleMesh;
use mb_recon::{SupportPlane, level_set_mesh};
use mb_render::{Scene, View as RenderView};
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::cameras::CameraResiduals;
use crate::dataset::RayDataset;
use crate::model::Model;

/// How a surface is extracted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SurfaceOptions {
    /// Spacing of the marching-cubes grid, millimetres of the sequence's world.
    pub voxel_mm: f64,
    /// Keep only what at least one camera sees.
    pub cull: bool,
    /// Of a model that learned without masks, keep also the table or floor that the object stands on.
    pub keep_table: bool,
}

impl Default for SurfaceOptions {
    fn default() -> Self {
        Self { voxel_mm: 1.0, cull: true, keep_table: false }
    }
}

/// A surface, and what was taken away from it.
#[derive(Debug, Clone, PartialEq)]
pub struct Extracted {
    /// World frame, metres, with vertex colours.
    pub mesh: TriangleMesh,
    /// The table or floor that was cut off.
    pub table: Option<Table>,
}

/// A table or floor that was cut off a surface.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Table {
    /// Where it was found.
    pub plane: SupportPlane,
    /// Height above it up to which everything went, millimetres.
    pub cut_mm: f64,
}

/// Points of a side of the blocks that are evaluated or skipped as one.
const BLOCK: usize = 16;
/// Largest grid: 1 GiB of numbers.
const MAX_POINTS: usize = 1 << 28;
/// A table is cut off up to so many times its roughness, since the surface swells in the shadow around an object's foot; at
/// least to two voxels.
const CLEARANCE: f64 = 4.0;

/// The model's surface inside the region of interest: world frame, metres, vertex colours. Blocks without a cell that
/// may hold the surface are not evaluated. With `cull`, triangles stay whose vertices a camera sees: in its image and
/// no more than two voxels behind the surface's own depth map. Of a model that learned without masks the plane that the
/// object stands on is cut off, where there is one.
///
/// # Errors
/// The grid would be too large; nothing was found; the person asked for a stop.
pub fn extract(
    model: &dyn Model,
    data: &RayDataset,
    cameras: &CameraResiduals,
    options: &SurfaceOptions,
    progress: &dyn Progress,
) -> Result<Extracted> {
    let region = data.region();
    let spacing = options.voxel_mm * 1e-3 / region.radius_m;
    let points = (2.0 / spacing).ceil() + 1.0;
    if !(points > 2.0 && points.powi(3) <= MAX_POINTS as f64) {
        return Err(Error::Failed(format!(
            "voxels of {} mm in a region of {:.0} mm make a grid of {points:.0}^3 points; at most {MAX_POINTS} are \
             allowed: choose larger voxels",
            options.voxel_mm,
            2e3 * region.radius_m,
        )));
    }
    let n = points as usize;
    let values = evaluate(model, n, spacing as f32, progress)?;
    let mut mesh = level_set_mesh([n; 3], &values);
    drop(values);
    if mesh.triangles.is_empty() {
        return Err(Error::Failed(format!(
            "{} found no surface in the region of interest; train longer, or check the poses",
            model.name()
        )));
    }
    let scene: Vec<Point3<f64>> =
        mesh.vertices.iter().map(|v| Point3::from(v.coords * spacing - Vector3::repeat(1.0))).collect();
    mesh.vertices = scene.iter().map(|p| region.world_from_scene(p)).collect();
    if options.cull {
        mesh = cull(mesh, data, cameras, options.voxel_mm * 1e-3, progress)?;
        if mesh.triangles.is_empty() {
            return Err(Error::Failed("no camera sees the surface that was found; check the poses".to_owned()));
        }
    }
    let table = match options.keep_table || model.only_object() {
        true => None,
        false => cut_table(&mut mesh, data, cameras, options.voxel_mm),
    };
    color(&mut mesh, model, data);
    Ok(Extracted { mesh, table })
}

/// Cuts off the plane that the object stands on, unless nothing would be left.
fn cut_table(mesh: &mut TriangleMesh, data: &RayDataset, cameras: &CameraResiduals, voxel_mm: f64) -> Option<Table> {
    let centers: Vec<Point3<f64>> =
        data.training().iter().map(|i| cameras.world_from_cam(data, *i).translation().into()).collect();
    let plane = SupportPlane::find(mesh, &centers)?;
    let cut_mm = (CLEARANCE * 1e3 * plane.roughness_m).max(2.0 * voxel_mm);
    let mut rest = mesh.clone();
    plane.cut(&mut rest, cut_mm * 1e-3);
    if rest.triangles.is_empty() {
        return None;
    }
    *mesh = without_unused_vertices(&rest);
    Some(Table { plane, cut_mm })
}

/// The level-set function on the grid: negative inside, NaN outside the region.
fn evaluate(model: &dyn Model, n: usize, spacing: f32, progress: &dyn Progress) -> Result<Vec<f32>> {
    let level = model.level();
    let signed = |v: f32| if level.larger_inside { level.value - v } else { v - level.value };
    let position = |x: usize, y: usize, z: usize| [x, y, z].map(|i| i as f32 * spacing - 1.0);
    let mut values = vec![f32::NAN; n * n * n];
    let steps = Steps::new(progress, "evaluating the surface", n.div_ceil(BLOCK));
    values.par_chunks_mut(n * n * BLOCK).enumerate().try_for_each(|(slab, values)| {
        let z0 = slab * BLOCK;
        let depth = values.len() / (n * n);
        for y0 in (0..n).step_by(BLOCK) {
            for x0 in (0..n).step_by(BLOCK) {
                let (width, height) = (BLOCK.min(n - x0), BLOCK.min(n - y0));
                let mut slots = Vec::with_capacity(BLOCK.pow(3));
                let mut inside = Vec::with_capacity(BLOCK.pow(3));
                for z in 0..depth {
                    for y in y0..y0 + height {
                        for x in x0..x0 + width {
                            let p = position(x, y, z0 + z);
                            if p.iter().map(|c| c * c).sum::<f32>() <= 1.0 {
                                slots.push((z * n + y) * n + x);
                                inside.push(p);
                            }
                        }
                    }
                }
                if inside.is_empty() {
                    continue;
                }
                let (low, high) = (position(x0, y0, z0), position(x0 + width, y0 + height, z0 + depth));
                if model.may_cross(low, high) {
                    for (slot, v) in slots.into_iter().zip(model.surface(&inside)) {
                        values[slot] = signed(v);
                    }
                } else {
                    let v = signed(model.surface(&inside[inside.len() / 2..=inside.len() / 2])[0]);
                    slots.into_iter().for_each(|slot| values[slot] = v);
                }
            }
        }
        steps.step()
    })?;
    Ok(values)
}

/// Keeps triangles with a vertex that some training camera sees.
fn cull(
    mesh: TriangleMesh,
    data: &RayDataset,
    cameras: &CameraResiduals,
    voxel_m: f64,
    progress: &dyn Progress,
) -> Result<TriangleMesh> {
    let scene = Scene::new(&mesh);
    let mut seen = vec![false; mesh.vertices.len()];
    let steps = Steps::new(progress, "culling to what cameras saw", data.views().len());
    for (index, view) in data.views().iter().enumerate() {
        let cam_from_world = cameras.world_from_cam(data, index).inverse();
        let depth =
            scene.depth(&RenderView { intrinsics: view.intrinsics, size: view.size(), cam_from_frame: cam_from_world });
        seen.par_iter_mut().zip(&mesh.vertices).filter(|(seen, _)| !**seen).for_each(|(seen, v)| {
            let p = cam_from_world * *v;
            if let Some(pixel) = view.intrinsics.img_from_cam(&p)
                && pixel.x > -0.5
                && pixel.y > -0.5
                && let Some(z) = depth.get(pixel.x.round() as usize, pixel.y.round() as usize)
            {
                *seen = *z == 0.0 || p.z <= f64::from(*z) + 2.0 * voxel_m;
            }
        });
        steps.step()?;
    }
    let kept = mesh.triangles.iter().filter(|t| t.iter().any(|v| seen[*v as usize])).copied().collect();
    Ok(without_unused_vertices(&TriangleMesh::new(mesh.vertices, kept)))
}

fn without_unused_vertices(mesh: &TriangleMesh) -> TriangleMesh {
    let mut new_index = vec![u32::MAX; mesh.vertices.len()];
    let mut vertices = Vec::new();
    let triangles = mesh
        .triangles
        .iter()
        .map(|t| {
            t.map(|v| {
                let slot = &mut new_index[v as usize];
                if *slot == u32::MAX {
                    *slot = vertices.len() as u32;
                    vertices.push(mesh.vertices[v as usize]);
                }
                *slot
            })
        })
        .collect();
    TriangleMesh::new(vertices, triangles)
}

/// Colours each vertex as it looks from straight above.
fn color(mesh: &mut TriangleMesh, model: &dyn Model, data: &RayDataset) {
    let mut normals = vec![Vector3::zeros(); mesh.vertices.len()];
    for (i, triangle) in mesh.triangles.iter().enumerate() {
        let normal = mesh.scaled_normal(i);
        triangle.iter().for_each(|v| normals[*v as usize] += normal);
    }
    let region = data.region();
    let colors: Vec<Vec<[u8; 3]>> = mesh
        .vertices
        .par_chunks(4096)
        .zip(normals.par_chunks(4096))
        .map(|(vertices, normals)| {
            let positions: Vec<[f32; 3]> =
                vertices.iter().map(|v| region.scene_from_world(v).coords.map(|c| c as f32).into()).collect();
            let directions: Vec<[f32; 3]> = normals
                .iter()
                .map(|n| (-n.try_normalize(0.0).unwrap_or_else(Vector3::z)).map(|c| c as f32).into())
                .collect();
            let rgb = model.color_at(&positions, &directions);
            rgb.into_iter().map(|c| c.map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8)).collect()
        })
        .collect();
    mesh.vertex_colors = Some(colors.concat());
}

#[cfg(test)]
mod tests {
    use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
    use mb_image::Image;
    use mb_job::Silent;
    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::cameras::CameraOptions;
    use crate::dataset::SceneRay;
    use crate::model::{Level, StepReport};

    /// A block 60 x 80 x 50 mm on a table, distances in metres of the scene, whose unit is the region's radius.
    struct BlockOnTable {
        radius_m: f64,
        only_object: bool,
    }

    impl Model for BlockOnTable {
        fn name(&self) -> &'static str {
            "neus"
        }

        fn only_object(&self) -> bool {
            self.only_object
        }

        fn iterations(&self) -> u64 {
            0
        }

        fn step(&mut self, _: &RayDataset, _: &mut CameraResiduals, _: u64) -> Result<StepReport> {
            Err(Error::Failed("it has nothing to learn".to_owned()))
        }

        fn render(&self, _: &[SceneRay]) -> Vec<[f32; 3]> {
            Vec::new()
        }

        fn level(&self) -> Level {
            Level { value: 0.0, larger_inside: false }
        }

        fn surface(&self, positions: &[[f32; 3]]) -> Vec<f32> {
            let distance = |p: &[f32; 3]| {
                let [x, y, z] = p.map(|c| f64::from(c) * self.radius_m);
                let block = (x.abs() - 0.03).max(y.abs() - 0.04).max(z.abs() - 0.025);
                // The table is rough by a millimetre.
                let table = z + 0.025 - 0.001 * (90.0 * x).sin() * (70.0 * y).cos();
                if self.only_object { block } else { block.min(table) }
            };
            positions.iter().map(|p| (distance(p) / self.radius_m) as f32).collect()
        }

        fn may_cross(&self, _: [f32; 3], _: [f32; 3]) -> bool {
            true
        }

        fn color_at(&self, positions: &[[f32; 3]], _: &[[f32; 3]]) -> Vec<[f32; 3]> {
            vec![[0.5; 3]; positions.len()]
        }

        fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
            Vec::new()
        }

        fn restored(&mut self, _: u64) -> std::result::Result<(), String> {
            Ok(())
        }

        fn is_finite(&self) -> bool {
            true
        }

        fn parameter_count(&self) -> usize {
            0
        }

        fn bytes(&self) -> usize {
            0
        }
    }

    /// Twelve cameras, 0.5 m away and above the table, that look at the origin.
    fn data() -> RayDataset {
        let view = |i: u32| {
            let (sin, cos) = (f64::from(i) * 0.52).sin_cos();
            let center = Vector3::new(0.4 * cos, 0.4 * sin, 0.3);
            let turn = UnitQuaternion::face_towards(&-center, &-Vector3::z());
            let pose = Rigid3::<World, Camera>::from_parts(turn, center);
            let rgb = Image::from_fn(ImageSize::new(80, 60), |_, _| [128; 3]);
            (rgb, None, Intrinsics { fx: 120.0, fy: 120.0, cx: 39.5, cy: 29.5 }, pose)
        };
        RayDataset::from_images((0..12).map(view).collect(), 0).expect("twelve good views")
    }

    fn extracted(only_object: bool, keep_table: bool, voxel_mm: f64) -> Extracted {
        let data = data();
        let model = BlockOnTable { radius_m: data.region().radius_m, only_object };
        let cameras = CameraResiduals::new(&CameraOptions::default(), &data);
        let options = SurfaceOptions { voxel_mm, cull: true, keep_table };
        extract(&model, &data, &cameras, &options, &Silent).expect("a surface")
    }

    #[test]
    fn the_table_is_cut_off_where_there_are_no_masks() {
        let Extracted { mesh, table } = extracted(false, false, 2.0);
        let table = table.expect("the object stands on something");
        assert!(
            table.plane.normal.z > 0.999 && (table.plane.height(&Point3::origin()) - 0.025).abs() < 5e-4,
            "{table:?}"
        );
        assert!((2.0..5.0).contains(&table.cut_mm), "{table:?}");
        let bounds = mesh.bounds();
        assert!((bounds.max.coords - Vector3::new(0.03, 0.04, 0.025)).norm() < 1e-3, "{bounds:?}");
        assert!(bounds.min.z > -0.025 + 1e-3 && bounds.min.x > -0.031 && bounds.min.y > -0.041, "{bounds:?}");
        let kept = extracted(false, true, 2.0);
        assert!(kept.table.is_none() && kept.mesh.bounds().min.x < -0.08, "{:?}", kept.mesh.bounds());
        // What was learned with masks is the object, whatever it looks like.
        assert_eq!(extracted(true, false, 2.0), extracted(true, true, 2.0));
    }

    #[test]
    fn a_cut_that_would_leave_nothing_is_not_made() {
        // Two voxels are more than the block is high.
        let coarse = extracted(false, false, 27.0);
        assert!(coarse.table.is_none() && !coarse.mesh.triangles.is_empty(), "{:?}", coarse.table);
    }
}
