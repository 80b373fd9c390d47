//! Writes the paper's networks with inputs, outputs and derivatives, for `oracle.py` to compute again with PyTorch:
//! `cargo bench -p mb-neural --bench oracle -- DIR`, then `python crates/neural/benches/oracle.py DIR`.

use std::path::Path;

use mb_neural::adam::AdamOptions;
use mb_neural::frequency_field::{FrequencyField, FrequencyFieldOptions, FrequencyWorker};
use mb_neural::sdf_field::{SdfField, SdfFieldOptions, SdfWorker};
use rand::RngExt;

const POINTS: usize = 24;

fn write(folder: &Path, name: &str, numbers: &[f32]) {
    let bytes: Vec<u8> = numbers.iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(folder.join(format!("{name}.f32")), bytes).expect("a file is written");
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let [folder] = arguments.as_slice() else {
        println!("nothing to do: give DIR");
        return;
    };
    let folder = Path::new(folder);
    std::fs::create_dir_all(folder).expect("a folder");
    let mut rng = mb_job::rng(1, 0);
    let mut threes = |n: usize, scale: f32| -> Vec<[f32; 3]> {
        (0..n).map(|_| std::array::from_fn(|_| rng.random_range(-scale..scale))).collect()
    };
    let (positions, d_normals, d_rgb) = (threes(POINTS, 0.6), threes(POINTS, 1.0), threes(POINTS, 1.0));
    let more = threes(POINTS, 1.0);
    let d_first: Vec<f32> = more.iter().map(|v| v[0]).collect();
    let directions: Vec<[f32; 3]> = threes(POINTS, 1.0)
        .into_iter()
        .map(|v| {
            let length = v.iter().map(|c| c * c).sum::<f32>().sqrt();
            v.map(|c| c / length)
        })
        .collect();
    let runs: Vec<_> = directions.iter().map(|d| (1, *d)).collect();
    for (name, numbers) in [
        ("positions", positions.as_flattened()),
        ("directions", directions.as_flattened()),
        ("d_first", d_first.as_slice()),
        ("d_normals", d_normals.as_flattened()),
        ("d_rgb", d_rgb.as_flattened()),
    ] {
        write(folder, name, numbers);
    }
    // With beta1 = 0 the first moment after a step is the gradient.
    let adam = AdamOptions { beta1: 0.0, ..AdamOptions::default() };

    let mut field = SdfField::new(SdfFieldOptions::paper(), &mut mb_job::rng(2, 0));
    for (i, buffer) in field.buffers().into_iter().enumerate().filter(|(i, _)| i % 3 == 0) {
        write(folder, &format!("neus_{}", i / 3), buffer);
    }
    let mut w = SdfWorker::default();
    field.distance(&positions, &mut w);
    field.normals(&mut w);
    field.color(&runs, &mut w);
    write(folder, "neus_sdf", &w.sdf);
    write(folder, "neus_normals", w.normals.as_flattened());
    write(folder, "neus_rgb", w.rgb.as_flattened());
    (w.d_sdf, w.d_normals, w.d_rgb) = (d_first.clone(), d_normals.clone(), d_rgb.clone());
    field.backward(&mut w);
    field.ray_gradients(&runs, &mut w);
    write(folder, "neus_d_positions", w.d_positions.as_flattened());
    write(folder, "neus_d_directions", w.d_directions.as_flattened());
    field.collect(std::iter::once(&mut w));
    field.step(&adam, 0.0, 0.0, 1);
    for (i, buffer) in field.buffers().into_iter().enumerate().filter(|(i, _)| i % 3 == 1) {
        write(folder, &format!("neus_grad_{}", i / 3), buffer);
    }

    let field = FrequencyField::<3>::new(&FrequencyFieldOptions::PAPER);
    let mut p = field.init(&mut mb_job::rng(3, 0));
    for (i, buffer) in p.buffers().into_iter().enumerate().filter(|(i, _)| i % 3 == 0) {
        write(folder, &format!("nerf_{}", i / 3), buffer);
    }
    let mut w = FrequencyWorker::default();
    field.density(&p, &positions, &mut w);
    field.color(&p, &runs, &mut w);
    write(folder, "nerf_sigma", &w.sigma);
    write(folder, "nerf_rgb", w.rgb.as_flattened());
    (w.d_sigma, w.d_rgb) = (d_first, d_rgb);
    let transposed = field.transpose(&p);
    field.backward(&p, &transposed, &mut w);
    field.ray_gradients(&runs, &mut w);
    write(folder, "nerf_d_positions", w.d_positions.as_flattened());
    write(folder, "nerf_d_directions", w.d_directions.as_flattened());
    field.collect(&mut p, std::iter::once(&mut w));
    p.step(&adam, 0.0, 1);
    for (i, buffer) in p.buffers().into_iter().enumerate().filter(|(i, _)| i % 3 == 1) {
        write(folder, &format!("nerf_grad_{}", i / 3), buffer);
    }
    println!("wrote {}", folder.display());
}
