//! Every kernel beside its twin on the processor, on whatever device this machine has (in continuous integration a
//! software one).

mod cameras;
mod training;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
use mb_image::Image;
use mb_job::{Rng, rng};
use mb_neural::adam::{AdamOptions, Parameters};
use mb_neural::cameras::{CameraOptions, CameraResiduals};
use mb_neural::composite::{CompositeGradient, composite, composite_backward, distortion, opacity};
use mb_neural::contraction::contract;
use mb_neural::dataset::{RayDataset, TargetRay};
use mb_neural::dense_grid::DenseGrid;
use mb_neural::dvgo::{Dvgo, DvgoOptions, FAR, StageOptions, UnitBox};
use mb_neural::encoding::Frequencies;
use mb_neural::frequency_field::{DensityActivation, FrequencyField, FrequencyFieldOptions, FrequencyWorker};
use mb_neural::hash_grid::{HashGrid, HashGridOptions, Scatter};
use mb_neural::mlp::{Activation, Mlp, MlpCache, MlpShape, Skip, Weights};
use mb_neural::nerf::{DARK, Nerf, NerfOptions};
use mb_neural::radiance_field::{ADAM, RadianceField, RadianceFieldOptions, RadianceWorker};
use mb_neural::ray_samples::RaySamples;
use mb_neural::sampling::importance;
use mb_neural::voxel_field::ColorNetworkOptions;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use rand::RngExt as _;

use crate::context::{Context, WORKGROUP};
use crate::encoding::{Encoding, Points, unit_of};
use crate::frequencies::{self, Columns, encode_directions, encode_positions};
use crate::frequency_field::FrequencyNetworks;
use crate::kernels::Kernels;
use crate::network::Network;
use crate::radiance::Radiance;
use crate::rays::{RAY, Rays, Samples, Space, occupied, pack, starts};
use crate::trained::{AdamStep, Trained};

/// The device, one test at a time: software devices use every core.
fn device() -> Option<(Arc<Context>, MutexGuard<'static, ()>)> {
    static ONE: Mutex<()> = Mutex::new(());
    let guard = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    match Context::numbered(None) {
        Ok(context) => Some((Arc::new(context), guard)),
        Err(e) => {
            mb_testdata::absent("Vulkan device", &format!("{e}; Debian: apt-get install mesa-vulkan-drivers"));
            None
        }
    }
}

fn numbers(rng: &mut Rng, n: usize, size: f32) -> Vec<f32> {
    (0..n).map(|_| rng.random_range(-size..size)).collect()
}

fn points(rng: &mut Rng, n: usize) -> Vec<[f32; 3]> {
    (0..n).map(|_| std::array::from_fn(|_| rng.random())).collect()
}

/// All numbers agree to `tolerance` of the largest one.
fn agree(what: &str, found: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let largest = expected.iter().fold(0.0f32, |a, v| a.max(v.abs()));
    for (i, (found, expected)) in found.iter().zip(expected).enumerate() {
        assert!((found - expected).abs() <= tolerance * largest, "{what} {i}: {found} is not {expected} of {largest}");
    }
}

fn adam(lr: f32, t: u64) -> AdamStep {
    AdamStep { options: ADAM, lr, t }
}

#[test]
fn the_encoding_and_its_scatter_agree_with_their_twins() {
    let Some((context, _guard)) = device() else { return };
    for features in [1, 2, 4, 8] {
        let grid = HashGrid::new(HashGridOptions { levels: 3, features, log2_entries: 9, coarsest: 5, finest: 40 });
        let mut rng = rng(features as u64, 0);
        let table = Parameters::new(numbers(&mut rng, grid.len(), 1.0));
        // Many in one place: their shares meet in the same entries.
        let mut x = points(&mut rng, 700);
        x.extend([[0.5, 0.5, 0.5]; 50]);
        x.extend([[0.0; 3], [1.0; 3], [-0.5, 0.5, 2.0]]);
        let (n, stride) = (x.len(), grid.width().next_multiple_of(8));
        let d = numbers(&mut rng, n * stride, 1.0);
        let (mut expected, mut grads) = (vec![0.0; n * stride], vec![0.0; grid.len()]);
        grid.forward(&table.values, &x, 3, &mut expected, stride, 0);
        let batch = Scatter { positions: &x, d_features: &d, gradient: None, stride, first: 0 };
        grid.scatter(&[batch], 3, &mut grads);

        let (k, encoding) = (Kernels::new(&context), Encoding::new(&context, &grid, &table, 0));
        let (positions, out, d) = (context.upload(x.as_flattened()), context.zeros(n * stride), context.upload(&d));
        let mut words = Vec::new();
        let unit = unit_of(1.0);
        for _ in 0..2 {
            let mut work = context.work();
            work.clear(&encoding.sums);
            encoding.forward(&mut work, &k, Points { positions: &positions, count: n }, &out);
            encoding.scatter(&mut work, &k, Points { positions: &positions, count: n }, &d, unit);
            work.submit();
            words.push(context.read::<[u32; 2]>(&encoding.sums, grid.len()).expect("sums"));
        }
        agree("features", &context.read(&out, n * stride).expect("features"), &expected, 1e-6);
        let real = |w: &[u32; 2]| ((i64::from(w[1] as i32) << 32) + i64::from(w[0])) as f32 * unit;
        agree("table", &words[0].iter().map(real).collect::<Vec<_>>(), &grads, 1e-5);
        assert_eq!(words[0], words[1], "a sum of whole numbers does not depend on the order");
    }
}

