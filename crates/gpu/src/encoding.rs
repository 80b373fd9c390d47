//! Tables of numbers at the corners of grids, on the device: the hash encoding, and dense voxels.

use mb_neural::adam::Parameters;
use mb_neural::dense_grid::DenseGrid;
use mb_neural::hash_grid::HashGrid;

use crate::context::{Buffer, Context, Work};
use crate::kernels::Kernels;
use crate::trained::{AdamStep, Gradient, Trained};

/// The encoding. A grid of voxels is one of a single level.
pub struct Encoding {
    levels: u32,
    features: u32,
    /// Columns before the encoding: 0, or 3 for the position itself.
    first: u32,
    stride: u32,
    /// Levels in use; the rest give zero.
    pub active_levels: usize,
    layout: Buffer,
    /// Its parameters.
    pub table: Trained,
    /// Gradient: whole numbers of two words, in units that a step chooses.
    pub sums: Buffer,
}

/// Points of the unit cube.
#[derive(Clone, Copy)]
pub struct Points<'a> {
    /// `[count, 3]`, at least.
    pub positions: &'a Buffer,
    /// How many.
    pub count: usize,
}

/// One unit of the table's gradient, for a loss whose rays have this weight each: shares of a sample are resolved to 2^-22 of
/// the weight.
pub fn unit_of(scale: f32) -> f32 {
    scale * (-22f32).exp2()
}

impl Encoding {
    /// From its twin, whose features begin in column `first`.
    pub fn new(context: &Context, grid: &HashGrid, table: &Parameters, first: usize) -> Self {
        let layout: Vec<[u32; 8]> = grid
            .layout()
            .iter()
            .map(|l| [l.cells, l.cells, l.cells, u32::from(l.dense), l.offset as u32, l.entries, 0, 0])
            .collect();
        Self {
            levels: grid.levels() as u32,
            features: grid.options().features as u32,
            first: first as u32,
            stride: (first + grid.width()).next_multiple_of(8) as u32,
            active_levels: grid.levels(),
            layout: context.upload(&layout),
            table: Trained::new(context, table),
            sums: context.zeros(2 * table.values.len()),
        }
    }

    /// From a grid of voxels, whose samples fill the first columns of rows of this length.
    pub fn of_voxels(context: &Context, grid: &DenseGrid, table: &Parameters, stride: usize) -> Self {
        let [x, y, z] = grid.size.map(|n| n as u32 - 1);
        Self {
            levels: 1,
            features: grid.channels as u32,
            first: 0,
            stride: stride as u32,
            active_levels: 1,
            layout: context.upload(&[x, y, z, 1, 0, 0, 0, 0]),
            table: Trained::new(context, table),
            sums: context.zeros(2 * table.values.len()),
        }
    }

    fn sizes(&self, points: Points<'_>, units: f32, adds: bool) -> [u32; 8] {
        let (active, adds) = (self.active_levels as u32, u32::from(adds));
        [points.count as u32, self.levels, self.features, self.stride, self.first, active, units.to_bits(), adds]
    }

    /// Numbers in a row of features.
    pub fn stride(&self) -> usize {
        self.stride as usize
    }

    /// Numbers that an entry has.
    pub fn features(&self) -> usize {
        self.features as usize
    }

    fn threads(&self, points: Points<'_>) -> usize {
        points.count * self.levels as usize * self.features.div_ceil(4) as usize
    }

    /// Writes `[points, stride]` features; the padding of a row is left as it is.
    pub fn forward(&self, work: &mut Work<'_>, k: &Kernels, points: Points<'_>, to: &Buffer) {
        let buffers = [(1, &self.layout), (2, points.positions), (3, &self.table.values), (4, to)];
        work.run(&k.encode, &self.sizes(points, 0.0, false), &buffers, self.threads(points));
    }

