//! The set: the model on a table, with what lies round it. Everything is in the object frame, in metres.

use glam::Vec3;
use mb_geometry::Aabb;
use mb_job::{Error, Result, rng};
use mb_mesh::{Bvh, TriangleMesh};
use mb_render::Scene;
use nalgebra::Point3;
use rand::RngExt;

use crate::light::Light;
use crate::texture::{self, Finish, linear_from_srgb};
use crate::{SimulateOptions, Table, streams};

/// What a triangle of the set is made of. Planar things carry the frame of their texture.
#[derive(Debug, Clone, Copy)]
enum Material {
    Table,
    Edge,
    Surroundings,
    Plaster,
    Clutter(Vec3),
}

/// A planar patch of the set: its material and the frame of its texture.
#[derive(Debug, Clone, Copy)]
struct Patch {
    material: Material,
    origin: Vec3,
    x_axis: Vec3,
    y_axis: Vec3,
    normal: Vec3,
}

/// The surface at a point, ready for light.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Surface {
    pub normal: Vec3,
    pub finish: Finish,
}

/// The set with its acceleration structures.
pub(crate) struct Stage {
    pub scene: Scene,
    pub bvh: Bvh,
    pub light: Light,
    pub mesh: TriangleMesh,
    /// The first triangles are the model's.
    pub model_triangles: usize,
    pub table_kind: Table,
    /// `[model_triangles]` normals at the three corners.
    corner_normals: Vec<[Vec3; 3]>,
    /// `[model_triangles]` linear albedo.
    albedos: Vec<Vec3>,
    /// `[triangles - model_triangles]` index into `patches`.
    patch_of: Vec<u16>,
    patches: Vec<Patch>,
    table_half_m: (f32, f32),
    salt: u32,
}

/// Facets that meet at less than this angle are one curved surface: a stud has 16 facets of 22.5 degrees.
const CREASE_COS: f32 = 0.85;

pub(crate) fn vec3(p: &Point3<f64>) -> Vec3 {
    Vec3::new(p.x as f32, p.y as f32, p.z as f32)
}

/// Builds planar patches into a mesh.
struct Builder {
    mesh: TriangleMesh,
    patch_of: Vec<u16>,
    patches: Vec<Patch>,
}

impl Builder {
    /// Adds a parallelogram with its texture frame in the middle.
    fn quad(&mut self, material: Material, middle: Vec3, half_x: Vec3, half_y: Vec3) {
        let normal = half_y.cross(half_x).normalize();
        let patch = self.patches.len() as u16;
        self.patches.push(Patch {
            material,
            origin: middle,
            x_axis: half_x.normalize(),
            y_axis: half_y.normalize(),
            normal,
        });
        let first = self.mesh.vertices.len() as u32;
        for (a, b) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (1.0, -1.0)] {
            let p = middle + half_x * a + half_y * b;
            self.mesh.vertices.push(Point3::new(f64::from(p.x), f64::from(p.y), f64::from(p.z)));
        }
        self.mesh.triangles.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
        self.patch_of.extend([patch; 2]);
    }

    /// Adds the top and the four sides of a box that stands on `base`; `x` and `z` are half edges, the sides may have another material.
    fn cuboid(&mut self, top: Material, side: Material, base: Vec3, x: Vec3, z: Vec3, height: f32) {
        let up = Vec3::Y * (0.5 * height);
        self.quad(top, base + 2.0 * up, x, z);
        for sign in [1.0, -1.0] {
            self.quad(side, base + up + sign * x, sign * z, up);
            self.quad(side, base + up + sign * z, -sign * x, up);
        }
    }
}

