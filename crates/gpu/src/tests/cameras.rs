//! What losses ask of positions, of rays and of cameras, and training that moves the cameras, beside their twins.

use mb_neural::cameras::RayGradient;
use mb_neural::contraction::contract_gradient;
use mb_neural::dataset::SceneRay;
use mb_neural::encoding::{HARMONICS, harmonics_gradient};
use mb_neural::model::Model;
use mb_neural::nerf_original::NerfOriginal;
use mb_neural::neus::Neus;
use mb_neural::neus_original::NeusOriginal;
use mb_neural::sdf_field::DirectionEncoding;

use super::training::{gpu_nerf_original, small_nerf_original, small_neus, small_neus_original, told_neus};
use super::*;
use crate::dvgo::GpuDvgo;
use crate::nerf::GpuNerf;
use crate::neus::GpuNeus;
use crate::neus_original::GpuNeusOriginal;
use crate::on_device::OnDevice;
use crate::ray_gradients::{self, ByColor, ByPosition, Coordinates};

#[test]
fn derivatives_of_the_encoding_by_the_position_agree_with_their_twins() {
    let Some((context, _guard)) = device() else { return };
    let k = Kernels::new(&context);
    for (features, first, active) in [(1, 3, 3), (4, 3, 2), (8, 3, 3), (2, 0, 3)] {
        let grid = HashGrid::new(HashGridOptions { levels: 3, features, log2_entries: 9, coarsest: 5, finest: 40 });
        let mut rng = rng(features as u64, 3);
        let table = Parameters::new(numbers(&mut rng, grid.len(), 1.0));
        let mut x = points(&mut rng, 300);
        x.extend([[0.0; 3], [1.0; 3]]);
        let (n, stride) = (x.len(), (first + grid.width()).next_multiple_of(8));
        let [d, g] = [0; 2].map(|_| numbers(&mut rng, n * stride, 1.0));
        let v = points(&mut rng, n);
        // The twin's positions are those of the unit cube, twice as dense.
        let with_own_columns = |halves: Vec<[f32; 3]>| -> Vec<f32> {
            let own = |s: usize, i: usize| if first == 3 { d[s * stride + i] } else { 0.0 };
            (0..3 * n).map(|i| own(i / 3, i % 3) + 0.5 * halves[i / 3][i % 3]).collect()
        };
        let mut expected = vec![[0.0; 3]; n];
        grid.input_gradient(&table.values, &x, active, &d, stride, first, &mut expected);
        let normals = with_own_columns(expected.clone());
        let halves: Vec<[f32; 3]> = v.iter().map(|v| v.map(|c| 0.5 * c)).collect();
        grid.second_gradient(&table.values, &x, active, &g, &halves, stride, first, &mut expected);
        let both = with_own_columns(expected);

        let mut encoding = Encoding::new(&context, &grid, &table, first);
        encoding.active_levels = active;
        let [positions, d, g, v] = [x.as_flattened(), &d, &g, v.as_flattened()].map(|content| context.upload(content));
        let [found_normals, found] = [0; 2].map(|_| context.zeros(3 * n));
        let points = Points { positions: &positions, count: n };
        let mut work = context.work();
        encoding.normals(&mut work, &k, points, &d, &found_normals);
        encoding.position_gradient(&mut work, &k, points, &d, (&g, &v), &found);
        work.submit();
        agree("through the features", &context.read(&found_normals, 3 * n).expect("read"), &normals, 1e-5);
        agree("with the second derivatives", &context.read(&found, 3 * n).expect("read"), &both, 1e-5);
    }
}

