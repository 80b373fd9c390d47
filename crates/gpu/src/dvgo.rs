//! `dvgo` on a device, both stages. Rays are drawn on the processor, with the twin's random numbers, and there the fine stage
//! begins and voxels double; marching, the voxels, the network, the loss, the derivatives and Adam run on the device.

use std::sync::Arc;

use mb_job::{Result, rng};
use mb_neural::cameras::CameraResiduals;
use mb_neural::dataset::{RayDataset, TargetRay};
use mb_neural::dvgo::{Dvgo, FAR, UnitBox};
use mb_neural::encoding::Frequencies;
use mb_neural::model::{GROUPS, StepReport};
use mb_neural::sdf_field::DirectionEncoding;
use mb_neural::voxel_field::{ADAM, VoxelField, VoxelParameters, VoxelRates};
use rand::RngExt as _;
use rayon::prelude::*;

use crate::context::{Buffer, Context, Work};
use crate::encoding::Encoding;
use crate::frequencies::{self, Columns, encode_directions, encode_positions};
use crate::kernels::Kernels;
use crate::network::Network;
use crate::on_device::Learner;
use crate::ray_gradients::{self, ByColor, ByPosition, Coordinates, RAY_GRADIENT, correct};
use crate::rays::{Ahead, RAY, Rays, Samples, Space, occupied, pack};
use crate::trained::AdamStep;

/// One unit of the voxels' gradients, for a loss whose rays have this weight each. An almost empty grid has gradients of a
/// millionth of the weight; shares of a sample are resolved to 2^-40 of it, and may be as large as 2^20 of it.
fn unit_of(scale: f32) -> f32 {
    scale * (-40f32).exp2()
}

/// The network that turns features into colours, and what goes in.
struct ColorNetwork {
    network: Network,
    position: Frequencies,
    direction: Frequencies,
    stride: usize,
    input: Buffer,
}

/// A field on voxels. Twin: [`VoxelField`].
pub struct Voxels {
    density: Encoding,
    features: Encoding,
    color: Option<ColorNetwork>,
    shift: f32,
    /// Factors of each voxel's learning rates, where they are scaled.
    scales: Option<Buffer>,
    /// `[samples]`: raw density. `[samples, 8]`: colours before the sigmoid, without a network.
    raw: Buffer,
    plain: Buffer,
    /// To be filled before [`Self::backward`]: derivatives of the raw densities, and of the colours before the sigmoid.
    pub d_raw: Buffer,
    /// See `d_raw`.
    pub d_color: Buffer,
    d_positions: Buffer,
}

impl Voxels {
    /// From its twin.
    pub fn new(context: &Context, field: &VoxelField, p: &VoxelParameters, scales: Option<&[f32]>) -> Self {
        let (parts, none) = (field.parts(), || context.zeros(0));
        let color = parts.network.map(|(mlp, position, direction)| ColorNetwork {
            network: Network::new(context, mlp, &p.network, false),
            position,
            direction,
            stride: mlp.in_stride(),
            input: none(),
        });
        let stride = color.as_ref().map_or(8, |c| c.stride);
        Self {
            density: Encoding::of_voxels(context, parts.density, &p.density, 1),
            features: Encoding::of_voxels(context, parts.features, &p.features, stride),
            color,
            shift: parts.shift,
            scales: scales.map(|scales| context.upload(scales)),
            raw: none(),
            plain: none(),
            d_raw: none(),
            d_color: none(),
            d_positions: none(),
        }
    }

    /// Makes room for so many samples' colours.
    pub fn reserve(&mut self, context: &Context, n: usize) {
        for (buffer, width) in [(&mut self.raw, 1), (&mut self.d_raw, 1), (&mut self.d_color, 8)] {
            context.reserve(buffer, n * width);
        }
        match &mut self.color {
            None => context.reserve(&mut self.plain, 8 * n),
            Some(color) => {
                context.reserve(&mut color.input, n * color.stride);
                color.network.reserve(context, n);
            }
        }
    }

    /// Makes room for what [`Self::ray_gradients`] leaves of so many samples.
    fn reserve_gradients(&mut self, context: &Context, n: usize) {
        context.reserve(&mut self.d_positions, 3 * n);
    }