#[test]
fn voxels_and_their_scatter_agree_with_their_twins() {
    let Some((context, _guard)) = device() else { return };
    let k = Kernels::new(&context);
    for (channels, stride) in [(1, 1), (3, 8), (5, 24), (12, 12), (16, 40)] {
        let grid = DenseGrid { size: [6, 4, 9], channels };
        let mut rng = rng(channels as u64, 5);
        let mut twin = Parameters::new(numbers(&mut rng, grid.len(), 1.0));
        let mut x = points(&mut rng, 300);
        x.extend([[0.5; 3]; 50]);
        x.extend([[0.0; 3], [1.0; 3], [-0.5, 0.5, 2.0]]);
        let n = x.len();
        let d = numbers(&mut rng, n * stride, 1.0);
        let mut expected = vec![0.0; n * stride];
        grid.forward(&twin.values, &x, &mut expected, stride, 0);
        grid.scatter(&[(&x, &d)], stride, 0, &mut twin.grads);
        let scales: Vec<f32> = (0..grid.len() / channels).map(|_| rng.random()).collect();

        let encoding = Encoding::of_voxels(&context, &grid, &twin, stride);
        let [positions, d, factors] = [x.as_flattened(), &d, &scales].map(|content| context.upload(content));
        let (out, unit) = (context.zeros(n * stride), unit_of(1.0));
        let points = Points { positions: &positions, count: n };
        let mut work = context.work();
        encoding.forward(&mut work, &k, points, &out);
        encoding.scatter(&mut work, &k, points, &d, unit);
        encoding.step_scaled(&mut work, &k, unit, &adam(0.1, 1), &factors);
        work.submit();
        agree("values", &context.read(&out, n * stride).expect("values"), &expected, 1e-6);
        let mut found = twin.clone();
        encoding.table.fetch(&context, &mut found).expect("parameters");
        // The first moment after one step is a tenth of the gradient.
        agree("table", &found.m.iter().map(|m| 10.0 * m).collect::<Vec<_>>(), &twin.grads, 1e-5);
        let before = twin.values.clone();
        let options = AdamOptions { skip_untouched: true, ..ADAM };
        twin.step_scaled(&options, 0.1, 1, Some((scales.as_slice(), channels)));
        let moved = |now: &[f32]| now.iter().zip(&before).map(|(now, before)| now - before).collect::<Vec<_>>();
        agree("scaled steps", &moved(&found.values), &moved(&twin.values), 1e-4);
    }
}

#[test]
fn frequencies_agree_with_their_twins() {
    let Some((context, _guard)) = device() else { return };
    let (k, n, stride) = (Kernels::new(&context), 90, 96);
    let mut rng = rng(6, 0);
    let direction: Vec<[f32; 3]> = points(&mut rng, 30).iter().map(|p| p.map(|c| 2.0 * c - 1.0)).collect();
    let mut packed = vec![[0.0; RAY]; 30];
    packed.iter_mut().zip(&direction).for_each(|(ray, d)| ray[3..6].copy_from_slice(d));
    let mut s = Samples::new(&context);
    (s.len, s.ray_of) = (n, context.upload(&(0..n as u32).map(|i| i / 3).collect::<Vec<_>>()));
    let x: Vec<[f32; 4]> = (0..n).map(|_| std::array::from_fn(|_| rng.random_range(-2.0..2.0f32))).collect();
    let mut expected = vec![0.0; n * stride];
    // Ten octaves of four coordinates, as NeRF++ has them.
    Frequencies(10).forward(&x.iter().map(|p| p.map(|c| c - 0.5)).collect::<Vec<_>>(), &mut expected, stride, 0);
    let rays = context.upload(packed.as_flattened());
    let (positions, out) = (context.upload(x.as_flattened()), context.zeros(n * stride));
    let columns = Columns { to: &out, stride, first: 0 };
    let read = |what: &str, expected: &[f32]| {
        agree(what, &context.read(&out, n * stride).expect("frequencies"), expected, 1e-4);
    };
    let mut work = context.work();
    encode_positions(
        &mut work,
        &k,
        Frequencies(10),
        (Points { positions: &positions, count: n }, 4),
        [1.0, -0.5],
        columns,
    );
    work.submit();
    read("positions", &expected);
    // Of three coordinates: J^T g and J v.
    let x: Vec<[f32; 3]> = points(&mut rng, n);
    let (g, v) = (numbers(&mut rng, n * stride, 1.0), points(&mut rng, n));
    let (mut encoded, mut normals, mut tangents) = (vec![0.0; n * stride], vec![[0.0; 3]; n], vec![0.0; n * stride]);
    Frequencies(6).forward(&x, &mut encoded, stride, 0);
    Frequencies(6).input_gradient(&encoded, &g, stride, 0, &mut normals);
    Frequencies(6).tangent(&encoded, &v, &mut tangents, stride, 0);
    let [encoded, g, v] = [&encoded, &g, &v.concat()].map(|content| context.upload(content));
    let (found_normals, found_tangents) = (context.zeros(3 * n), context.zeros(n * stride));
    let of = Columns { to: &encoded, ..columns };
    let mut work = context.work();
    frequencies::normals(&mut work, &k, Frequencies(6), (n, 3), of, [&g, &found_normals]);
    frequencies::tangent(&mut work, &k, Frequencies(6), n, of, [&v, &found_tangents]);
    work.submit();
    agree("normals", &context.read(&found_normals, 3 * n).expect("read"), normals.as_flattened(), 1e-5);
    agree("tangents", &context.read(&found_tangents, n * stride).expect("read"), &tangents, 1e-5);
    let directions: Vec<[f32; 3]> = (0..n).map(|i| direction[i / 3]).collect();
    Frequencies(4).forward(&directions, &mut expected, stride, 60);
    let mut work = context.work();
    encode_directions(&mut work, &k, Frequencies(4), (&rays, &s), Columns { first: 60, ..columns });
    work.submit();
    read("directions", &expected);
}