#[test]
fn derivatives_of_frequencies_by_the_position_agree_with_their_twin() {
    let Some((context, _guard)) = device() else { return };
    let (k, mut rng, n, stride, octaves) = (Kernels::new(&context), rng(9, 0), 200, 40, Frequencies(6));
    let (x, v) = (points(&mut rng, n), points(&mut rng, n));
    let [d, g] = [0; 2].map(|_| numbers(&mut rng, n * stride, 1.0));
    let (mut encoded, mut expected) = (vec![0.0; n * stride], vec![[0.0; 3]; n]);
    octaves.forward(&x, &mut encoded, stride, 0);
    octaves.input_gradient(&encoded, &d, stride, 0, &mut expected);
    octaves.second_gradient(&encoded, &g, &v, stride, 0, &mut expected);
    let [encoded, d, g, v] = [&encoded, &d, &g, &v.concat()].map(|content| context.upload(content));
    let found = context.zeros(3 * n);
    let mut work = context.work();
    let columns = Columns { to: &encoded, stride, first: 0 };
    frequencies::position_gradient(&mut work, &k, octaves, n, columns, [&d, &g, &v, &found]);
    work.submit();
    agree("positions", &context.read(&found, 3 * n).expect("read"), expected.as_flattened(), 1e-5);
}

#[test]
fn derivatives_by_rays_agree_with_their_twins() {
    let Some((context, _guard)) = device() else { return };
    let (k, mut rng, first) = (Kernels::new(&context), rng(10, 0), 5);
    // More samples than a workgroup has threads, and none.
    let counts = [150, 0, 1, 64, 65];
    let n = 280;
    let steps: Vec<[f32; 2]> = (0..n).map(|_| [rng.random_range(0.2..4.0), 0.1]).collect();
    let rays: Vec<SceneRay> = (0..counts.len())
        .map(|_| {
            let direction = Vector3::from_fn(|_, _| rng.random_range(-1.0f32..1.0)).normalize();
            SceneRay { origin: std::array::from_fn(|_| rng.random_range(-1.0..1.0f32)), direction: direction.into() }
        })
        .collect();
    let mut packed = vec![[0.0; RAY]; rays.len()];
    for (to, ray) in packed.iter_mut().zip(&rays) {
        to[..3].copy_from_slice(&ray.origin);
        to[3..6].copy_from_slice(&ray.direction);
    }
    let mut s = Samples::new(&context);
    (s.len, s.starts, s.steps) = (n, context.upload(&starts(&counts)), context.upload(&steps));
    let scale = [0.5, 2.0, 1.5];
    for (of, direction, with_position) in [
        (Coordinates::Scene, DirectionEncoding::Harmonics, true),
        (Coordinates::Contracted, DirectionEncoding::Frequencies(4), false),
    ] {
        let columns = match direction {
            DirectionEncoding::Harmonics => HARMONICS,
            DirectionEncoding::Frequencies(octaves) => Frequencies(octaves).width(),
        };
        let stride = first + columns + 2;
        let d_position = numbers(&mut rng, 3 * n, 1.0);
        let d_color = numbers(&mut rng, stride * n, 1.0);
        let mut expected = Vec::new();
        for (ray, begins) in rays.iter().zip(starts(&counts).windows(2)) {
            // What is there stays.
            let mut to = RayGradient { origin: [1.0; 3], direction: [2.0; 3] };
            for i in begins[0] as usize..begins[1] as usize {
                let (t, row) = (steps[i][0], &d_color[stride * i..]);
                let g: [f32; 3] = std::array::from_fn(|d| d_position[3 * i + d] * scale[d]);
                let g = match of {
                    Coordinates::Scene => g,
                    _ => contract_gradient(ray.at(t), g.map(|c| 4.0 * c)),
                };
                to.add_point(t, std::array::from_fn(|d| g[d] + if with_position { row[d] } else { 0.0 }));
                let g = &row[first..first + columns];
                match direction {
                    DirectionEncoding::Harmonics => harmonics_gradient(ray.direction, g, &mut to.direction),
                    DirectionEncoding::Frequencies(octaves) => {
                        let (mut encoded, mut d) = (vec![0.0; columns], [[0.0; 3]]);
                        Frequencies(octaves).forward(&[ray.direction], &mut encoded, columns, 0);
                        Frequencies(octaves).input_gradient(&encoded, g, columns, 0, &mut d);
                        (0..3).for_each(|i| to.direction[i] += d[0][i]);
                    }
                }
            }
            expected.push([to.origin, to.direction]);
        }
        let [rays, d_position, d_color] =
            [packed.as_flattened(), &d_position, &d_color].map(|content| context.upload(content));
        // Behind five numbers of four.
        let mut to = vec![[0.0f32; 4]; 5];
        to.extend([[1.0, 1.0, 1.0, 0.0], [2.0, 2.0, 2.0, 0.0]].repeat(counts.len()));
        let to = context.upload(&to);
        let position = ByPosition { d: &d_position, of, scale };
        let color = ByColor { d: &d_color, stride, with_position, first, direction: Some(direction) };
        let mut work = context.work();
        ray_gradients::add(&mut work, &k, (&rays, counts.len()), &s, (position, color), (&to, 5));
        work.submit();
        let found: Vec<[f32; 4]> = context.read(&to, 5 + 2 * counts.len()).expect("read");
        let found: Vec<f32> = found[5..].iter().flat_map(|g| [g[0], g[1], g[2]]).collect();
        agree("rays", &found, expected.as_flattened().as_flattened(), 1e-5);
    }
}

