//! A field of signed distance and colour, with normals that a loss may use.
//!
//! Position x (in the unit ball) is encoded as `e(x)`, whose first three numbers are x itself and whose rest is a hash
//! encoding or frequencies. The geometry network gives `(f, feature) = network(e)`; the normal is the exact gradient
//! `n = J^T g`, `g = df/de` ([`crate::mlp`]), `J = de/dx`. The colour network sees x, n, an encoded direction and the
//! feature. Given `df`, `dn` and `dc`, the backward pass is: colour network, which adds to `dn` and gives `dfeature`;
//! `dg = J dn`; geometry network with double backward; and for a hash encoding the scatter of both its terms
//! ([`crate::hash_grid`]). Nothing is approximated.

use mb_job::Rng;
use serde::{Deserialize, Serialize};

use crate::adam::{AdamOptions, Parameters};
use crate::encoding::{Frequencies, HARMONICS, harmonics_gradient, spherical_harmonics};
use crate::hash_grid::{HashGrid, HashGridOptions, Scatter};
use crate::mlp::{Activation, Mlp, MlpCache, MlpShape, Skip};
use crate::model::TILE;
use crate::network::Network;
use crate::radiance_field::{add, sigmoid_all};
use crate::simd::padded;

/// How a position is encoded.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum PositionEncoding {
    /// x and a hash encoding of it.
    Hash(HashGridOptions),
    /// x and this many octaves of sine and cosine.
    Frequencies(usize),
}

/// How a direction is encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum DirectionEncoding {
    /// Spherical harmonics of degree 0 to 3.
    Harmonics,
    /// d and this many octaves of sine and cosine.
    Frequencies(usize),
}

/// Sizes of the field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SdfFieldOptions {
    /// Encoding of the position.
    pub position: PositionEncoding,
    /// Encoding of the direction.
    pub direction: DirectionEncoding,
    /// Width of the geometry network.
    pub width: usize,
    /// Its hidden layers.
    pub hidden: usize,
    /// Its layer that sees the encoding again (NeuS: 4).
    pub skip: Option<usize>,
    /// Numbers that it hands to the colour network.
    pub features: usize,
    /// Sharpness of its softplus.
    pub softplus: f32,
    /// Width of the colour network.
    pub color_width: usize,
    /// Its hidden layers.
    pub color_hidden: usize,
    /// Normalise the weights of both.
    pub weight_norm: bool,
    /// Radius of the ball that the distance starts as.
    pub initial_radius: f32,
}

impl SdfFieldOptions {
    /// The networks of the paper (Wang et al. 2021 and its code, `confs/wmask.conf`): distance 8 x 256 with softplus of
    /// sharpness 100, skip at layer 4, 6 octaves, 256 features; colour 4 x 256 with 4 octaves of the direction; both
    /// with normalised weights; a ball of radius 0.5 at the start.
    pub fn paper() -> Self {
        Self {
            position: PositionEncoding::Frequencies(6),
            direction: DirectionEncoding::Frequencies(4),
            width: 256,
            hidden: 8,
            skip: Some(4),
            features: 256,
            softplus: 100.0,
            color_width: 256,
            color_hidden: 4,
            weight_norm: true,
            initial_radius: 0.5,
        }
    }
}

/// The field.
#[derive(Debug, Clone)]
pub struct SdfField {
    options: SdfFieldOptions,
    grid: Option<HashGrid>,
    frequencies: Frequencies,
    table: Parameters,
    geometry: Network,
    color: Network,
    directions: usize,
    /// Levels of the hash encoding in use; the rest give zero.
    pub active_levels: usize,
}

/// What a field is made of, for a twin on a device.
#[derive(Debug, Clone, Copy)]
pub struct SdfParts<'a> {
    /// Hash encoding of the position, and its table; `None` where the position has frequencies.
    pub grid: Option<(&'a HashGrid, &'a Parameters)>,
    /// Octaves of the position, where there is no hash encoding.
    pub frequencies: Frequencies,
    /// Encoding of the direction.
    pub direction: DirectionEncoding,
    /// Distance and features.
    pub geometry: &'a Network,
    /// Colour.
    pub color: &'a Network,
}