#[test]
fn importance_sampling_agrees_with_its_twin() {
    let Some((context, _guard)) = device() else { return };
    let (k, mut rng) = (Kernels::new(&context), rng(8, 0));
    let (count, coarse, fine) = (70, 9, 13);
    for inside_ball in [true, false] {
        let mut packed = vec![[0.0; RAY]; count];
        for ray in &mut packed {
            ray[..6].iter_mut().for_each(|v| *v = rng.random_range(-1.0..1.0f32));
            ray[15] = 4.0;
        }
        let mut depths = numbers(&mut rng, count * coarse, 1.0);
        depths.iter_mut().enumerate().for_each(|(i, t)| *t = 0.4 * ((i % coarse) as f32 + 1.0 + 0.5 * *t));
        let weights: Vec<f32> = (0..count * coarse).map(|_| rng.random_range(0.0f32..1.0).powi(4)).collect();
        // The twin draws the same numbers again.
        let mut again = rng.clone();
        let random: Vec<f32> = (0..count * fine).map(|_| rng.random()).collect();
        let [rays, uploaded, weight, random] =
            [packed.as_flattened(), &depths, &weights, &random].map(|content| context.upload(content));
        let (mut first, mut all) = (Samples::new(&context), Samples::new(&context));
        (first.len, all.len) = (count * coarse, count * (coarse + fine));
        let lens = [first.len, all.len];
        [&mut first, &mut all].into_iter().zip(lens).for_each(|(s, n)| s.reserve(&context, n));
        let sizes = [count, coarse, fine, usize::from(inside_ball)].map(|n| n as u32);
        let mut work = context.work();
        let placed = [(1, &rays), (2, &uploaded), (5, &first.positions), (6, &first.steps), (7, &first.ray_of)];
        work.run(&k.place_samples, &sizes, &placed, count);
        let drawn = [
            (1, &rays),
            (2, &random),
            (3, &first.steps),
            (4, &weight),
            (5, &all.positions),
            (6, &all.steps),
            (7, &all.ray_of),
        ];
        work.run(&k.draw_samples, &sizes, &drawn, count);
        work.submit();
        let found: Vec<[f32; 2]> = context.read(&all.steps, all.len).expect("steps");
        let positions: Vec<[f32; 3]> = context.read(&all.positions, all.len).expect("positions");
        let ray_of: Vec<u32> = context.read(&all.ray_of, all.len).expect("rays");
        for (i, ray) in packed.iter().enumerate() {
            let own = &depths[i * coarse..(i + 1) * coarse];
            let middles: Vec<f32> = own.windows(2).map(|w| 0.5 * (w[0] + w[1])).collect();
            let mut expected = Vec::new();
            importance(&middles, &weights[i * coarse + 1..(i + 1) * coarse - 1], fine, Some(&mut again), &mut expected);
            expected.extend_from_slice(own);
            expected.sort_by(f32::total_cmp);
            for (j, t) in expected.iter().enumerate() {
                let at = i * (coarse + fine) + j;
                let end = expected.get(j + 1).copied().unwrap_or(4.0);
                agree("distance and length", &found[at], &[*t, end - t], 1e-4);
                let p: [f32; 3] = std::array::from_fn(|d| ray[d] + t * ray[3 + d]);
                let p = if inside_ball { p } else { contract(p).map(|c| 4.0 * c - 2.0) };
                agree("position", &positions[at], &p, 1e-4);
                assert_eq!(ray_of[at] as usize, i);
            }
        }
    }
}

fn check_frequencies<const D: usize>(context: &Context, activation: DensityActivation) {
    let options = FrequencyFieldOptions {
        position_octaves: 3,
        direction_octaves: 2,
        width: 24,
        hidden: 3,
        skip: 2,
        head_width: 16,
        activation,
    };
    let (field, mut rng, n) = (FrequencyField::<D>::new(&options), rng(D as u64, 3), 300);
    let mut p = field.init(&mut rng);
    let x: Vec<[f32; D]> = (0..n).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0f32))).collect();
    let directions: Vec<[f32; 3]> = points(&mut rng, 30);
    let runs: Vec<(u32, [f32; 3])> = directions.iter().map(|d| (10, *d)).collect();
    let mut worker = FrequencyWorker::default();
    field.density(&p, &x, &mut worker);
    field.color(&p, &runs, &mut worker);
    let (sigma, rgb) = (worker.sigma.clone(), worker.rgb.clone());
    // The kernels take derivatives by what the networks give.
    let slope = |sigma: f32| match activation {
        DensityActivation::Relu => f32::from(sigma > 0.0),
        DensityActivation::Softplus => 1.0 - (-sigma).exp(),
    };
    let (d_sigma, d_rgb) = (numbers(&mut rng, n, 1.0), numbers(&mut rng, 3 * n, 1.0));
    worker.d_sigma = d_sigma.clone();
    worker.d_rgb = d_rgb.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
    field.backward(&p, &field.transpose(&p), &mut worker);
    field.collect(&mut p, std::iter::once(&mut worker));

    let (k, mut gpu) = (Kernels::new(context), FrequencyNetworks::new(context, &field, &p));
    gpu.reserve(context, n);
    let mut packed = vec![[0.0; RAY]; 30];
    packed.iter_mut().zip(&directions).for_each(|(ray, d)| ray[3..6].copy_from_slice(d));
    let mut s = Samples::new(context);
    s.len = n;
    s.ray_of = context.upload(&(0..n as u32).map(|i| i / 10).collect::<Vec<_>>());
    s.positions = context.upload(x.as_flattened());
    let d_density: Vec<f32> = d_sigma.iter().zip(&sigma).map(|(d, sigma)| d * slope(*sigma)).collect();
    let d_color: Vec<f32> = (0..8 * n)
        .map(|i| {
            let (s, c) = (i / 8, i % 8);
            if c < 3 { d_rgb[3 * s + c] * rgb[s][c] * (1.0 - rgb[s][c]) } else { 0.0 }
        })
        .collect();
    (gpu.d_density, gpu.d_color) = (context.upload(&d_density), context.upload(&d_color));
    let rays = context.upload(packed.as_flattened());
    let mut work = context.work();
    gpu.forward(&mut work, &k, &rays, &s);
    gpu.backward(&mut work, &k, &s);
    gpu.step(&mut work, &k, &adam(0.0, 1));
    work.submit();
    agree("densities", &context.read(&gpu.sigma, n).expect("read"), &sigma, 1e-5);
    let out: Vec<f32> = context.read(gpu.color(), 8 * n).expect("read");
    let out: Vec<f32> =
        out.chunks_exact(8).flat_map(|o| [o[0], o[1], o[2]].map(|z| 1.0 / (1.0 + (-z).exp()))).collect();
    agree("colours", &out, rgb.as_flattened(), 1e-5);
    // The first moment after one step is a tenth of the gradient.
    let mut found = p.clone();
    gpu.fetch(context, &mut found).expect("parameters");
    for (found, expected) in [(&found.trunk, &p.trunk), (&found.head, &p.head)] {
        agree("derivatives", &found.m.iter().map(|m| 10.0 * m).collect::<Vec<_>>(), &expected.grads, 1e-4);
    }
}