    /// Colours before the sigmoid, `[samples, 8]`.
    pub fn color(&self) -> &Buffer {
        self.color.as_ref().map_or(&self.plain, |color| color.network.out())
    }

    /// Raw densities of the first samples.
    fn densities(&self, work: &mut Work<'_>, k: &Kernels, s: &Samples) {
        self.density.forward(work, k, s.points(s.len), &self.raw);
    }

    /// Raw densities, and colours before the sigmoid.
    pub fn forward(&self, work: &mut Work<'_>, k: &Kernels, rays: &Buffer, s: &Samples) {
        self.densities(work, k, s);
        let points = s.points(s.len);
        let Some(color) = &self.color else {
            self.features.forward(work, k, points, &self.plain);
            return;
        };
        self.features.forward(work, k, points, &color.input);
        let first = self.features.features();
        let columns = Columns { to: &color.input, stride: color.stride, first };
        encode_positions(work, k, color.position, (points, 3), [2.0, -1.0], columns);
        let columns = Columns { first: first + color.position.width(), ..columns };
        encode_directions(work, k, color.direction, (rays, s), columns);
        color.network.forward(work, k, &color.input, s.len);
    }

    /// Sends `d_raw` and `d_color` back to the network and, in this unit, to the voxels.
    pub fn backward(&self, work: &mut Work<'_>, k: &Kernels, s: &Samples, unit: f32) {
        let points = s.points(s.len);
        if let Some(color) = &self.color {
            color.network.backward(work, k, &color.input, &self.d_color, s.len);
        }
        self.features.scatter(work, k, points, self.d_features(), unit);
        self.density.scatter(work, k, points, &self.d_raw, unit);
    }

    /// After [`Self::backward`]: derivatives of the features, which are the first columns of what the network takes or the
    /// colours themselves.
    fn d_features(&self) -> &Buffer {
        self.color.as_ref().map_or(&self.d_color, |color| color.network.d_input())
    }

    /// After [`Self::backward`]: adds to `[rays, 8]` numbers what the losses ask of the rays, whose samples lie in this box.
    fn ray_gradients(
        &self,
        work: &mut Work<'_>,
        k: &Kernels,
        rays: (&Buffer, usize),
        s: &Samples,
        (of, bounds): (Coordinates, UnitBox),
        to: &Buffer,
    ) {
        let (points, d, d_features) = (s.points(s.len), &self.d_positions, self.d_features());
        let stride = self.features.stride();
        let (mut first, mut direction) = (0, None);
        match &self.color {
            None => self.features.normals(work, k, points, d_features, d),
            Some(color) => {
                first = self.features.features();
                let columns = Columns { to: &color.input, stride, first };
                frequencies::normals(work, k, color.position, (s.len, 3), columns, [d_features, d]);
                self.features.add_normals(work, k, points, d_features, d);
                first += color.position.width();
                direction = Some(DirectionEncoding::Frequencies(color.direction.0));
            }
        }
        self.density.add_normals(work, k, points, &self.d_raw, d);
        // In -1..1 contracted space is half as long as in its own cube.
        let length = if matches!(of, Coordinates::Contracted) { 0.5 } else { 1.0 };
        let scale = std::array::from_fn(|i| length / (bounds.high[i] - bounds.low[i]));
        let color = ByColor { d: d_features, stride, with_position: false, first, direction };
        ray_gradients::add(work, k, rays, s, (ByPosition { d, of, scale }, color), (to, 0));
    }

    /// One Adam step, number `t` from 1.
    pub fn step(&self, work: &mut Work<'_>, k: &Kernels, unit: f32, rates: VoxelRates, t: u64) {
        let step = |lr| AdamStep { options: ADAM, lr, t };
        for (grid, lr) in [(&self.density, rates.density), (&self.features, rates.features)] {
            match &self.scales {
                None => grid.step(work, k, unit, &step(lr)),
                Some(scales) => grid.step_scaled(work, k, unit, &step(lr), scales),
            }
        }
        if let Some(color) = &self.color {
            color.network.step(work, k, &step(rates.network));
        }
    }