/// Buffers for one worker: a tile in flight, and the gradients gathered since the last [`SdfField::collect`].
#[derive(Debug, Default)]
pub struct SdfWorker {
    encoded: Vec<f32>,
    units: Vec<[f32; 3]>,
    geometry: MlpCache,
    color_in: Vec<f32>,
    color: MlpCache,
    /// Signed distance of each sample.
    pub sdf: Vec<f32>,
    /// Its gradient.
    pub normals: Vec<[f32; 3]>,
    /// Colour of each sample.
    pub rgb: Vec<[f32; 3]>,
    /// To be filled before [`SdfField::backward`].
    pub d_sdf: Vec<f32>,
    /// To be filled before [`SdfField::backward`]; the colour network adds its part.
    pub d_normals: Vec<[f32; 3]>,
    /// To be filled before [`SdfField::backward`]; empty where the colours were not computed.
    pub d_rgb: Vec<[f32; 3]>,
    /// By [`SdfField::ray_gradients`].
    pub d_positions: Vec<[f32; 3]>,
    /// By [`SdfField::ray_gradients`].
    pub d_directions: Vec<[f32; 3]>,
    d_out: Vec<f32>,
    d_gradient: Vec<f32>,
    geometry_grads: Vec<f32>,
    color_grads: Vec<f32>,
    gathered: Gathered,
}

/// What the hash grid will scatter.
#[derive(Debug, Default)]
struct Gathered {
    units: Vec<[f32; 3]>,
    d_features: Vec<f32>,
    gradient: Vec<f32>,
    d_normals: Vec<[f32; 3]>,
}

impl SdfField {
    /// A field whose distance starts near that of a ball.
    pub fn new(options: SdfFieldOptions, rng: &mut Rng) -> Self {
        let (grid, frequencies) = match options.position {
            PositionEncoding::Hash(grid) => (Some(HashGrid::new(grid)), Frequencies(0)),
            PositionEncoding::Frequencies(octaves) => (None, Frequencies(octaves)),
        };
        let inputs = 3 + grid.as_ref().map_or(6 * frequencies.0, HashGrid::width);
        let directions = match options.direction {
            DirectionEncoding::Harmonics => HARMONICS,
            DirectionEncoding::Frequencies(octaves) => Frequencies(octaves).width(),
        };
        let geometry = Mlp::new(MlpShape {
            inputs,
            width: options.width,
            hidden: options.hidden,
            outputs: 1 + options.features,
            activation: Activation::Softplus { beta: options.softplus },
            skip: options.skip.map(|layer| Skip { layer, narrow: true }),
        });
        let color = Mlp::new(MlpShape {
            inputs: 6 + directions + options.features,
            width: options.color_width,
            hidden: options.color_hidden,
            outputs: 3,
            activation: Activation::Relu,
            skip: None,
        });
        let (geometry_start, color_start) =
            (geometry.init_geometric(options.initial_radius, rng), color.init_uniform(rng));
        Self {
            table: Parameters::new(grid.as_ref().map_or_else(Vec::new, |g| g.init(rng))),
            active_levels: grid.as_ref().map_or(0, HashGrid::levels),
            geometry: Network::new(geometry, geometry_start, options.weight_norm),
            color: Network::new(color, color_start, options.weight_norm),
            grid,
            frequencies,
            directions,
            options,
        }
    }