#[test]
fn a_field_of_frequencies_agrees_with_its_twin() {
    let Some((context, _guard)) = device() else { return };
    check_frequencies::<3>(&context, DensityActivation::Relu);
    check_frequencies::<4>(&context, DensityActivation::Softplus);
}

#[test]
fn a_network_with_normalised_weights_agrees_with_its_twin() {
    let Some((context, _guard)) = device() else { return };
    let k = Kernels::new(&context);
    let mlp = Mlp::new(MlpShape {
        inputs: 5,
        width: 20,
        hidden: 3,
        outputs: 3,
        activation: Activation::Relu,
        skip: Some(Skip { layer: 2, narrow: true }),
    });
    let (mut rng, rows) = (rng(2, 8), 600);
    let start = mlp.init_uniform(&mut rng);
    let mut twin = mb_neural::network::Network::new(mlp.clone(), start, true);
    // Lengths that are not those of the directions.
    let [_, gains] = twin.parts_mut();
    gains.values.iter_mut().for_each(|g| *g *= rng.random_range(0.5..2.0));
    twin.refresh();
    let mut network = Network::of_twin(&context, &k, &twin, false);
    network.reserve(&context, rows);
    for t in 1..=3 {
        let x: Vec<f32> = (0..rows * 8).map(|i| if i % 8 < 5 { rng.random_range(-1.0..1.0) } else { 0.0 }).collect();
        let d_out: Vec<f32> =
            (0..rows * 8).map(|i| if i % 8 < 3 { rng.random_range(-1.0..1.0) } else { 0.0 }).collect();
        let (mut cache, mut grads) = (MlpCache::default(), vec![0.0; mlp.buffer_len()]);
        mlp.forward(twin.weights().parameters, &x, 8, rows, &mut cache);
        mlp.backward(&twin.weights(), &x, 8, &mut cache, &d_out, None, &mut grads, true);
        twin.add_gradient(&grads);
        twin.step(&ADAM, 0.01, t);
        let (x, d_out) = (context.upload(&x), context.upload(&d_out));
        let mut work = context.work();
        network.forward(&mut work, &k, &x, rows);
        network.backward(&mut work, &k, &x, &d_out, rows);
        network.step(&mut work, &k, &adam(0.01, t));
        work.submit();
        agree("outputs", &context.read(network.out(), rows * 8).expect("outputs"), &cache.out, 1e-4);
    }
    let mut found = twin.clone();
    network.fetch(&context, &mut found).expect("parameters");
    for (found, expected) in [(found.direct(), twin.direct()), (found.gains(), twin.gains())] {
        agree("first moment", &found.m, &expected.m, 1e-4);
        agree("second moment", &found.v, &expected.v, 1e-4);
        agree("parameters", &found.values, &expected.values, 1e-3);
    }
}

#[test]
fn sums_of_a_table_hold_more_than_a_word() {
    let Some((context, _guard)) = device() else { return };
    // One level of one feature: every share goes to the same eight corners, an eighth each.
    let grid = HashGrid::new(HashGridOptions { levels: 1, features: 1, log2_entries: 9, coarsest: 1, finest: 1 });
    let k = Kernels::new(&context);
    let n = 3000;
    let positions = context.upload(&vec![0.5f32; 3 * n]);
    for share in [200.0f32, -200.0, 3.0e5, -3.0e5] {
        let encoding = Encoding::new(&context, &grid, &Parameters::new(vec![0.0; 8]), 0);
        let d: Vec<f32> = (0..8 * n).map(|i| if i % 8 == 0 { share } else { 0.0 }).collect();
        let mut work = context.work();
        encoding.scatter(&mut work, &k, Points { positions: &positions, count: n }, &context.upload(&d), unit_of(1.0));
        // The first moment after one step is a tenth of the gradient.
        encoding.step(&mut work, &k, unit_of(1.0), &adam(0.1, 1));
        work.submit();
        let m: Vec<f32> = context.read(&encoding.table.m, 8).expect("moments");
        agree("moments", &m, &[0.1 * share / 8.0 * n as f32; 8], 1e-6);
    }
}

