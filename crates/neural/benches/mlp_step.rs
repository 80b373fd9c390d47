//! One training step of a 32-64-64-16 network: forward, squared error, backward, Adam. Prints steps and CPU seconds for
//! batches of 65,536 and 4,096 samples; PyTorch 2 needs 12.7 steps/s for the first on two quiet cores.

use std::time::Instant;

use cpu_time::ProcessTime;
use mb_neural::adam::{AdamOptions, Parameters};
use mb_neural::mlp::{Activation, Mlp, MlpCache, MlpShape, Weights};
use rand::RngExt;
use rayon::prelude::*;

const GROUPS: usize = 32;
const TILE: usize = 512;

fn main() {
    let shape = MlpShape { inputs: 32, width: 64, hidden: 2, outputs: 16, activation: Activation::Relu, skip: None };
    let mlp = Mlp::new(shape);
    println!("isa {:?}, {} threads", mb_neural::simd::Isa::detected(), rayon::current_num_threads());
    for (batch, steps) in [(65_536usize, 30u64), (4_096, 300)] {
        let mut rng = mb_job::rng(0, 0);
        let x: Vec<f32> = (0..batch * 32).map(|_| rng.random_range(-1.0..1.0)).collect();
        let target: Vec<f32> =
            (0..batch * 16).map(|i| (x[i / 16 * 32] * x[i / 16 * 32 + 1] + i as f32).sin()).collect();
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
                        mlp.forward(weights.parameters, &x[start * 32..], 32, n, cache);
                        d_out.clear();
                        for (y, t) in cache.out.iter().zip(&target[start * 16..]) {
                            *loss += f64::from((y - t) * (y - t));
                            d_out.push(2.0 * (y - t) / (batch * 16) as f32);
                        }
                        mlp.backward(&weights, &x[start * 32..], 32, cache, d_out, None, grads, false);
                    }
                });
                for (grads, ..) in &workers {
                    parameters.grads.iter_mut().zip(grads).for_each(|(sum, g)| *sum += g);
                }
                loss = workers.iter().map(|w| w.3).sum::<f64>() / (batch * 16) as f64;
                parameters.step(&AdamOptions::default(), 1e-3, t);
            }
        };
        run(3, 1);
        let (wall, cpu) = (Instant::now(), ProcessTime::now());
        run(steps, 4);
        let (wall, cpu) = (wall.elapsed().as_secs_f64(), cpu.elapsed().as_secs_f64());
        let flops = 6.0 * batch as f64 * (32 * 64 + 64 * 64 + 64 * 16) as f64 - 2.0 * (batch * 32 * 64) as f64;
        println!(
            "batch {batch}: {:.1} steps/s wall, {:.4} CPU s a step, {:.0} GFLOP per CPU s, loss {loss:.5}",
            steps as f64 / wall,
            cpu / steps as f64,
            flops * steps as f64 / cpu * 1e-9,
        );
    }
}
