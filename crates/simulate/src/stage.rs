//! The set: the model on a table, with what lies round it. Everything is in the object frame, in metres.

use glam::Vec3;
use mb_geometry::{Aabb, Ray};
use mb_job::{Error, Result, rng};
use mb_mesh::{Bvh, TriangleMesh};
use mb_render::Scene;
use nalgebra::{Point3, Vector3};
use rand::RngExt;

use crate::board::Print;
use crate::light::Light;
use crate::plastic::{Edge, Plastic};
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
    /// How much of it is a dark gap between two parts, 0 to 1.
    pub gap: f32,
}

/// What a ray meets.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Glimpse {
    pub radiance: Vec3,
    /// Whether it leaves the set.
    pub free: bool,
}

/// Half of the gap between the walls of two bricks: each stands back by 0.1 mm from the nominal pitch.
const GAP_M: f32 = 0.0001;
/// Surfaces of two parts at the same height within this are flush.
const FLUSH_M: f32 = 0.0003;
/// ABS comes out of a polished mould.
const PLASTIC_ROUGHNESS: f32 = 0.17;
/// Rays start this far off the surface.
pub(crate) const LIFT_M: f32 = 3e-5;
/// Rays end here: further surfaces count as part of the room.
pub(crate) const REACH_M: f64 = 0.8;

pub(crate) fn ray(from: Vec3, towards: Vec3) -> Ray {
    Ray {
        origin: Point3::new(f64::from(from.x), f64::from(from.y), f64::from(from.z)),
        direction: Vector3::new(f64::from(towards.x), f64::from(towards.y), f64::from(towards.z)),
    }
}

/// The set with its acceleration structures.
pub(crate) struct Stage {
    pub scene: Scene,
    pub bvh: Bvh,
    pub light: Light,
    /// The first triangles are the model's.
    pub model_triangles: usize,
    pub table_kind: Table,
    plastic: Plastic,
    pub board: Option<Print>,
    /// `[model_triangles]` linear albedo.
    albedos: Vec<Vec3>,
    /// `[triangles - model_triangles]` index into `patches`.
    patch_of: Vec<u16>,
    patches: Vec<Patch>,
    table_half_m: (f32, f32),
    salt: u32,
}

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