#[test]
fn networks_and_their_derivatives_agree_with_their_twins() {
    let Some((context, _guard)) = device() else { return };
    let k = Kernels::new(&context);
    let skip = |layer, narrow| Some(Skip { layer, narrow });
    let softplus = Activation::Softplus { beta: 5.0 };
    for (inputs, width, hidden, outputs, activation, skip) in [
        (32, 64, 1, 16, Activation::Relu, None),
        (5, 24, 3, 3, Activation::Relu, None),
        (16, 32, 2, 40, softplus, None),
        (7, 24, 3, 9, Activation::Relu, skip(2, false)),
        (7, 24, 3, 9, softplus, skip(2, true)),
        (6, 20, 2, 3, softplus, skip(2, false)),
        (9, 32, 2, 5, Activation::Relu, skip(1, true)),
    ] {
        let shape = MlpShape { inputs, width, hidden, outputs, activation, skip };
        let mlp = Mlp::new(shape);
        let mut rng = rng(hidden as u64, 1);
        let mut parameters = Parameters::new(mlp.init_uniform(&mut rng));
        let rows = 700;
        let rows_of = |rng: &mut Rng, width: usize, stride: usize| {
            (0..rows * stride).map(|i| if i % stride < width { rng.random_range(-1.0..1.0) } else { 0.0 }).collect()
        };
        let x: Vec<f32> = rows_of(&mut rng, inputs, mlp.in_stride());
        let d_out: Vec<f32> = rows_of(&mut rng, outputs, mlp.out_stride());
        let (mut cache, transposed) = (MlpCache::default(), mlp.transpose(&parameters.values));
        mlp.forward(&parameters.values, &x, mlp.in_stride(), rows, &mut cache);
        let weights = Weights { parameters: &parameters.values, transposed: &transposed };
        let mut grads = vec![0.0; mlp.buffer_len()];
        mlp.backward(&weights, &x, mlp.in_stride(), &mut cache, &d_out, None, &mut grads, true);

        let mut network = Network::new(&context, &mlp, &parameters, false);
        network.reserve(&context, rows);
        let (x, d_out) = (context.upload(&x), context.upload(&d_out));
        let mut work = context.work();
        network.forward(&mut work, &k, &x, rows);
        network.backward(&mut work, &k, &x, &d_out, rows);
        network.step(&mut work, &k, &adam(0.01, 1));
        work.submit();
        let out: Vec<f32> = context.read(network.out(), rows * mlp.out_stride()).expect("outputs");
        agree("outputs", &out, &cache.out, 1e-5);
        let d_input: Vec<f32> = context.read(network.d_input(), rows * mlp.in_stride()).expect("derivatives");
        agree("derivative by the input", &d_input, &cache.d_input, 1e-5);
        // The first moment after one step is a tenth of the gradient.
        let m: Vec<f32> = context.read(&network.parameters.m, grads.len()).expect("moments");
        agree("derivative by the parameters", &m.iter().map(|m| 10.0 * m).collect::<Vec<_>>(), &grads, 1e-5);
        parameters.grads = grads;
        parameters.step(&ADAM, 0.01, 1);
        let mut found = parameters.clone();
        network.parameters.fetch(&context, &mut found).expect("parameters");
        agree("second moment", &found.v, &parameters.v, 1e-5);
        // The first step is the rate times the sign of a gradient, which may itself be rounding.
        let off = found.values.iter().zip(&parameters.values).filter(|(a, b)| (**a - **b).abs() > 1e-5).count();
        assert!(off * 100 < found.values.len(), "{off} parameters differ");
    }
}

#[test]
fn adam_agrees_with_its_twin_and_leaves_untouched_runs_alone() {
    let Some((context, _guard)) = device() else { return };
    let grid = HashGrid::new(HashGridOptions { levels: 1, features: 4, log2_entries: 9, coarsest: 5, finest: 5 });
    let mut rng = rng(3, 2);
    let mut twin = Parameters::new(numbers(&mut rng, grid.len(), 1.0));
    let (k, encoding) = (Kernels::new(&context), Encoding::new(&context, &grid, &twin, 0));
    let options = AdamOptions { skip_untouched: true, ..ADAM };
    for t in 1..=3 {
        // Samples in one corner: most runs are not touched.
        let x: Vec<[f32; 3]> = points(&mut rng, 40).into_iter().map(|p| p.map(|c| 0.3 * c)).collect();
        let d = numbers(&mut rng, 40 * 8, 1.0);
        let batch = Scatter { positions: &x, d_features: &d, gradient: None, stride: 8, first: 0 };
        grid.scatter(&[batch], 1, &mut twin.grads);
        twin.step(&options, 0.02, t);
        let mut work = context.work();
        let positions = context.upload(x.as_flattened());
        let points = Points { positions: &positions, count: 40 };
        encoding.scatter(&mut work, &k, points, &context.upload(&d), unit_of(1.0));
        encoding.step(&mut work, &k, unit_of(1.0), &adam(0.02, t));
        work.submit();
    }
    let mut found = twin.clone();
    encoding.table.fetch(&context, &mut found).expect("parameters");
    agree("parameters", &found.values, &twin.values, 1e-4);
    agree("first moment", &found.m, &twin.m, 1e-5);
    agree("second moment", &found.v, &twin.v, 1e-5);
    assert!(twin.v.iter().filter(|v| **v == 0.0).count() > grid.len() / 2);
    assert!(twin.v.iter().zip(&found.v).all(|(a, b)| (*a == 0.0) == (*b == 0.0)));
}

/// A ball before black, seen from all sides; colours follow position.
fn scene(with_masks: bool) -> RayDataset {
    let (size, intrinsics) = (ImageSize::new(48, 48), Intrinsics { fx: 66.0, fy: 66.0, cx: 23.5, cy: 23.5 });
    let center = Vector3::new(0.4, -0.2, 1.0);
    let images = (0..8)
        .map(|i| {
            let z = 1.0 - 2.0 * (f64::from(i) + 0.5) / 8.0;
            let (sin, cos) = (f64::from(i) * 2.399_963).sin_cos();
            let out = Vector3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z);
            let right = out.cross(&Vector3::new(0.1, 0.2, 1.0)).normalize();
            let rotation = Matrix3::from_columns(&[right, -out.cross(&right), -out]);
            let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
            let pose = Rigid3::<World, Camera>::from_parts(rotation, center + 0.4 * out);
            let hit = |x: usize, y: usize| {
                let ray = intrinsics.ray(&nalgebra::Point2::new(x as f64, y as f64), &pose);
                let (o, d) = (ray.origin.coords - center, ray.direction.normalize());
                let b = o.dot(&d);
                let root = b * b - o.norm_squared() + 0.06 * 0.06;
                (root > 0.0).then(|| o - (b + root.sqrt()) * d)
            };
            let rgb = Image::from_fn(size, |x, y| {
                let color = hit(x, y).map_or_else(Vector3::zeros, |p| {
                    Vector3::new(140.0, 180.0, 100.0).component_mul(&p).map(|v| 0.5 + 0.4 * v.sin())
                });
                color.map(|v| (v * 255.0).round() as u8).into()
            });
            let mask = with_masks.then(|| Image::from_fn(size, |x, y| if hit(x, y).is_some() { 255 } else { 0 }));
            (rgb, mask, intrinsics, pose)
        })
        .collect();
    RayDataset::from_images(images, 0).expect("8 good views")
}

fn small() -> NerfOptions {
    NerfOptions {
        samples_per_step: 1 << 12,
        field: RadianceFieldOptions {
            grid: HashGridOptions { levels: 4, features: 2, log2_entries: 12, coarsest: 8, finest: 64 },
            width: 16,
            color_hidden: 1,
        },
        near: 0.5,
        far: 6.0,
        step: 0.08,
        cone: 1.0 / 12.0,
        occupancy: 32,
        occupancy_every: 4,
        ..NerfOptions::default()
    }
    .with_iterations(24)
}