fn build_set(model: &TriangleMesh, bounds: &Aabb, kind: Table, seed: u64, half_m: (f32, f32)) -> Builder {
    let mut rng = rng(seed, streams::STAGE);
    let mut mesh = TriangleMesh::new(model.vertices.clone(), model.triangles.clone());
    mesh.vertices.reserve(256);
    let mut builder = Builder { mesh, patch_of: Vec::new(), patches: Vec::new() };
    let center = vec3(&bounds.center());
    let floor = Vec3::new(center.x, bounds.min.y as f32, center.z);
    let footprint = 0.5 * (bounds.extent().x.hypot(bounds.extent().z)) as f32;

    // The table: turned against the model and not centred under it.
    let turn: f32 = rng.random_range(0.0..std::f32::consts::TAU);
    let (sin, cos) = turn.sin_cos();
    let (ex, ez) = (Vec3::new(cos, 0.0, sin), Vec3::new(-sin, 0.0, cos));
    let mut slack = |half: f32| rng.random_range(-0.6..0.6f32) * (half - footprint - 0.02).max(0.0);
    let middle = floor + ex * slack(half_m.0) + ez * slack(half_m.1);
    let thick = if kind == Table::Bamboo { 0.022 } else { 0.05 };
    let side = if kind == Table::Bamboo || kind == Table::Oak { Material::Edge } else { Material::Table };
    builder.cuboid(Material::Table, side, middle - Vec3::Y * thick, ex * half_m.0, ez * half_m.1, thick);

    // A board lies on a sofa, the other tables stand on a floor.
    let below = if kind == Table::Bamboo { thick } else { 0.45 };
    builder.quad(Material::Surroundings, floor - Vec3::Y * below, ex * 4.0, ez * 4.0);
    let back = half_m.1 + if kind == Table::Bamboo { 0.12 } else { 0.9 };
    let cushion = middle + ez * (back + 0.2) - Vec3::Y * below;
    builder.cuboid(Material::Surroundings, Material::Surroundings, cushion, ex * 1.2, ez * 0.2, 0.45 + below);
    for (a, b) in [(ex, ez), (ez, ex)] {
        for sign in [1.0, -1.0] {
            builder.quad(Material::Plaster, floor + a * (2.5 * sign) + Vec3::Y * 0.6, b * 2.5, Vec3::Y * 1.8);
        }
    }

    // Low clutter beyond the model, so that it hides nothing.
    for _ in 0..rng.random_range(2..6) {
        let (hx, hz) = (rng.random_range(0.01..0.08f32), rng.random_range(0.01..0.06f32));
        let reach = footprint + 0.06 + hx.hypot(hz);
        let around: f32 = rng.random_range(0.0..std::f32::consts::TAU);
        let spot = floor + Vec3::new(around.cos(), 0.0, around.sin()) * (reach + rng.random_range(0.0..0.15f32));
        let from_middle = spot - middle;
        let on_table =
            from_middle.dot(ex).abs() + hx.hypot(hz) < half_m.0 && from_middle.dot(ez).abs() + hx.hypot(hz) < half_m.1;
        let base = Vec3::from(std::array::from_fn::<f32, 3, _>(|_| rng.random_range(0.03..0.7f32).powf(1.4)));
        let (sin, cos) = rng.random_range(0.0..std::f32::consts::TAU).sin_cos();
        let height = rng.random_range(0.004..0.02f32);
        if on_table {
            let (x, z) = (Vec3::new(cos, 0.0, sin) * hx, Vec3::new(-sin, 0.0, cos) * hz);
            builder.cuboid(Material::Clutter(base), Material::Clutter(base * 0.8), spot, x, z, height);
        }
    }
    builder
}

/// Normals at the corners of each triangle: the area-weighted mean over the facets of the same part that meet there
/// at less than the crease angle.
fn corner_normals(mesh: &TriangleMesh) -> Vec<[Vec3; 3]> {
    let part = |t: usize| mesh.triangle_parts.as_ref().map_or(0, |parts| parts[t]);
    let scaled: Vec<Vec3> = (0..mesh.triangles.len())
        .map(|t| {
            let n = mesh.scaled_normal(t);
            Vec3::new((n.x * 1e6) as f32, (n.y * 1e6) as f32, (n.z * 1e6) as f32)
        })
        .collect();
    // Corners at the same place (to 10 micrometres) of the same part stand beside each other once sorted.
    let mut corners: Vec<([i64; 3], u32, u32, u8)> = Vec::with_capacity(3 * scaled.len());
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        for (k, v) in triangle.iter().enumerate() {
            let p = mesh.vertices[*v as usize];
            let place = [p.x, p.y, p.z].map(|c| (c * 1e5).round() as i64);
            corners.push((place, part(t), t as u32, k as u8));
        }
    }
    corners.sort_unstable();
    let mut normals = vec![[Vec3::ZERO; 3]; scaled.len()];
    for group in corners.chunk_by(|a, b| a.0 == b.0 && a.1 == b.1) {
        for &(_, _, t, k) in group {
            let own = scaled[t as usize].normalize_or_zero();
            let smooth: Vec3 = group
                .iter()
                .map(|&(_, _, other, _)| scaled[other as usize])
                .filter(|n| n.normalize_or_zero().dot(own) > CREASE_COS)
                .sum();
            normals[t as usize][k as usize] = smooth.try_normalize().unwrap_or(own);
        }
    }
    normals
}