    /// Writes `[points, 3]` normals, by the position in -1..1: what `[points, stride]` derivatives by the features ask.
    pub fn normals(&self, work: &mut Work<'_>, k: &Kernels, points: Points<'_>, gradient: &Buffer, normals: &Buffer) {
        self.ask_positions(work, k, points, [gradient, normals], false);
    }

    /// Adds the same to what is there.
    pub fn add_normals(
        &self,
        work: &mut Work<'_>,
        k: &Kernels,
        points: Points<'_>,
        gradient: &Buffer,
        normals: &Buffer,
    ) {
        self.ask_positions(work, k, points, [gradient, normals], true);
    }

    fn ask_positions(
        &self,
        work: &mut Work<'_>,
        k: &Kernels,
        points: Points<'_>,
        [gradient, normals]: [&Buffer; 2],
        adds: bool,
    ) {
        let table = &self.table.values;
        let buffers = [(1, &self.layout), (2, points.positions), (3, table), (4, gradient), (6, normals)];
        work.run(&k.normals, &self.sizes(points, 0.0, adds), &buffers, points.count);
    }

    /// Writes `[points, stride]` tangents of the features along `[points, 3]` vectors.
    pub fn tangent(&self, work: &mut Work<'_>, k: &Kernels, points: Points<'_>, along: &Buffer, to: &Buffer) {
        let table = &self.table.values;
        let buffers = [(1, &self.layout), (2, points.positions), (3, table), (4, to), (6, along)];
        work.run(&k.encode_tangent, &self.sizes(points, 0.0, false), &buffers, self.threads(points));
    }

    /// Adds the derivatives of the features to `sums`, in this unit.
    pub fn scatter(&self, work: &mut Work<'_>, k: &Kernels, points: Points<'_>, d: &Buffer, unit: f32) {
        let buffers = [(1, &self.layout), (2, points.positions), (4, d), (5, &self.sums)];
        work.run(&k.scatter, &self.sizes(points, 1.0 / unit, false), &buffers, self.threads(points));
    }

    /// The same with the part that derivatives of the normals ask for: g, and dn.
    pub fn scatter_both(
        &self,
        work: &mut Work<'_>,
        k: &Kernels,
        points: Points<'_>,
        d: &Buffer,
        (gradient, d_normals): (&Buffer, &Buffer),
        unit: f32,
    ) {
        let buffers =
            [(1, &self.layout), (2, points.positions), (4, d), (5, &self.sums), (6, d_normals), (7, gradient)];
        work.run(&k.scatter_both, &self.sizes(points, 1.0 / unit, false), &buffers, self.threads(points));
    }

    /// Writes `[points, 3]` derivatives by the position in -1..1: what derivatives `d` of the features and, with g,
    /// derivatives of the normals ask.
    pub fn position_gradient(
        &self,
        work: &mut Work<'_>,
        k: &Kernels,
        points: Points<'_>,
        d: &Buffer,
        (gradient, d_normals): (&Buffer, &Buffer),
        to: &Buffer,
    ) {
        let table = &self.table.values;
        let buffers =
            [(1, &self.layout), (2, points.positions), (3, table), (4, d), (6, d_normals), (7, gradient), (8, to)];
        work.run(&k.position_gradient, &self.sizes(points, 0.0, false), &buffers, points.count);
    }

    /// One Adam step, which clears `sums`.
    pub fn step(&self, work: &mut Work<'_>, k: &Kernels, unit: f32, step: &AdamStep) {
        let gradient = Gradient { kernel: &k.adam_table, from: (4, &self.sums), scales: None, unit };
        self.table.step(work, step, &gradient, self.table.len);
    }

    /// The same, with the rates of each entry scaled by its own factor.
    pub fn step_scaled(&self, work: &mut Work<'_>, k: &Kernels, unit: f32, step: &AdamStep, scales: &Buffer) {
        let scales = Some((scales, self.features));
        let gradient = Gradient { kernel: &k.adam_scaled, from: (4, &self.sums), scales, unit };
        self.table.step(work, step, &gradient, self.table.len);
    }
}