#[test]
fn marching_agrees_with_its_twin() {
    let Some((context, _guard)) = device() else { return };
    let data = scene(false);
    let cameras = CameraResiduals::new(&CameraOptions::default(), &data);
    let mut twin = Nerf::new(small(), &data);
    // Matter in a part of space only.
    let (cells, points) = twin.occupancy.points_of_turn(0, 0, true);
    let found: Vec<f32> = points.iter().map(|p| if p[0] + p[1] < 1.1 { 1.0 } else { 0.0 }).collect();
    twin.occupancy.remember(&cells, &found, 0.5);
    twin.occupancy.decide(0.5);
    let mut targets = Vec::new();
    data.draw(&mut rng(1, 0), 200, &cameras, &mut targets);
    let mut expected = RaySamples::<3>::default();
    let mut packed = Vec::new();
    for target in &targets {
        twin.march(&target.ray, 0.3, &mut expected);
        packed.push(pack(target, 0.3, [0.0; 3], target.rgb, twin.options.near));
    }
    let o = &twin.options;
    let space =
        Space { resolution: o.occupancy, far: o.far, step: o.step, cone: o.cone, inside_ball: false, voxels: None };
    let (rays, cells) = (context.upload(packed.as_flattened()), occupied(&context, &twin.occupancy));
    let rays = Rays { rays: &rays, count: packed.len(), occupied: &cells };
    agree_on_samples(&context, &space, rays, &expected);
}

#[test]
fn marching_through_voxels_agrees_with_its_twin() {
    let Some((context, _guard)) = device() else { return };
    for with_masks in [true, false] {
        let data = scene(with_masks);
        let cameras = CameraResiduals::new(&CameraOptions::default(), &data);
        let mut twin = Dvgo::new(DvgoOptions { step: 0.2, ..small_dvgo() }, &data);
        // Matter in a part of space, and voxels in a part of that.
        let cells = twin.free.resolution();
        twin.free.values.iter_mut().enumerate().for_each(|(i, v)| *v = if i % cells < 70 { 1.0 } else { 0.0 });
        twin.free.decide(0.5);
        (twin.bounds.low, twin.bounds.high) = ([0.2, 0.1, 0.3], [0.9, 0.8, 0.85]);
        let (mut targets, mut expected, mut packed) = (Vec::new(), RaySamples::<3>::default(), Vec::new());
        data.draw(&mut rng(1, 0), 200, &cameras, &mut targets);
        for target in &targets {
            twin.march(&target.ray, 0.3, &mut expected);
            let (near, far) = twin.range(&target.ray).unwrap_or((0.0, -1.0));
            let mut ray = pack(target, 0.3, [0.0; 3], target.rgb, near);
            [ray[14], ray[15]] = [near, far];
            packed.push(ray);
        }
        let space = Space {
            resolution: cells,
            far: FAR,
            step: twin.step_length(),
            cone: 0.0,
            inside_ball: with_masks,
            voxels: Some(twin.bounds),
        };
        let (rays, cells) = (context.upload(packed.as_flattened()), occupied(&context, &twin.free));
        let rays = Rays { rays: &rays, count: packed.len(), occupied: &cells };
        agree_on_samples(&context, &space, rays, &expected);
    }
}

/// Marches 200 rays, which have the twin's samples, but for a few.
fn agree_on_samples(context: &Context, space: &Space, rays: Rays<'_>, expected: &RaySamples<3>) {
    let mut samples = Samples::new(context);
    samples.march(context, &Kernels::new(context), space, rays).expect("samples");
    let begins: Vec<u32> = context.read(&samples.starts, rays.count + 1).expect("starts");
    let counts: Vec<u32> = begins.windows(2).map(|w| w[1] - w[0]).collect();
    let positions: Vec<[f32; 3]> = context.read(&samples.positions, samples.len).expect("positions");
    let steps: Vec<[f32; 2]> = context.read(&samples.steps, samples.len).expect("steps");
    // A sample at a cell's wall may fall on either side of it.
    let differ = counts.iter().zip(&expected.runs).filter(|(a, (b, _))| *a != b).count();
    assert!(differ <= 4, "{differ} of 200 rays have other samples");
    let mut compared = 0;
    for (ray, range) in expected.ranges().enumerate().filter(|(ray, range)| counts[*ray] as usize == range.len()) {
        for (i, j) in range.zip(begins[ray] as usize..) {
            agree("position", &positions[j], &expected.positions[i], 1e-4);
            agree("distance and length", &steps[j], &[expected.depths[i], expected.lengths[i]], 1e-4);
            compared += 1;
        }
    }
    assert!(compared > 1000, "{compared} samples");
}