impl Stage {
    /// Sets the scene round `model` (object frame, metres).
    ///
    /// # Errors
    /// The model has no triangles, or its size is not that of something on a table.
    pub fn new(model: &TriangleMesh, options: &SimulateOptions) -> Result<Self> {
        let bounds = model.bounds();
        let extent = bounds.extent();
        if model.triangles.is_empty() {
            return Err(Error::Failed("the model has no triangles, so there is nothing to photograph".to_owned()));
        }
        if !(extent.norm() > 1e-3 && extent.norm() < 5.0) {
            return Err(Error::Failed(format!(
                "the model measures {:.3} x {:.3} x {:.3} m; the simulator wants 1 mm to 5 m, in metres",
                extent.x, extent.y, extent.z
            )));
        }
        let table_kind = options
            .table
            .unwrap_or_else(|| Table::ALL[rng(options.seed, streams::TABLE).random_range(0..Table::ALL.len())]);
        let footprint = 0.5 * extent.x.hypot(extent.z) as f32;
        let least: (f32, f32) = if table_kind == Table::Bamboo { (0.36, 0.26) } else { (0.6, 0.42) };
        let half_m = (least.0.max(footprint + 0.15), least.1.max(footprint + 0.10));
        let built = build_set(model, &bounds, table_kind, options.seed, half_m);
        let grey = [160u8; 3];
        let albedos = (0..model.triangles.len())
            .map(|t| linear_from_srgb(model.triangle_colors.as_ref().map_or(grey, |colors| colors[t])))
            // Pigments are never quite black or white.
            .map(|albedo| albedo.clamp(Vec3::splat(0.012), Vec3::splat(0.82)))
            .collect();
        Ok(Self {
            scene: Scene::new(&built.mesh),
            bvh: Bvh::new(&built.mesh),
            light: Light::new(options.seed),
            corner_normals: corner_normals(model),
            model_triangles: model.triangles.len(),
            mesh: built.mesh,
            table_kind,
            albedos,
            patch_of: built.patch_of,
            patches: built.patches,
            table_half_m: half_m,
            salt: (options.seed as u32).wrapping_mul(0x9E37_79B1) ^ 0x5EED,
        })
    }

    /// The part that a triangle belongs to; the set's patches count as parts of their own.
    pub fn part(&self, model: &TriangleMesh, triangle: u32) -> u32 {
        let t = triangle as usize;
        if t < self.model_triangles {
            model.triangle_parts.as_ref().map_or(0, |parts| parts[t])
        } else {
            u32::MAX - u32::from(self.patch_of[t - self.model_triangles])
        }
    }

    /// Normal of the model's surface, smooth over curved parts, towards `view`; `None` off the model.
    fn model_normal(&self, t: usize, p: Vec3) -> Vec3 {
        let [a, b, c] = self.mesh.triangles[t].map(|v| vec3(&self.mesh.vertices[v as usize]));
        let (e1, e2, d) = (b - a, c - a, p - a);
        let (d11, d12, d22) = (e1.dot(e1), e1.dot(e2), e2.dot(e2));
        let (d1, d2) = (d.dot(e1), d.dot(e2));
        let determinant = d11 * d22 - d12 * d12;
        let [n0, n1, n2] = self.corner_normals[t];
        if determinant <= 0.0 {
            return n0;
        }
        let v = ((d22 * d1 - d12 * d2) / determinant).clamp(0.0, 1.0);
        let w = ((d11 * d2 - d12 * d1) / determinant).clamp(0.0, 1.0 - v);
        (n0 * (1.0 - v - w) + n1 * v + n2 * w).try_normalize().unwrap_or(n0)
    }

    /// The normal at `p` on `triangle`, without relief, turned towards `view` (unit, from the surface).
    pub fn normal(&self, triangle: u32, p: Vec3, view: Vec3) -> Vec3 {
        let t = triangle as usize;
        let normal = if t < self.model_triangles {
            self.model_normal(t, p)
        } else {
            self.patches[usize::from(self.patch_of[t - self.model_triangles])].normal
        };
        if normal.dot(view) < 0.0 { -normal } else { normal }
    }

    /// Colour and finish at `p` on `triangle`.
    fn finish(&self, triangle: u32, p: Vec3, pixel_m: f32) -> (Finish, Option<&Patch>) {
        let t = triangle as usize;
        if t < self.model_triangles {
            return (Finish { albedo: self.albedos[t], roughness: 0.2, slope: (0.0, 0.0) }, None);
        }
        let index = self.patch_of[t - self.model_triangles];
        let patch = &self.patches[usize::from(index)];
        let d = p - patch.origin;
        let at = (d.dot(patch.x_axis), d.dot(patch.y_axis));
        let salt = self.salt ^ u32::from(index).wrapping_mul(0x85EB_CA6B);
        let finish = match patch.material {
            Material::Table => texture::table(self.table_kind, at, pixel_m, self.table_half_m, salt),
            Material::Surroundings => texture::surroundings(at, pixel_m, salt),
            Material::Edge => texture::edge(at, salt),
            Material::Plaster => texture::plaster(at, salt),
            Material::Clutter(base) => texture::clutter(base, at, salt),
        };
        (finish, Some(patch))
    }

    /// The surface at `p` on `triangle`, with relief, its normal towards `view` (unit, from the surface). Detail below
    /// `pixel_m` (the size of a pixel that faces it) is left out.
    pub fn surface(&self, triangle: u32, p: Vec3, view: Vec3, pixel_m: f32) -> Surface {
        let mut normal = self.normal(triangle, p, view);
        let slanted_m = pixel_m / normal.dot(view).max(0.1);
        let (finish, patch) = self.finish(triangle, p, slanted_m);
        if let Some(patch) = patch {
            let (sx, sy) = finish.slope;
            normal = (normal - patch.x_axis * sx - patch.y_axis * sy).normalize();
        }
        Surface { normal, finish }
    }

    /// Whether a triangle is the model's.
    pub fn is_model(&self, triangle: u32) -> bool {
        (triangle as usize) < self.model_triangles
    }
}
