//! One training step of a network: forward, squared error, backward, Adam, for the small network of the fast presets
//! (32-64-64-16) and for the trunk of the original NeRF (63 - 8 x 256 - 257, input again at layer 5). Prints steps a
//! second and CPU seconds a step; `pytorch.py` beside this file runs the same in PyTorch.

use std::time::Instant;

use cpu_time::ProcessTime;
use mb_neural::adam::{AdamOptions, Parameters};
use mb_neural::mlp::{Activation, Mlp, MlpCache, MlpShape, Skip, Weights};
use rand::RngExt;
use rayon::prelude::*;

const GROUPS: usize = 32;
const TILE: usize = 512;
const SMALL: MlpShape =
    MlpShape { inputs: 32, width: 64, hidden: 2, outputs: 16, activation: Activation::Relu, skip: None };
const TRUNK: MlpShape = MlpShape {
    inputs: 63,
    width: 256,
    hidden: 8,
    outputs: 257,
    activation: Activation::Relu,
    skip: Some(Skip { layer: 5, narrow: false }),
};

fn main() {
    println!("isa {:?}, {} threads", mb_neural::simd::Isa::detected(), rayon::current_num_threads());
    for (name, shape, batch, steps) in
        [("32-64-64-16", SMALL, 65_536, 30), ("32-64-64-16", SMALL, 4_096, 300), ("63-8x256-257", TRUNK, 8_192, 6)]
    {
        measure(name, shape, batch, steps);
    }
}

fn measure(name: &str, shape: MlpShape, batch: usize, steps: u64) {
    let (mlp, inputs, outputs) = (Mlp::new(shape), shape.inputs, shape.outputs);
    let stride = mlp.out_stride();
    let mut rng = mb_job::rng(0, 0);
    let x: Vec<f32> = (0..batch * inputs).map(|_| rng.random_range(-1.0..1.0)).collect();
    let target: Vec<f32> = (0..batch * outputs).map(|i| (x[i / outputs * inputs] + i as f32).sin()).collect();
    let mut parameters = Parameters::new(mlp.init_uniform(&mut rng));
    let mut workers: Vec<(Vec<f32>, MlpCache, Vec<f32>, f64)> =
        (0..GROUPS).map(|_| (vec![0.0; mlp.buffer_len()], MlpCache::default(), Vec::new(), 0.0)).collect();
    let mut loss = 0.0;
    let mut run = |steps: u64, first: u64| {
        for t in first..first + steps {
            let transposed = mlp.transpose(&parameters.values);
            let weights = Weights { parameters: &parameters.values, transposed: &transposed };
            workers.par_iter_mut().enumerate().for_each(|(group, (grads, cache, d_out, loss))| {
                grads.fill(0.0);
                *loss = 0.0;
                let rows = group * batch / GROUPS..(group + 1) * batch / GROUPS;
                for start in rows.clone().step_by(TILE) {
                    let n = TILE.min(rows.end - start);
                    mlp.forward(weights.parameters, &x[start * inputs..], inputs, n, cache);
                    d_out.clear();
                    d_out.resize(n * stride, 0.0);
                    let wanted = target[start * outputs..].chunks_exact(outputs);
                    for ((y, t), d) in cache.out.chunks_exact(stride).zip(wanted).zip(d_out.chunks_exact_mut(stride)) {
                        for i in 0..outputs {
                            let e = y[i] - t[i];
                            *loss += f64::from(e * e);
                            d[i] = 2.0 * e / (batch * outputs) as f32;
                        }
                    }
                    mlp.backward(&weights, &x[start * inputs..], inputs, cache, d_out, None, grads, false);
                }
            });
            for (grads, ..) in &workers {
                parameters.grads.iter_mut().zip(grads).for_each(|(sum, g)| *sum += g);
            }
            loss = workers.iter().map(|w| w.3).sum::<f64>() / (batch * outputs) as f64;
            parameters.step(&AdamOptions::default(), 1e-3, t);
        }
    };
    run(3, 1);
    let (wall, cpu) = (Instant::now(), ProcessTime::now());
    run(steps, 4);
    let (wall, cpu) = (wall.elapsed().as_secs_f64(), cpu.elapsed().as_secs_f64());
    println!(
        "{name}, batch {batch}: {:.2} steps/s wall, {:.4} CPU s a step, {:.0} GFLOP per CPU s, loss {loss:.5}",
        steps as f64 / wall,
        cpu / steps as f64,
        6.0 * batch as f64 * mlp.parameter_count() as f64 * steps as f64 / cpu * 1e-9,
    );
}