#[test]
fn compositing_and_losses_agree_with_their_twins() {
    let Some((context, _guard)) = device() else { return };
    let k = Kernels::new(&context);
    let mut rng = rng(4, 0);
    let counts: Vec<u32> = (0..90).map(|i| (i * 37) % 200).collect();
    let begins = starts(&counts);
    let n = begins[90] as usize;
    let mut distances = Vec::new();
    for count in &counts {
        let mut t = 0.2;
        for _ in 0..*count {
            let dt = rng.random_range(0.01..0.1);
            distances.push([t, dt]);
            t += dt;
        }
    }
    // Every other ray is thin, and lit to its end; the others are dropped in their first samples.
    let thick = |ray: usize| if ray.is_multiple_of(2) { 1.0 } else { 0.04 };
    let sigma: Vec<f32> = counts
        .iter()
        .enumerate()
        .flat_map(|(ray, count)| std::iter::repeat_n(thick(ray), *count as usize))
        .map(|thick| thick * rng.random_range(0.0f32..4.0).powi(2))
        .collect();
    let color: Vec<f32> = (0..8 * n).map(|i| if i % 8 < 3 { rng.random_range(-2.0..2.0) } else { 0.0 }).collect();
    let packed: Vec<[f32; RAY]> = (0..90)
        .map(|_| {
            let mut ray = [0.0; RAY];
            ray[7..13].iter_mut().for_each(|v| *v = rng.random());
            ray
        })
        .collect();
    let (scale, weight) = (1.0 / 270.0, 0.05);

    let (mut squared, mut distorted) = (vec![0.0; 90], vec![0.0; 90]);
    let (mut d_density, mut d_color) = (vec![0.0; n], vec![0.0; 8 * n]);
    for ray in 0..90 {
        let first = begins[ray] as usize;
        let mut last = first;
        let mut light = 1.0;
        while last < begins[ray + 1] as usize && light >= DARK {
            light *= 1.0 - opacity(sigma[last], distances[last][1]);
            last += 1;
        }
        let range = first..last;
        let alphas: Vec<f32> = range.clone().map(|i| opacity(sigma[i], distances[i][1])).collect();
        let rgb: Vec<[f32; 3]> =
            range.clone().map(|i| std::array::from_fn(|c| 1.0 / (1.0 + (-color[8 * i + c]).exp()))).collect();
        let background = [packed[ray][10], packed[ray][11], packed[ray][12]];
        let (mut weights, mut d_alphas) = (vec![0.0; alphas.len()], vec![0.0; alphas.len()]);
        let mut d_rgb = vec![[0.0; 3]; alphas.len()];
        let pixel = composite(&alphas, &rgb, background, &mut weights);
        let error: [f32; 3] = std::array::from_fn(|c| pixel.rgb[c] - packed[ray][7 + c]);
        squared[ray] = error.iter().map(|e| e * e).sum();
        let places: Vec<f32> = range.clone().map(|i| distances[i][0] / (1.0 + distances[i][0])).collect();
        let lengths: Vec<f32> = range.clone().map(|i| distances[i][1] / (1.0 + distances[i][0]).powi(2)).collect();
        distorted[ray] = distortion(&weights, &places, &lengths, 3.0 * scale * weight, &mut d_alphas);
        let gradient = CompositeGradient { d_rgb: error.map(|e| 2.0 * scale * e), d_transmittance: 0.0 };
        composite_backward(&alphas, &rgb, background, &weights, &gradient, &mut d_alphas, &mut d_rgb);
        for (k, i) in range.enumerate() {
            d_density[i] = d_alphas[k] * distances[i][1] * (1.0 - alphas[k]) * sigma[i];
            (0..3).for_each(|c| d_color[8 * i + c] = d_rgb[k][c] * rgb[k][c] * (1.0 - rgb[k][c]));
        }
    }

    let [found_weights, found_density, found_color] = [1, 1, 8].map(|width| context.zeros(n * width));
    let losses = context.zeros(180);
    let [rays, steps, sigmas, colors] =
        [packed.as_flattened(), distances.as_flattened(), &sigma, &color].map(|content| context.upload(content));
    let begins = context.upload(&begins);
    let sizes = [90, scale.to_bits(), f32::to_bits(weight), DARK.to_bits(), 0];
    let buffers = [
        (1, &rays),
        (2, &begins),
        (3, &steps),
        (4, &sigmas),
        (5, &colors),
        (6, &found_weights),
        (7, &found_density),
        (8, &found_color),
        (9, &losses),
    ];
    let mut work = context.work();
    work.run(&k.losses, &sizes, &buffers, 90 * WORKGROUP);
    work.submit();
    let found: Vec<[f32; 2]> = context.read(&losses, 90).expect("losses");
    agree("squared errors", &found.iter().map(|l| l[0]).collect::<Vec<_>>(), &squared, 1e-5);
    agree("distortions", &found.iter().map(|l| l[1]).collect::<Vec<_>>(), &distorted, 1e-5);
    agree("derivative by density", &context.read(&found_density, n).expect("read"), &d_density, 1e-4);
    agree("derivative by colour", &context.read(&found_color, 8 * n).expect("read"), &d_color, 1e-5);
}