/// Cameras that are corrected from step `start` on, and are already.
fn moving(data: &RayDataset, start: u64) -> CameraResiduals {
    let options = CameraOptions { refine_poses: true, refine_focal: true, start, ..CameraOptions::default() };
    let mut cameras = CameraResiduals::new(&options, data);
    for (values, size) in cameras.buffers().into_iter().step_by(3).zip([0.03, 0.02, 0.02]) {
        values.iter_mut().enumerate().for_each(|(i, v)| *v = size * (1.7 * i as f32).sin());
    }
    cameras
}

/// One step asks of the cameras what the twin's does. First moments are a tenth of the gradients.
fn check_step(what: &str, data: &RayDataset, models: [&mut dyn Model; 2], step: u64, tolerance: f32) {
    let [expected, found] = models.map(|model| {
        let mut cameras = moving(data, 0);
        model.step(data, &mut cameras, step).expect("a step");
        cameras.buffers().into_iter().skip(1).step_by(3).map(|m| m.clone()).collect::<Vec<_>>()
    });
    for ((name, found), expected) in ["rotations", "centres", "focal lengths"].iter().zip(&found).zip(&expected) {
        assert!(expected.iter().any(|m| *m != 0.0), "{what}: {name} have no gradient");
        agree(&format!("{what}: {name}"), found, expected, tolerance);
    }
}

/// Losses of all steps, and all that was learned.
fn run(model: &mut dyn Model, data: &RayDataset) -> (Vec<f64>, Vec<Vec<f32>>) {
    // The first rays that belong to moving cameras were drawn ahead.
    let mut cameras = moving(data, 2);
    let losses =
        (0..model.iterations()).map(|step| model.step(data, &mut cameras, step).expect("a step").loss).collect();
    model.fetch().expect("parameters");
    let buffers = cameras.buffers().into_iter().chain(model.buffers()).map(|b| b.clone()).collect();
    (losses, buffers)
}

/// Training with cameras that move follows the twin and repeats its bytes.
fn check_training(data: &RayDataset, twin: &mut dyn Model, gpu: impl Fn() -> Box<dyn Model>, tolerance: f64) {
    let ((expected, _), found) = (run(twin, data), run(gpu().as_mut(), data));
    for (step, (found, expected)) in found.0.iter().zip(&expected).enumerate() {
        assert!((found - expected).abs() < tolerance * expected, "step {step}: {found} is not {expected}");
    }
    assert!(run(gpu().as_mut(), data) == found, "two runs differ");
}

#[test]
fn neus_moves_cameras_as_its_twin_does() {
    let Some((context, _guard)) = device() else { return };
    for with_masks in [true, false] {
        let data = scene(with_masks);
        let start = || told_neus(&data);
        let gpu = |twin| Box::new(OnDevice(GpuNeus::new(twin, Arc::clone(&context))));
        check_step(&format!("masks {with_masks}"), &data, [&mut start(), gpu(start()).as_mut()], 0, 1e-3);
    }
    let data = scene(false);
    let start = || Neus::new(small_neus(), &data);
    let gpu = || Box::new(OnDevice(GpuNeus::new(start(), Arc::clone(&context)))) as Box<dyn Model>;
    check_training(&data, &mut start(), gpu, 0.01);
}