    /// What it is made of.
    pub fn parts(&self) -> SdfParts<'_> {
        SdfParts {
            grid: self.grid.as_ref().map(|grid| (grid, &self.table)),
            frequencies: self.frequencies,
            direction: self.options.direction,
            geometry: &self.geometry,
            color: &self.color,
        }
    }

    /// The table, the geometry network and the colour network, to be replaced; call [`Self::refresh`] afterwards.
    pub fn parts_mut(&mut self) -> (&mut Parameters, [&mut Network; 2]) {
        (&mut self.table, [&mut self.geometry, &mut self.color])
    }

    /// Number of parameters, padding not counted.
    pub fn parameter_count(&self) -> usize {
        self.table.values.len() + self.geometry.parameter_count() + self.color.parameter_count()
    }

    /// Levels of the hash encoding; 0 for frequencies.
    pub fn levels(&self) -> usize {
        self.grid.as_ref().map_or(0, HashGrid::levels)
    }

    fn stride(&self) -> usize {
        self.geometry.mlp().in_stride()
    }

    fn color_stride(&self) -> usize {
        padded(6 + self.directions + self.options.features)
    }

    /// Computes the signed distance of a tile of positions: `worker.sdf`.
    pub fn distance(&self, positions: &[[f32; 3]], worker: &mut SdfWorker) {
        let stride = self.stride();
        worker.encoded.resize(positions.len() * stride, 0.0);
        worker.units.clear();
        match &self.grid {
            Some(grid) => {
                worker.units.extend(positions.iter().map(|p| p.map(|c| 0.5 * c + 0.5)));
                grid.forward(&self.table.values, &worker.units, self.active_levels, &mut worker.encoded, stride, 3);
                for (row, p) in worker.encoded.chunks_exact_mut(stride).zip(positions) {
                    row[..3].copy_from_slice(p);
                }
            }
            None => self.frequencies.forward(positions, &mut worker.encoded, stride, 0),
        }
        self.distance_of_encoded(positions.len(), worker);
    }

    fn distance_of_encoded(&self, rows: usize, worker: &mut SdfWorker) {
        let mlp = self.geometry.mlp();
        mlp.forward(self.geometry.weights().parameters, &worker.encoded, self.stride(), rows, &mut worker.geometry);
        worker.sdf.clear();
        worker.sdf.extend(worker.geometry.out.chunks_exact(mlp.out_stride()).map(|o| o[0]));
    }

    /// Signed distances of any number of points.
    pub fn distances(&self, positions: &[[f32; 3]]) -> Vec<f32> {
        let mut worker = SdfWorker::default();
        let mut out = Vec::with_capacity(positions.len());
        for tile in positions.chunks(TILE) {
            self.distance(tile, &mut worker);
            out.extend_from_slice(&worker.sdf);
        }
        out
    }

    /// Colours of any number of points, each seen along its (unit) direction.
    pub fn colors(&self, positions: &[[f32; 3]], directions: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let mut worker = SdfWorker::default();
        let mut out = Vec::with_capacity(positions.len());
        for (positions, directions) in positions.chunks(TILE).zip(directions.chunks(TILE)) {
            let runs: Vec<_> = directions.iter().map(|d| (1, *d)).collect();
            self.distance(positions, &mut worker);
            self.normals(&mut worker);
            self.color(&runs, &mut worker);
            out.extend_from_slice(&worker.rgb);
        }
        out
    }

    /// Keeps the samples that `keep` names (ascending) of a tile whose distance has been computed.
    pub fn compact(&self, keep: &[u32], worker: &mut SdfWorker) {
        let stride = self.stride();
        for (to, from) in keep.iter().enumerate() {
            let from = *from as usize;
            worker.encoded.copy_within(from * stride..(from + 1) * stride, to * stride);
            if !worker.units.is_empty() {
                worker.units[to] = worker.units[from];
            }
        }
        worker.encoded.truncate(keep.len() * stride);
        worker.units.truncate(keep.len());
        self.distance_of_encoded(keep.len(), worker);
    }

    /// Computes `worker.normals` of a tile whose distance has been computed.
    pub fn normals(&self, worker: &mut SdfWorker) {
        let stride = self.stride();
        self.geometry.mlp().gradient(&self.geometry.weights(), &mut worker.geometry);
        let gradient = &worker.geometry.gradient;
        worker.normals.clear();
        worker.normals.resize(worker.sdf.len(), [0.0; 3]);
        match &self.grid {
            Some(grid) => {
                let table = &self.table.values;
                grid.input_gradient(table, &worker.units, self.active_levels, gradient, stride, 3, &mut worker.normals);
                for (n, g) in worker.normals.iter_mut().zip(gradient.chunks_exact(stride)) {
                    *n = std::array::from_fn(|d| g[d] + 0.5 * n[d]);
                }
            }
            None => self.frequencies.input_gradient(&worker.encoded, gradient, stride, 0, &mut worker.normals),
        }
    }

    /// Computes the colours of a tile whose normals have been computed. `rays` are runs of samples: how many, and in
    /// which (unit) direction.
    pub fn color(&self, rays: &[(u32, [f32; 3])], worker: &mut SdfWorker) {
        let (rows, stride) = (worker.sdf.len(), self.color_stride());
        let (features, directions) = (self.options.features, self.directions);
        let (in_stride, out_stride) = (self.stride(), self.geometry.mlp().out_stride());
        worker.color_in.resize(rows * stride, 0.0);
        let mut encoded = vec![0.0; directions];
        let mut row = 0;
        for (count, direction) in rays {
            match self.options.direction {
                DirectionEncoding::Harmonics => encoded.copy_from_slice(&spherical_harmonics(*direction)),
                DirectionEncoding::Frequencies(octaves) => {
                    Frequencies(octaves).forward(&[*direction], &mut encoded, directions, 0);
                }
            }
            for _ in 0..*count {
                let to = &mut worker.color_in[row * stride..(row + 1) * stride];
                to[..3].copy_from_slice(&worker.encoded[row * in_stride..row * in_stride + 3]);
                to[3..6].copy_from_slice(&worker.normals[row]);
                to[6..6 + directions].copy_from_slice(&encoded);
                to[6 + directions..][..features]
                    .copy_from_slice(&worker.geometry.out[row * out_stride + 1..][..features]);
                row += 1;
            }
        }
        debug_assert_eq!(row, rows);
        let color = self.color.mlp();
        color.forward(self.color.weights().parameters, &worker.color_in, stride, rows, &mut worker.color);
        sigmoid_all(&mut worker.color.out);
        worker.rgb.clear();
        worker.rgb.extend(worker.color.out.chunks_exact(color.out_stride()).map(|o| [o[0], o[1], o[2]]));
    }

    /// Sends `d_sdf`, `d_normals` and `d_rgb` back: gathers the networks' gradients and what the grid will scatter.
    pub fn backward(&self, worker: &mut SdfWorker) {
        let (rows, stride) = (worker.sdf.len(), self.stride());
        let out_stride = self.geometry.mlp().out_stride();
        worker.geometry_grads.resize(self.geometry.mlp().buffer_len(), 0.0);
        worker.color_grads.resize(self.color.mlp().buffer_len(), 0.0);
        worker.d_out.clear();
        if worker.d_rgb.is_empty() {
            worker.d_out.resize(rows * out_stride, 0.0);
        } else {
            self.color_backward(rows, out_stride, worker);
        }
        for (to, d) in worker.d_out.chunks_exact_mut(out_stride).zip(&worker.d_sdf) {
            to[0] = *d;
        }
        worker.d_gradient.clear();
        worker.d_gradient.resize(rows * stride, 0.0);
        match &self.grid {
            Some(grid) => {
                // Everything about the grid is in its own unit cube, half as long as the ball's.
                let halves: Vec<[f32; 3]> = worker.d_normals.iter().map(|n| n.map(|c| 0.5 * c)).collect();
                let table = &self.table.values;
                grid.tangent(table, &worker.units, self.active_levels, &halves, &mut worker.d_gradient, stride, 3);
                for (row, n) in worker.d_gradient.chunks_exact_mut(stride).zip(&worker.d_normals) {
                    row[..3].copy_from_slice(n);
                }
                worker.gathered.d_normals.extend(halves);
            }
            None => {
                self.frequencies.tangent(&worker.encoded, &worker.d_normals, &mut worker.d_gradient, stride, 0);
            }
        }
        let weights = self.geometry.weights();
        self.geometry.mlp().backward(
            &weights,
            &worker.encoded,
            stride,
            &mut worker.geometry,
            &worker.d_out,
            Some(&worker.d_gradient),
            &mut worker.geometry_grads,
            true,
        );
        if self.grid.is_some() {
            worker.gathered.units.extend_from_slice(&worker.units);
            worker.gathered.d_features.extend_from_slice(&worker.geometry.d_input[..rows * stride]);
            worker.gathered.gradient.extend_from_slice(&worker.geometry.gradient[..rows * stride]);
        }
    }

    /// After [`Self::backward`]: the derivatives with respect to the tile's positions and to the directions of its rays,
    /// in `worker.d_positions` and `worker.d_directions`. With `dn` the whole derivative on the normals, a position hears
    /// through the encoding, `J^T de`, through the normal's own dependence on it, and from the colour network.
    pub fn ray_gradients(&self, rays: &[(u32, [f32; 3])], worker: &mut SdfWorker) {
        let (rows, stride) = (worker.sdf.len(), self.stride());
        let mut to = vec![[0.0; 3]; rows];
        let (d_input, gradient) = (&worker.geometry.d_input, &worker.geometry.gradient);
        match &self.grid {
            Some(grid) => {
                let (table, levels) = (&self.table.values, self.active_levels);
                let halves: Vec<[f32; 3]> = worker.d_normals.iter().map(|n| n.map(|c| 0.5 * c)).collect();
                grid.input_gradient(table, &worker.units, levels, d_input, stride, 3, &mut to);
                grid.second_gradient(table, &worker.units, levels, gradient, &halves, stride, 3, &mut to);
                for (to, row) in to.iter_mut().zip(d_input.chunks_exact(stride)) {
                    *to = std::array::from_fn(|d| 0.5 * to[d] + row[d]);
                }
            }
            None => {
                self.frequencies.input_gradient(&worker.encoded, d_input, stride, 0, &mut to);
                self.frequencies.second_gradient(&worker.encoded, gradient, &worker.d_normals, stride, 0, &mut to);
            }
        }
        worker.d_directions.clear();
        let mut color = worker.color.d_input.chunks_exact(self.color.mlp().in_stride()).zip(&mut to);
        let mut encoded = vec![0.0; self.directions];
        for (count, direction) in rays {
            let mut d = [[0.0; 3]];
            if let DirectionEncoding::Frequencies(octaves) = self.options.direction {
                Frequencies(octaves).forward(&[*direction], &mut encoded, self.directions, 0);
            }
            for (row, to) in color.by_ref().take(*count as usize) {
                for i in 0..3 {
                    to[i] += row[i];
                }
                let g = &row[6..6 + self.directions];
                match self.options.direction {
                    DirectionEncoding::Harmonics => harmonics_gradient(*direction, g, &mut d[0]),
                    DirectionEncoding::Frequencies(octaves) => {
                        Frequencies(octaves).input_gradient(&encoded, g, self.directions, 0, &mut d);
                    }
                }
            }
            worker.d_directions.push(d[0]);
        }
        worker.d_positions = to;
    }

    /// The colour network's part: fills the features' columns of `d_out` and adds to `d_normals`.
    fn color_backward(&self, rows: usize, out_stride: usize, worker: &mut SdfWorker) {
        let stride = self.color.mlp().out_stride();
        worker.d_out.resize(rows * stride, 0.0);
        for ((to, d), c) in worker.d_out.chunks_exact_mut(stride).zip(&worker.d_rgb).zip(&worker.rgb) {
            for i in 0..3 {
                to[i] = d[i] * c[i] * (1.0 - c[i]);
            }
        }
        let weights = self.color.weights();
        self.color.mlp().backward(
            &weights,
            &worker.color_in,
            self.color_stride(),
            &mut worker.color,
            &worker.d_out,
            None,
            &mut worker.color_grads,
            true,
        );
        worker.d_out.clear();
        worker.d_out.resize(rows * out_stride, 0.0);
        let from = worker.color.d_input.chunks_exact(self.color.mlp().in_stride());
        for ((to, n), from) in worker.d_out.chunks_exact_mut(out_stride).zip(&mut worker.d_normals).zip(from) {
            for d in 0..3 {
                n[d] += from[3 + d];
            }
            let features = &from[6 + self.directions..][..self.options.features];
            to[1..1 + features.len()].copy_from_slice(features);
        }
    }

    /// Adds everything that the workers gathered to the parameters' gradients, in the workers' order, and clears it.
    pub fn collect<'a>(&mut self, workers: impl Iterator<Item = &'a mut SdfWorker>) {
        let workers: Vec<&mut SdfWorker> = workers.collect();
        let stride = self.stride();
        if let Some(grid) = &self.grid {
            let batches: Vec<Scatter<'_>> = workers
                .iter()
                .map(|w| Scatter {
                    positions: &w.gathered.units,
                    d_features: &w.gathered.d_features,
                    gradient: Some((&w.gathered.gradient, &w.gathered.d_normals)),
                    stride,
                    first: 3,
                })
                .collect();
            grid.scatter(&batches, self.active_levels, &mut self.table.grads);
        }
        let (mut geometry, mut color) =
            (vec![0.0; self.geometry.mlp().buffer_len()], vec![0.0; self.color.mlp().buffer_len()]);
        for worker in workers {
            add(&mut geometry, &worker.geometry_grads);
            add(&mut color, &worker.color_grads);
            worker.geometry_grads.fill(0.0);
            worker.color_grads.fill(0.0);
            worker.gathered.units.clear();
            worker.gathered.d_features.clear();
            worker.gathered.gradient.clear();
            worker.gathered.d_normals.clear();
        }
        self.geometry.add_gradient(&geometry);
        self.color.add_gradient(&color);
    }

    /// One Adam step, number `t` from 1.
    pub fn step(&mut self, options: &AdamOptions, table_lr: f32, network_lr: f32, t: u64) {
        self.table.step(&AdamOptions { skip_untouched: true, ..*options }, table_lr, t);
        self.geometry.step(options, network_lr, t);
        self.color.step(options, network_lr, t);
    }

    /// All buffers that a checkpoint holds; call [`SdfField::refresh`] after reading them.
    pub fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
        let mut all = vec![&mut self.table.values, &mut self.table.m, &mut self.table.v];
        all.extend(self.geometry.buffers());
        all.extend(self.color.buffers());
        all
    }

    /// Lengths of the buffers.
    pub fn lengths(&self) -> Vec<usize> {
        let mut all = vec![self.table.grads.len(); 3];
        all.extend(self.geometry.lengths());
        all.extend(self.color.lengths());
        all
    }

    /// Bytes that a step keeps of each sample until its scatter.
    pub fn bytes_per_sample(&self) -> usize {
        8 * self.stride() + 24
    }

    /// Works out what follows from the parameters.
    pub fn refresh(&mut self) {
        self.geometry.refresh();
        self.color.refresh();
    }

    /// Whether every parameter is a finite number.
    pub fn is_finite(&self) -> bool {
        self.table.is_finite() && self.geometry.is_finite() && self.color.is_finite()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn the_papers_networks_have_the_papers_sizes() {
        // PyTorch's count with weight normalisation: weights, biases, and a length for each output.
        let count = |layers: &[(usize, usize)]| layers.iter().map(|(i, o)| i * o + 2 * o).sum::<usize>();
        let wide = (256, 256);
        let sdf = [(39, 256), wide, wide, (256, 217), wide, wide, wide, wide, (256, 257)];
        let color = [(289, 256), wide, wide, wide, (256, 3)];
        let field = SdfField::new(SdfFieldOptions::paper(), &mut mb_job::rng(0, 0));
        assert_eq!(field.parameter_count(), count(&sdf) + count(&color));
    }

    /// The whole chain with a loss on distance, normal and colour, by finite differences of the parameters.
    #[test]
    fn derivatives_through_normals_agree_with_finite_differences() {
        let hash = HashGridOptions { levels: 2, features: 2, log2_entries: 7, coarsest: 2, finest: 4 };
        for (position, weight_norm) in [(PositionEncoding::Hash(hash), false), (PositionEncoding::Frequencies(2), true)]
        {
            let mut rng = mb_job::rng(11, 0);
            let options = SdfFieldOptions {
                position,
                direction: DirectionEncoding::Frequencies(1),
                width: 24,
                hidden: 2,
                skip: Some(1),
                features: 5,
                softplus: 4.0,
                color_width: 12,
                color_hidden: 1,
                weight_norm,
                initial_radius: 0.5,
            };
            let mut field = SdfField::new(options, &mut rng);
            for buffer in field.buffers().into_iter().step_by(3) {
                buffer.iter_mut().filter(|v| **v != 0.0).for_each(|v| *v += rng.random_range(-0.3..0.3));
            }
            field.refresh();
            let positions: Vec<[f32; 3]> =
                (0..5).map(|_| std::array::from_fn(|_| rng.random_range(-0.7..0.7f32))).collect();
            let rays = [(3u32, [0.0, 0.6, 0.8]), (2, [0.0, -1.0, 0.0])];
            let mut threes =
                || (0..5).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0f32))).collect::<Vec<[f32; 3]>>();
            let (d_normals, d_rgb, more) = (threes(), threes(), threes());
            let d_sdf: Vec<f32> = more.iter().map(|v| v[0]).collect();
            let forward = |field: &SdfField, positions: &[[f32; 3]], rays: &[(u32, [f32; 3])]| {
                let mut w = SdfWorker::default();
                field.distance(positions, &mut w);
                field.normals(&mut w);
                field.color(rays, &mut w);
                w
            };
            let loss_at = |field: &SdfField, positions: &[[f32; 3]], rays: &[(u32, [f32; 3])]| {
                let w = forward(field, positions, rays);
                let dot = |a: &[[f32; 3]], b: &[[f32; 3]]| {
                    a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>()
                };
                let sdf: f64 = w.sdf.iter().zip(&d_sdf).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum();
                sdf + dot(&w.normals, &d_normals) + dot(&w.rgb, &d_rgb)
            };
            let loss = |field: &SdfField| loss_at(field, &positions, &rays);
            let mut worker = forward(&field, &positions, &rays);
            // The normal is the gradient of the distance.
            for (s, p) in positions.iter().enumerate() {
                for d in 0..3 {
                    let at = |h: f32| {
                        let (mut w, mut p) = (SdfWorker::default(), *p);
                        p[d] += h;
                        field.distance(&[p], &mut w);
                        f64::from(w.sdf[0])
                    };
                    let expected = (at(1e-3) - at(-1e-3)) / 2e-3;
                    assert!(
                        (f64::from(worker.normals[s][d]) - expected).abs() < 5e-3,
                        "{} is not {expected}",
                        worker.normals[s][d]
                    );
                }
            }
            (worker.d_sdf, worker.d_normals, worker.d_rgb) = (d_sdf.clone(), d_normals.clone(), d_rgb.clone());
            field.backward(&mut worker);
            field.ray_gradients(&rays, &mut worker);
            for (s, d) in [(0, 1), (1, 0), (3, 2), (4, 0)] {
                let at = |h: f32| {
                    let mut positions = positions.clone();
                    positions[s][d] += h;
                    loss_at(&field, &positions, &rays)
                };
                let (found, expected) = (f64::from(worker.d_positions[s][d]), (at(1e-3) - at(-1e-3)) / 2e-3);
                assert!(
                    (found - expected).abs() < 0.02 * expected.abs().max(0.5),
                    "position: {found} is not {expected}"
                );
                let at = |h: f32| {
                    let mut rays = rays;
                    rays[s / 3].1[d] += h;
                    loss_at(&field, &positions, &rays)
                };
                let (found, expected) = (f64::from(worker.d_directions[s / 3][d]), (at(1e-2) - at(-1e-2)) / 2e-2);
                assert!(
                    (found - expected).abs() < 0.02 * expected.abs().max(0.5),
                    "direction: {found} is not {expected}"
                );
            }
            field.collect(std::iter::once(&mut worker));
            // One step of plain descent along each buffer must change the loss as the derivative says.
            let before = field.clone();
            let grads: Vec<Vec<f32>> = {
                let mut probe = field.clone();
                // Adam with t = 1, beta1 = 0 and a huge epsilon is descent with the gradient scaled by 1 / epsilon.
                let options = AdamOptions { beta1: 0.0, beta2: 0.0, epsilon: 1e6, skip_untouched: false };
                probe.step(&options, 1e6, 1e6, 1);
                let mut start = before.clone();
                let start: Vec<Vec<f32>> = start.buffers().into_iter().step_by(3).map(|b| b.clone()).collect();
                probe
                    .buffers()
                    .into_iter()
                    .step_by(3)
                    .zip(start)
                    .map(|(a, b)| a.iter().zip(&b).map(|(a, b)| b - a).collect())
                    .collect()
            };
            for (b, grad) in grads.iter().enumerate() {
                let largest = grad.iter().fold(0.0f32, |a, g| a.max(g.abs()));
                let (mut misses, mut checked) = (0, 0);
                for i in (0..grad.len()).step_by(grad.len() / 60 + 1) {
                    let at = |h: f32| {
                        let mut field = before.clone();
                        field.buffers()[3 * b][i] += h;
                        field.refresh();
                        loss(&field)
                    };
                    let expected = (at(4e-3) - at(-4e-3)) / 8e-3;
                    checked += 1;
                    misses += usize::from((f64::from(grad[i]) - expected).abs() > f64::from(0.02 * largest).max(2e-3));
                }
                assert!(misses * 20 <= checked, "buffer {b}, weight_norm {weight_norm}: {misses} of {checked} wrong");
            }
        }
    }
}