#[test]
fn the_whole_field_agrees_with_its_twin() {
    let Some((context, _guard)) = device() else { return };
    let mut options = small().field;
    options.width = 32;
    let field = RadianceField::new(&options);
    let mut rng = rng(5, 0);
    let mut p = field.init(&mut rng);
    p.table.values.iter_mut().for_each(|v| *v = rng.random_range(-1.0..1.0));
    let x = points(&mut rng, 300);
    let directions: Vec<[f32; 3]> = (0..30)
        .map(|_| {
            let v: [f32; 3] = std::array::from_fn(|_| rng.random_range(-1.0f32..1.0));
            let length = v.iter().map(|c| c * c).sum::<f32>().sqrt();
            v.map(|c| c / length)
        })
        .collect();
    let runs: Vec<(u32, [f32; 3])> = directions.iter().map(|d| (10, *d)).collect();
    let mut worker = RadianceWorker::default();
    field.density(&p, &x, &mut worker);
    field.color(&p, &runs, &mut worker);
    // The kernels take derivatives by what the networks give: d o_0 = sigma d sigma, d z = c (1 - c) d c.
    let (d_o, d_c) = (numbers(&mut rng, 300, 1.0), numbers(&mut rng, 900, 1.0));
    worker.d_sigma = d_o.iter().zip(&worker.sigma).map(|(d, sigma)| d / sigma).collect();
    worker.d_rgb = d_c.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
    let rgb = worker.rgb.clone();
    field.backward(&p, &field.transpose(&p), &x, &mut worker);
    let sigma = worker.sigma.clone();
    field.collect(&mut p, std::iter::once(&mut worker));

    let (k, n) = (Kernels::new(&context), 300);
    let mut gpu = Radiance::new(&context, &field, &p, 32);
    gpu.reserve(&context, n);
    let target = |direction: &[f32; 3]| TargetRay {
        ray: mb_neural::dataset::SceneRay { origin: [0.0; 3], direction: *direction },
        view: 0,
        pixel: [0.0; 2],
        rgb: [0.0; 3],
        mask: None,
    };
    let rays: Vec<[f32; RAY]> = directions.iter().map(|d| pack(&target(d), 0.0, [0.0; 3], [0.0; 3], 0.1)).collect();
    let rays = context.upload(rays.as_flattened());
    let mut s = Samples::new(&context);
    s.len = n;
    s.ray_of = context.upload(&(0..300u32).map(|i| i / 10).collect::<Vec<_>>());
    s.positions = context.upload(x.as_flattened());
    let d_color: Vec<f32> = (0..8 * n)
        .map(|i| {
            let (s, c) = (i / 8, i % 8);
            if c < 3 { d_c[3 * s + c] * rgb[s][c] * (1.0 - rgb[s][c]) } else { 0.0 }
        })
        .collect();
    (gpu.d_density, gpu.d_color) = (context.upload(&d_o), context.upload(&d_color));
    let mut work = context.work();
    gpu.forward(&mut work, &k, &rays, &s);
    gpu.backward(&mut work, &k, &s, unit_of(1.0));
    gpu.step(&mut work, &k, unit_of(1.0), 0.0, 1);
    work.submit();
    agree("densities", &context.read(&gpu.sigma, n).expect("read"), &sigma, 1e-5);
    let out: Vec<f32> = context.read(gpu.color.out(), 8 * n).expect("read");
    let out: Vec<f32> =
        out.chunks_exact(8).flat_map(|o| [o[0], o[1], o[2]].map(|z| 1.0 / (1.0 + (-z).exp()))).collect();
    agree("colours", &out, rgb.as_flattened(), 1e-5);
    // The first moment after one step is a tenth of the gradient.
    let tenfold = |t: &Trained| -> Vec<f32> {
        context.read::<f32>(&t.m, t.len).expect("read").iter().map(|m| 10.0 * m).collect()
    };
    agree("derivative by the table", &tenfold(&gpu.encoding.table), &p.table.grads, 1e-4);
    agree("density network", &tenfold(&gpu.density.parameters), &p.density.grads, 1e-4);
    agree("colour network", &tenfold(&gpu.color.parameters), &p.color.grads, 1e-4);
    let cells: std::collections::BTreeMap<u32, f32> = gpu.seen(&context).expect("read").into_iter().collect();
    assert!(!cells.is_empty() && cells.values().all(|v| sigma.contains(v) || *v > 0.0));
}

#[test]
fn a_network_whose_gradient_a_loss_uses_agrees_with_its_twin() {
    let Some((context, _guard)) = device() else { return };
    let k = Kernels::new(&context);
    let skip = |layer, narrow| Some(Skip { layer, narrow });
    for (inputs, width, hidden, outputs, skip) in [
        (19, 32, 1, 16, None),
        (35, 24, 3, 6, None),
        (15, 36, 3, 6, skip(2, true)),
        (7, 20, 3, 4, skip(1, false)),
        (7, 20, 2, 1, skip(2, true)),
    ] {
        let activation = Activation::Softplus { beta: 20.0 };
        let mlp = Mlp::new(MlpShape { inputs, width, hidden, outputs, activation, skip });
        let mut rng = rng(hidden as u64, 9);
        let parameters = Parameters::new(mlp.init_uniform(&mut rng));
        let rows = 600;
        let rows_of = |rng: &mut Rng, width: usize, stride: usize| -> Vec<f32> {
            (0..rows * stride).map(|i| if i % stride < width { rng.random_range(-1.0..1.0) } else { 0.0 }).collect()
        };
        let x = rows_of(&mut rng, inputs, mlp.in_stride());
        let d_out = rows_of(&mut rng, outputs, mlp.out_stride());
        let d_gradient = rows_of(&mut rng, inputs, mlp.in_stride());
        let (mut cache, transposed) = (MlpCache::default(), mlp.transpose(&parameters.values));
        let weights = Weights { parameters: &parameters.values, transposed: &transposed };
        let mut grads = vec![0.0; mlp.buffer_len()];
        mlp.forward(&parameters.values, &x, mlp.in_stride(), rows, &mut cache);
        mlp.gradient(&weights, &mut cache);
        let gradient = cache.gradient.clone();
        mlp.backward(&weights, &x, mlp.in_stride(), &mut cache, &d_out, Some(&d_gradient), &mut grads, true);

        let mut network = Network::new(&context, &mlp, &parameters, true);
        network.reserve(&context, rows);
        let [x, d_out, d_gradient] = [&x, &d_out, &d_gradient].map(|content| context.upload(content));
        let mut work = context.work();
        network.forward(&mut work, &k, &x, rows);
        network.gradient(&mut work, &k, &x, rows);
        network.double_backward(&mut work, &k, &x, [&d_out, &d_gradient], rows);
        network.step(&mut work, &k, &adam(0.0, 1));
        work.submit();
        let read = |buffer, n| -> Vec<f32> { context.read(buffer, n).expect("read") };
        agree("outputs", &read(network.out(), rows * mlp.out_stride()), &cache.out, 1e-5);
        agree("gradient", &read(&network.gradient, rows * mlp.in_stride()), &gradient, 1e-5);
        agree("derivative by the input", &read(network.d_input(), rows * mlp.in_stride()), &cache.d_input, 1e-4);
        let m: Vec<f32> = read(&network.parameters.m, grads.len()).iter().map(|m| 10.0 * m).collect();
        agree("derivative by the parameters", &m, &grads, 1e-4);
    }
}

/// Both stages, and two growths.
fn small_dvgo() -> DvgoOptions {
    let stage = |iterations, voxels: usize, start_alpha| StageOptions {
        iterations,
        voxels: voxels.pow(3),
        start_alpha,
        dim: 1e-4,
        density_learning_rate: 0.5,
        ..DvgoOptions::paper().coarse
    };
    DvgoOptions {
        rays: 256,
        coarse: stage(8, 20, 1e-3),
        fine: stage(10, 24, 1e-2),
        network: ColorNetworkOptions { channels: 5, width: 16, hidden: 2, position_octaves: 2, direction_octaves: 1 },
        grow: vec![2, 4],
        step: 0.7,
        decay: 10,
        free_space: 2e-3,
        ..DvgoOptions::paper()
    }
}