#[test]
fn nerf_moves_cameras_as_its_twin_does() {
    let Some((context, _guard)) = device() else { return };
    for with_masks in [true, false] {
        let data = scene(with_masks);
        let start = || {
            let mut twin = Nerf::new(NerfOptions { object_only: with_masks, ..small() }, &data);
            // A table that already says something.
            let mut rng = rng(7, 0);
            twin.parameters.table.values.iter_mut().for_each(|v| *v = rng.random_range(-0.5..0.5));
            twin
        };
        let gpu = |twin| Box::new(OnDevice(GpuNerf::new(twin, Arc::clone(&context))));
        check_step(&format!("masks {with_masks}"), &data, [&mut start(), gpu(start()).as_mut()], 0, 1e-3);
    }
    let data = scene(false);
    let start = || Nerf::new(small(), &data);
    let gpu = || Box::new(OnDevice(GpuNerf::new(start(), Arc::clone(&context)))) as Box<dyn Model>;
    check_training(&data, &mut start(), gpu, 1e-3);
}

#[test]
fn dvgo_moves_cameras_as_its_twin_does() {
    let Some((context, _guard)) = device() else { return };
    for (with_masks, step) in [(true, 0), (true, 8), (false, 0), (false, 8)] {
        let data = scene(with_masks);
        let start = || {
            // After a coarse stage that has learned nothing all of the space is open; the box need not be a cube.
            let mut twin = Dvgo::new(DvgoOptions { free_space: 1e-5, ..small_dvgo() }, &data);
            twin.begin(step).expect("all of the space");
            (twin.bounds.low, twin.bounds.high) = ([0.1, 0.05, 0.2], [0.9, 0.95, 0.85]);
            // Voxels that already say something.
            let mut rng = rng(7, 0);
            twin.parameters.density.values.iter_mut().for_each(|v| *v = rng.random_range(-4.0..8.0));
            twin.parameters.features.values.iter_mut().for_each(|v| *v = rng.random_range(-1.0..1.0));
            twin
        };
        let mut gpu = OnDevice(GpuDvgo::new(start(), Arc::clone(&context)));
        check_step(&format!("masks {with_masks}, step {step}"), &data, [&mut start(), &mut gpu], step, 1e-3);
    }
    let data = scene(false);
    let start = || Dvgo::new(small_dvgo(), &data);
    let gpu = || Box::new(OnDevice(GpuDvgo::new(start(), Arc::clone(&context)))) as Box<dyn Model>;
    check_training(&data, &mut start(), gpu, 1e-3);
}

#[test]
fn the_original_nerf_moves_cameras_as_its_twin_does() {
    let Some((context, _guard)) = device() else { return };
    let twin = |data: &RayDataset| NerfOriginal::new(small_nerf_original(), data);
    for with_masks in [true, false] {
        let data = scene(with_masks);
        let mut gpu = gpu_nerf_original(&data, &context);
        check_step(&format!("masks {with_masks}"), &data, [&mut twin(&data), &mut gpu], 0, 1e-3);
    }
    let data = scene(false);
    check_training(&data, &mut twin(&data), || Box::new(gpu_nerf_original(&data, &context)), 1e-3);
}

#[test]
fn the_original_neus_moves_cameras_as_its_twin_does() {
    let Some((context, _guard)) = device() else { return };
    let twin = |data: &RayDataset| NeusOriginal::new(small_neus_original(), data);
    let gpu = |data: &RayDataset| Box::new(OnDevice(GpuNeusOriginal::new(twin(data), Arc::clone(&context))));
    for with_masks in [true, false] {
        let data = scene(with_masks);
        // The warm-up begins with a rate of zero; half of the annealing is over.
        check_step(&format!("masks {with_masks}"), &data, [&mut twin(&data), gpu(&data).as_mut()], 1, 1e-3);
    }
    let data = scene(false);
    check_training(&data, &mut twin(&data), || gpu(&data), 2e-3);
}