fn build_set(
    model: &TriangleMesh,
    bounds: &Aabb,
    kind: Table,
    seed: u64,
    half_m: (f32, f32),
    footprint: f32,
) -> Builder {
    let mut rng = rng(seed, streams::STAGE);
    let mut mesh = TriangleMesh::new(model.vertices.clone(), model.triangles.clone());
    mesh.vertices.reserve(256);
    let mut builder = Builder { mesh, patch_of: Vec::new(), patches: Vec::new() };
    let center = vec3(&bounds.center());
    let floor = Vec3::new(center.x, bounds.min.y as f32, center.z);

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
        let board = options.board_spec()?;
        let footprint = board.as_ref().map_or(footprint, |spec| footprint.max(Print::reach_m(spec)));
        let half_m = (least.0.max(footprint + 0.15), least.1.max(footprint + 0.10));
        let built = build_set(model, &bounds, table_kind, options.seed, half_m, footprint);
        let board = board.map(|spec| {
            let middle = Point3::new(bounds.center().x, bounds.min.y, bounds.center().z);
            let turn_rad = rng(options.seed, streams::BOARD).random_range(0.0..std::f64::consts::TAU);
            Print::new(&spec, &middle, turn_rad)
        });
        let salt = (options.seed as u32).wrapping_mul(0x9E37_79B1) ^ 0x5EED;
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
            plastic: Plastic::new(model, salt),
            board,
            model_triangles: model.triangles.len(),
            table_kind,
            albedos,
            patch_of: built.patch_of,
            patches: built.patches,
            table_half_m: half_m,
            salt,
        })
    }

    /// Whether a triangle is the model's; the others are flats of the surroundings.
    pub fn is_model(&self, triangle: u32) -> bool {
        (triangle as usize) < self.model_triangles
    }

    /// The normal at `p` on `triangle`, without relief, turned towards `view` (unit, from the surface).
    pub fn normal(&self, triangle: u32, p: Vec3, view: Vec3) -> Vec3 {
        let t = triangle as usize;
        if t < self.model_triangles {
            return self.plastic.normal(t, p, view);
        }
        let normal = self.patches[usize::from(self.patch_of[t - self.model_triangles])].normal;
        if normal.dot(view) < 0.0 { -normal } else { normal }
    }

    /// The surface at `p` on `triangle`, with relief and rounded edges, its normal towards `view` (unit, from the
    /// surface). Detail below `pixel_m` (the size of a pixel that faces it) is left out.
    pub fn surface(&self, triangle: u32, p: Vec3, view: Vec3, pixel_m: f32) -> Surface {
        let t = triangle as usize;
        if t < self.model_triangles {
            let moulded = self.plastic.moulded(t, p, view, pixel_m);
            let gap = moulded.edge.map_or(0.0, |edge| self.gap(t, p, view, edge, pixel_m));
            let finish = Finish { albedo: self.albedos[t], roughness: PLASTIC_ROUGHNESS, coat: 1.0, slope: (0.0, 0.0) };
            return Surface { normal: moulded.normal, finish, gap };
        }
        let index = self.patch_of[t - self.model_triangles];
        let patch = &self.patches[usize::from(index)];
        let flat = if patch.normal.dot(view) < 0.0 { -patch.normal } else { patch.normal };
        // What a pixel covers across and along its slant.
        let slanted_m = pixel_m / flat.dot(view).max(0.1).sqrt();
        let d = p - patch.origin;
        let at = (d.dot(patch.x_axis), d.dot(patch.y_axis));
        let salt = self.salt ^ u32::from(index).wrapping_mul(0x85EB_CA6B);
        let finish = match patch.material {
            Material::Table => self
                .board
                .as_ref()
                .and_then(|board| board.finish(p, slanted_m))
                .unwrap_or_else(|| texture::table(self.table_kind, at, slanted_m, self.table_half_m, salt)),
            Material::Surroundings => texture::surroundings(at, slanted_m, salt),
            Material::Edge => texture::edge(at, salt),
            Material::Plaster => texture::plaster(at, salt),
            Material::Clutter(base) => texture::clutter(base, at, slanted_m, salt),
        };
        let (sx, sy) = finish.slope;
        Surface { normal: (flat - patch.x_axis * sx - patch.y_axis * sy).normalize(), finish, gap: 0.0 }
    }

    /// How much of a pixel at `p`, beside an edge of its part, is the gap to another part whose surface goes on flush,
    /// 0 to 1.
    fn gap(&self, triangle: usize, p: Vec3, view: Vec3, edge: Edge, pixel_m: f32) -> f32 {
        // A pixel wider than the gap mixes it with what lies beside it.
        let half = GAP_M.max(0.5 * pixel_m);
        if edge.distance_m >= 1.5 * half {
            return 0.0;
        }
        let normal = self.plastic.normal(triangle, p, view);
        let over = p + edge.across * (edge.distance_m + FLUSH_M) + normal * FLUSH_M;
        let flush = self.bvh.cast(&ray(over, -normal), f64::from(2.0 * FLUSH_M)).is_some_and(|hit| {
            let other = hit.triangle as usize;
            other >= self.model_triangles || self.plastic.part(other) != self.plastic.part(triangle)
        });
        let covered = (1.5 - edge.distance_m / half).min(1.0);
        if flush { covered * (GAP_M / half) } else { 0.0 }
    }

    /// Radiance that arrives at `from` along the ray from `towards` (unit), the window itself left out: of surfaces one
    /// bounce of its light and a typical share of the room's. `blur` is the angle that the ray stands for.
    pub fn glimpse(&self, from: Vec3, towards: Vec3, shadowed: bool, blur: f32) -> Glimpse {
        let light = &self.light;
        let Some(hit) = self.bvh.cast(&ray(from, towards), REACH_M) else {
            return Glimpse { radiance: light.room(towards, blur), free: true };
        };
        let t = hit.t as f32;
        let p = from + towards * t;
        let surface = self.surface(hit.triangle, p, -towards, (blur * t).max(0.0004));
        let facing = surface.normal.dot(light.window).max(0.0);
        let lit = if facing <= 0.0 {
            0.0
        } else if shadowed {
            let start = p + surface.normal * LIFT_M;
            if self.bvh.occluded(&ray(start, light.window), REACH_M) { 0.0 } else { facing }
        } else {
            0.6 * facing
        };
        let arriving = light.window_strength * lit + light.room(surface.normal, 0.6) * 0.5;
        Glimpse { radiance: surface.finish.albedo * arriving, free: false }
    }
}