    /// Brings what was learned to the twin.
    ///
    /// # Errors
    /// As [`Context::read`].
    pub fn fetch(&self, context: &Context, p: &mut VoxelParameters) -> Result<()> {
        self.density.table.fetch(context, &mut p.density)?;
        self.features.table.fetch(context, &mut p.features)?;
        self.color.as_ref().map_or(Ok(()), |color| color.network.parameters.fetch(context, &mut p.network))
    }
}

/// A DVGO whose twin holds all that is not of the device, and, after a fetch, all that the device has learned.
pub struct GpuDvgo {
    twin: Dvgo,
    context: Arc<Context>,
    kernels: Kernels,
    field: Voxels,
    free: Buffer,
    /// As marched, and without the dim ones.
    marched: Samples,
    bright: Samples,
    rays: Buffer,
    losses: Buffer,
    /// What the losses ask of the rays, where a step moves the cameras.
    asked: Buffer,
    next: Ahead<Drawn>,
}

/// Rays of a step, where it moves the cameras also as they were drawn.
struct Drawn {
    rays: Vec<[f32; RAY]>,
    targets: Vec<TargetRay>,
}

fn voxels(context: &Context, twin: &Dvgo) -> Voxels {
    let scales = (!twin.is_fine()).then_some(twin.views.as_slice());
    Voxels::new(context, &twin.field, &twin.parameters, scales)
}

impl GpuDvgo {
    /// From its twin, which may have been trained.
    pub fn new(twin: Dvgo, context: Arc<Context>) -> Self {
        let c = &*context;
        Self {
            kernels: Kernels::new(c),
            field: voxels(c, &twin),
            free: occupied(c, &twin.free),
            marched: Samples::new(c),
            bright: Samples::new(c),
            rays: c.zeros(0),
            losses: c.zeros(0),
            asked: c.zeros(0),
            next: Ahead::none(),
            twin,
            context,
        }
    }

    /// The rays of a step, as the twin draws them.
    fn draw(&self, data: &RayDataset, cameras: &CameraResiduals, step: u64) -> Drawn {
        let (twin, moves) = (&self.twin, cameras.wants_gradients(step));
        let groups = (0..GROUPS as u64).into_par_iter().map(|group| {
            let (mut rng, mut targets) = (rng(twin.options.seed, step * GROUPS as u64 + group), Vec::new());
            data.draw(&mut rng, twin.rays_of_group(), cameras, &mut targets);
            let packed = targets.iter().map(|target| {
                let background = twin.background(&mut rng);
                let range = twin.range(&target.ray).map_or([0.0, -1.0], |(near, far)| [near, far]);
                let wanted = target.before(background, twin.with_masks);
                let mut ray = pack(target, rng.random(), background, wanted, range[0]);
                ray[14..16].copy_from_slice(&range);
                ray
            });
            let packed = packed.collect::<Vec<_>>();
            (packed, if moves { targets } else { Vec::new() })
        });
        let (rays, targets): (Vec<_>, Vec<_>) = groups.unzip();
        Drawn { rays: rays.concat(), targets: targets.concat() }
    }

    /// Samples of the rays, and those of them that are worth a colour.
    fn sample(&mut self, count: usize) -> Result<()> {
        let (context, k, twin) = (&*self.context, &self.kernels, &self.twin);
        let space = Space {
            resolution: twin.free.resolution(),
            far: FAR,
            step: twin.step_length(),
            cone: 0.0,
            inside_ball: twin.with_masks,
            voxels: Some(twin.bounds),
        };
        self.marched.march(context, k, &space, Rays { rays: &self.rays, count, occupied: &self.free })?;
        context.reserve(&mut self.field.raw, self.marched.len);
        context.reserve(&mut self.bright.counts, count);
        let (m, f) = (&self.marched, &self.field);
        let mut work = context.work();
        f.densities(&mut work, k, m);
        let judged = [(2, &m.starts), (3, &m.steps), (4, &f.raw), (5, &self.bright.counts), (6, &m.stays)];
        work.run(&k.count_bright, &self.sizes(count), &judged, count);
        work.submit();
        self.bright.keep(context, k, m, count, 0)
    }

    /// What both entry points of voxels.wgsl are told.
    fn sizes(&self, count: usize) -> Vec<u32> {
        let (twin, stage) = (&self.twin, self.twin.stage());
        let floats =
            [twin.interval(), self.field.shift, stage.dim, 1.0 / count as f32, stage.entropy, stage.point_color];
        std::iter::once(count as u32).chain(floats.map(f32::to_bits)).collect()
    }

    /// Forward, loss, backward and Adam; the losses stay in `self.losses`, and, where the step moves the cameras, what they ask
    /// of the rays in `self.asked`.
    fn learn(&mut self, count: usize, step: u64, moves: bool) {
        let (context, rays) = (&*self.context, &self.rays);
        self.field.reserve(context, self.bright.len);
        context.reserve(&mut self.losses, 2 * count);
        if moves {
            self.field.reserve_gradients(context, self.bright.len);
            context.reserve(&mut self.asked, RAY_GRADIENT * count);
        }
        let (k, f, s) = (&self.kernels, &self.field, &self.bright);
        let mut work = context.work();
        f.forward(&mut work, k, rays, s);
        let losses = [
            (1, rays),
            (2, &s.starts),
            (4, &f.raw),
            (7, f.color()),
            (8, &f.d_raw),
            (9, &f.d_color),
            (10, &self.losses),
        ];
        work.run(&k.voxel_losses, &self.sizes(count), &losses, count);
        let unit = unit_of(1.0 / count as f32);
        f.backward(&mut work, k, s, unit);
        if moves {
            let of = if self.twin.with_masks { Coordinates::Scene } else { Coordinates::Contracted };
            work.clear(&self.asked);
            f.ray_gradients(&mut work, k, (rays, count), s, (of, self.twin.bounds), &self.asked);
        }
        let (t, factor) = self.twin.course(step);
        f.step(&mut work, k, unit, self.twin.rates(factor), t);
        work.submit();
    }
}

impl Learner for GpuDvgo {
    type Twin = Dvgo;

    fn twin(&self) -> &Dvgo {
        &self.twin
    }

    fn twin_mut(&mut self) -> &mut Dvgo {
        &mut self.twin
    }

    fn step(&mut self, data: &RayDataset, cameras: &mut CameraResiduals, step: u64) -> Result<StepReport> {
        if self.twin.is_replaced_at(step) {
            self.fetch()?;
            self.twin.begin(step)?;
            self.send();
        }
        let Drawn { rays, targets } = self.next.take(step).unwrap_or_else(|| self.draw(data, cameras, step));
        let (count, moves) = (rays.len(), !targets.is_empty());
        self.context.replace(&mut self.rays, rays.as_flattened());
        self.sample(count)?;
        self.learn(count, step, moves);
        // While the device learns, the next rays are drawn, where they are of the same stage and their cameras stay.
        if !moves && !self.twin.is_replaced_at(step + 1) {
            self.next.keep(step + 1, self.draw(data, cameras, step + 1));
        }
        let parts = [(&self.losses, 2 * count), (&self.asked, RAY_GRADIENT * targets.len())];
        let found = self.context.read_all(&parts)?;
        let losses: &[[f32; 2]] = bytemuck::cast_slice(&found[0]);
        let (_, factor) = self.twin.course(step);
        correct(cameras, data, &targets, bytemuck::cast_slice(&found[1]), (factor, step));
        let mean = |i: usize| losses.iter().map(|l| f64::from(l[i])).sum::<f64>() / count as f64;
        let (samples, lit) = (self.marched.len, self.bright.len);
        Ok(StepReport { loss: mean(1), mse: mean(0) / 3.0, rays: count, samples, lit })
    }

    fn fetch(&mut self) -> Result<()> {
        self.field.fetch(&self.context, &mut self.twin.parameters)
    }

    fn send(&mut self) {
        self.next = Ahead::none();
        self.field = voxels(&self.context, &self.twin);
        self.free = occupied(&self.context, &self.twin.free);
    }
}
