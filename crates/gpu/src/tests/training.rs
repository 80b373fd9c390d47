//! Whole training beside the twin's: the gradients of a step, the losses of a run, checkpoints, and a lost device.

use std::sync::atomic::{AtomicUsize, Ordering};

use mb_job::Silent;
use mb_neural::model::Model;
use mb_neural::nerf_original::{NerfOriginal, NerfOriginalOptions};
use mb_neural::neus::{Neus, NeusOptions};
use mb_neural::neus_original::{NeusOriginal, NeusOriginalOptions};
use mb_neural::sdf_field::{DirectionEncoding, PositionEncoding, SdfFieldOptions, SdfWorker};
use mb_neural::trainer::{RunOptions, train};

use super::*;
use crate::dvgo::GpuDvgo;
use crate::nerf::GpuNerf;
use crate::nerf_original::GpuNerfOriginal;
use crate::neus::GpuNeus;
use crate::neus_original::GpuNeusOriginal;
use crate::on_device::OnDevice;

/// Losses of all steps.
fn losses(model: &mut dyn Model, data: &RayDataset) -> Vec<f64> {
    let mut cameras = CameraResiduals::new(&CameraOptions::default(), data);
    (0..model.iterations()).map(|step| model.step(data, &mut cameras, step).expect("a step").loss).collect()
}

#[test]
fn training_follows_the_twin_and_repeats_its_bytes() {
    let Some((context, _guard)) = device() else { return };
    let data = scene(false);
    let mut twin = Nerf::new(small(), &data);
    let expected = losses(&mut twin, &data);
    let mut runs = Vec::new();
    for _ in 0..2 {
        let mut gpu = OnDevice(GpuNerf::new(Nerf::new(small(), &data), Arc::clone(&context)));
        let found = losses(&mut gpu, &data);
        gpu.fetch().expect("parameters");
        assert!(gpu.is_finite());
        let buffers: Vec<Vec<f32>> = gpu.buffers().into_iter().map(|b| b.clone()).collect();
        runs.push((found, buffers));
    }
    assert!(runs[0] == runs[1], "two runs differ");
    let found = &runs[0].0;
    assert!(found[23] < 0.75 * found[0], "{found:?}");
    for (step, (found, expected)) in found.iter().zip(&expected).enumerate() {
        // Rounding grows as training goes on, but slowly.
        let tolerance = if step < 8 { 1e-3 } else { 0.05 };
        assert!((found - expected).abs() < tolerance * expected, "step {step}: {found} is not {expected}");
    }
}

#[test]
fn a_checkpoint_moves_between_devices_and_a_lost_device_keeps_it() {
    let Some((context, _guard)) = device() else { return };
    let data = scene(false);
    let folder = tempfile::tempdir().expect("a folder");
    let run = RunOptions {
        checkpoint: Some(folder.path().join("state")),
        checkpoint_every: 4,
        report_every: 1,
        ..RunOptions::default()
    };
    let mut cameras = CameraResiduals::new(&CameraOptions::default(), &data);
    let json = serde_json::Value::Null;
    let lost = Arc::clone(&context);
    let stop = LoseAt { step: 6, context: lost };
    let mut gpu = OnDevice(GpuNerf::new(Nerf::new(small(), &data), context));
    let error = train(&mut gpu, &data, &mut cameras, &json, &run, &stop).expect_err("the device is lost").to_string();
    assert!(error.contains("lost") && error.contains("holds the last good state"), "{error}");
    let mut twin = Nerf::new(small(), &data);
    let summary = train(&mut twin, &data, &mut cameras, &json, &run, &Silent).expect("the processor goes on");
    assert_eq!((summary.first_step, summary.steps), (4, 24));
}

/// Stops at a step.
struct StopAt(usize, AtomicUsize);

impl mb_job::Progress for StopAt {
    fn report(&self, _what: &str, done: usize, _total: usize) {
        self.1.store(done, Ordering::Relaxed);
    }

    fn stop_requested(&self) -> bool {
        self.1.load(Ordering::Relaxed) >= self.0
    }
}

/// Takes the device away at a step.
struct LoseAt {
    step: usize,
    context: Arc<Context>,
}

impl mb_job::Progress for LoseAt {
    fn report(&self, _what: &str, done: usize, _total: usize) {
        if done == self.step {
            self.context.lose();
        }
    }

    fn stop_requested(&self) -> bool {
        false
    }
}

pub fn small_neus() -> NeusOptions {
    let grid = HashGridOptions { levels: 4, features: 2, log2_entries: 12, coarsest: 8, finest: 64 };
    let mut options = NeusOptions {
        samples_per_step: 1 << 12,
        background: RadianceFieldOptions { grid, width: 16, color_hidden: 1 },
        first_levels: 2,
        longest_step: 0.1,
        shortest_step: 0.05,
        background_cone: 0.1,
        far: 6.0,
        occupancy: 32,
        occupancy_every: 4,
        ..NeusOptions::default()
    }
    .with_iterations(8);
    options.field = SdfFieldOptions {
        position: PositionEncoding::Hash(grid),
        width: 16,
        hidden: 2,
        features: 5,
        color_width: 16,
        color_hidden: 1,
        ..options.field
    };
    options
}

/// A small NeuS whose tables already say something, whose network hears of them (at its start it hears of the position alone),
/// and whose surface is sharper.
pub(super) fn told_neus(data: &RayDataset) -> Neus {
    let mut twin = Neus::new(small_neus(), data);
    let mut rng = rng(7, 0);
    let (table, [geometry, _]) = twin.field.parts_mut();
    table.values.iter_mut().for_each(|v| *v = rng.random_range(-0.05..0.05));
    let first = geometry.mlp().layout().next();
    let [weights, _] = geometry.parts_mut();
    if let Some((inputs, outputs, stride, at, _)) = first {
        for row in weights.values[at..].chunks_mut(stride).take(inputs) {
            row[..outputs].iter_mut().for_each(|v| *v += rng.random_range(-0.3..0.3));
        }
    }
    twin.field.refresh();
    twin.outside_parameters.table.values.iter_mut().for_each(|v| *v = rng.random_range(-0.5..0.5));
    twin.sharpness.values[0] = 0.4;
    twin
}

/// One step changes every buffer as the twin's does. First moments are a tenth of the gradients.
#[test]
fn a_step_of_neus_has_the_gradients_of_its_twin() {
    let Some((context, _guard)) = device() else { return };
    for with_masks in [true, false] {
        let data = scene(with_masks);
        let mut cameras = CameraResiduals::new(&CameraOptions::default(), &data);
        let mut twin = told_neus(&data);
        let mut gpu = OnDevice(GpuNeus::new(told_neus(&data), Arc::clone(&context)));
        let expected = twin.step(&data, &mut cameras, 0).expect("a step");
        let found = gpu.step(&data, &mut cameras, 0).expect("a step");
        gpu.fetch().expect("parameters");
        assert!(found.rays == expected.rays && found.samples.abs_diff(expected.samples) * 1000 < expected.samples);
        assert!((found.loss - expected.loss).abs() < 1e-3 * expected.loss, "{found:?} is not {expected:?}");
        assert!((found.mse - expected.mse).abs() < 1e-3 * expected.mse, "{found:?} is not {expected:?}");
        // Table, both networks with their gains, the background's three, the sharpness: values and two moments each.
        let buffers = gpu.buffers().into_iter().zip(twin.buffers()).enumerate().take(27);
        for (i, (found, expected)) in buffers.skip(1).step_by(3) {
            // A sample at a cell's wall may fall on either side of it, and belongs to one ray of hundreds.
            agree(&format!("buffer {i}, masks {with_masks}"), found, expected, 5e-3);
        }
    }
}

#[test]
fn training_of_neus_follows_the_twin_and_repeats_its_bytes() {
    let Some((context, _guard)) = device() else { return };
    for with_masks in [true, false] {
        let data = scene(with_masks);
        let expected = losses(&mut Neus::new(small_neus(), &data), &data);
        let run = || {
            let twin = Neus::new(small_neus(), &data);
            let mut gpu = OnDevice(GpuNeus::new(twin, Arc::clone(&context)));
            let found = losses(&mut gpu, &data);
            gpu.fetch().expect("parameters");
            let buffers: Vec<Vec<f32>> = gpu.buffers().into_iter().map(|b| b.clone()).collect();
            (found, buffers)
        };
        let (found, buffers) = run();
        for (step, (found, expected)) in found.iter().zip(&expected).enumerate() {
            let tolerance = if step < 4 { 2e-3 } else { 0.05 };
            assert!((found - expected).abs() < tolerance * expected, "step {step}: {found} is not {expected}");
        }
        assert!(!with_masks || run() == (found, buffers), "two runs differ");
    }
}

/// One step of either stage changes every buffer as the twin's does. First moments are a tenth of the gradients.
#[test]
fn a_step_of_dvgo_has_the_gradients_of_its_twin() {
    let Some((context, _guard)) = device() else { return };
    for (with_masks, step, faint) in
        [(true, 0, false), (true, 8, false), (false, 0, false), (false, 8, false), (true, 0, true)]
    {
        let data = scene(with_masks);
        let mut cameras = CameraResiduals::new(&CameraOptions::default(), &data);
        let start = || {
            // After a coarse stage that has learned nothing all of the space is open.
            let mut options = DvgoOptions { free_space: 1e-5, ..small_dvgo() };
            if faint {
                options.coarse = StageOptions { iterations: 8, voxels: 20 * 20 * 20, ..DvgoOptions::paper().coarse };
            }
            let mut twin = Dvgo::new(options, &data);
            twin.begin(step).expect("all of the space");
            // Voxels that already say something, or whose opacity of a millionth is the published start.
            let mut rng = rng(7, 0);
            let range = if faint { -0.1..0.1 } else { -4.0..8.0 };
            twin.parameters.density.values.iter_mut().for_each(|v| *v = rng.random_range(range.clone()));
            twin.parameters.features.values.iter_mut().for_each(|v| *v = rng.random_range(-1.0..1.0));
            twin
        };
        let mut twin = start();
        let mut gpu = OnDevice(GpuDvgo::new(start(), Arc::clone(&context)));
        let expected = twin.step(&data, &mut cameras, step).expect("a step");
        let found = gpu.step(&data, &mut cameras, step).expect("a step");
        gpu.fetch().expect("parameters");
        assert!(found.rays == expected.rays && found.samples.abs_diff(expected.samples) * 1000 < expected.samples);
        assert!((found.loss - expected.loss).abs() < 1e-4 * expected.loss, "{found:?} is not {expected:?}");
        assert!((found.mse - expected.mse).abs() < 1e-4 * expected.mse, "{found:?} is not {expected:?}");
        // Densities, features and the network: values and two moments each.
        let buffers = gpu.buffers().into_iter().zip(twin.buffers()).enumerate().take(9);
        for (i, (found, expected)) in buffers.skip(1).step_by(3) {
            assert!(expected.is_empty() || expected.iter().any(|v| *v != 0.0), "buffer {i} has no gradient");
            agree(&format!("buffer {i}, step {step}, masks {with_masks}, faint {faint}"), found, expected, 5e-3);
        }
    }
}

#[test]
fn training_of_dvgo_follows_the_twin_and_repeats_its_bytes() {
    let Some((context, _guard)) = device() else { return };
    for with_masks in [true, false] {
        let data = scene(with_masks);
        let mut twin = Dvgo::new(small_dvgo(), &data);
        let expected = losses(&mut twin, &data);
        let run = || {
            let mut gpu = OnDevice(GpuDvgo::new(Dvgo::new(small_dvgo(), &data), Arc::clone(&context)));
            let found = losses(&mut gpu, &data);
            gpu.fetch().expect("parameters");
            let buffers: Vec<Vec<f32>> = gpu.buffers().into_iter().map(|b| b.clone()).collect();
            (found, buffers)
        };
        let (found, buffers) = run();
        assert!(with_masks || twin.bounds != UnitBox::ALL, "the coarse stage found nothing");
        for (step, (found, expected)) in found.iter().zip(&expected).enumerate() {
            assert!((found - expected).abs() < 1e-4 * expected, "step {step}: {found} is not {expected}");
        }
        // The fine stage's box, and its voxels on each side.
        assert_eq!(buffers.last(), twin.buffers().last().map(|b| &**b));
        assert!(!with_masks || run() == (found, buffers), "two runs differ");
    }
}

#[test]
fn a_checkpoint_of_dvgo_moves_between_devices() {
    let Some((context, _guard)) = device() else { return };
    let data = scene(true);
    let folder = tempfile::tempdir().expect("a folder");
    let state = Some(folder.path().join("state"));
    let run = RunOptions { checkpoint: state, checkpoint_every: 4, report_every: 1, ..RunOptions::default() };
    let mut cameras = CameraResiduals::new(&CameraOptions::default(), &data);
    let json = serde_json::Value::Null;
    let expected = losses(&mut Dvgo::new(small_dvgo(), &data), &data)[17];
    // The processor stops in the fine stage, between two growths; the device goes on from there.
    let mut twin = Dvgo::new(small_dvgo(), &data);
    train(&mut twin, &data, &mut cameras, &json, &run, &StopAt(12, AtomicUsize::new(0))).expect_err("stopped");
    let mut gpu = OnDevice(GpuDvgo::new(Dvgo::new(small_dvgo(), &data), context));
    let summary = train(&mut gpu, &data, &mut cameras, &json, &run, &Silent).expect("the device goes on");
    assert_eq!(summary.steps, 18);
    assert!((11..=12).contains(&summary.first_step), "{}", summary.first_step);
    let found = summary.curve[summary.curve.len() - 1].loss;
    assert!((found - expected).abs() < 1e-4 * expected, "{found} is not {expected}");
}

pub fn small_nerf_original() -> NerfOriginalOptions {
    let field = FrequencyFieldOptions {
        position_octaves: 4,
        direction_octaves: 2,
        width: 24,
        hidden: 3,
        skip: 2,
        head_width: 16,
        activation: DensityActivation::Relu,
    };
    let (rays, coarse_samples, fine_samples) = (64, 10, 14);
    NerfOriginalOptions { rays, coarse_samples, fine_samples, field, ..NerfOriginalOptions::paper() }.with_iterations(5)
}

/// A learner that cuts a step into parts of 26 rays, the last one smaller.
pub fn gpu_nerf_original(data: &RayDataset, context: &Arc<Context>) -> OnDevice<GpuNerfOriginal> {
    let mut gpu = GpuNerfOriginal::new(NerfOriginal::new(small_nerf_original(), data), Arc::clone(context));
    gpu.most_samples = 30 * 24;
    OnDevice(gpu)
}

#[test]
fn a_step_of_the_original_nerf_has_the_gradients_of_its_twin() {
    let Some((context, _guard)) = device() else { return };
    for with_masks in [true, false] {
        let data = scene(with_masks);
        let mut cameras = CameraResiduals::new(&CameraOptions::default(), &data);
        let mut twin = NerfOriginal::new(small_nerf_original(), &data);
        let mut gpu = gpu_nerf_original(&data, &context);
        let expected = twin.step(&data, &mut cameras, 0).expect("a step");
        let found = gpu.step(&data, &mut cameras, 0).expect("a step");
        gpu.fetch().expect("parameters");
        assert!((found.rays, found.samples) == (expected.rays, expected.samples), "{found:?} is not {expected:?}");
        assert!((found.loss - expected.loss).abs() < 1e-5 * expected.loss, "{found:?} is not {expected:?}");
        assert!((found.mse - expected.mse).abs() < 1e-5 * expected.mse, "{found:?} is not {expected:?}");
        // Trunk and head of both networks: values and two moments each. First moments are a tenth of the gradients.
        let buffers = gpu.buffers().into_iter().zip(twin.buffers()).enumerate();
        for (i, (found, expected)) in buffers.skip(1).step_by(3) {
            agree(&format!("buffer {i}, masks {with_masks}"), found, expected, 1e-3);
        }
    }
}

#[test]
fn training_of_the_original_nerf_follows_the_twin_and_goes_on_from_its_checkpoint() {
    let Some((context, _guard)) = device() else { return };
    let data = scene(false);
    let mut twin = NerfOriginal::new(small_nerf_original(), &data);
    let expected = losses(&mut twin, &data);
    let run = || {
        let mut gpu = gpu_nerf_original(&data, &context);
        let found = losses(&mut gpu, &data);
        gpu.fetch().expect("parameters");
        (found, gpu.buffers().into_iter().map(|b| b.clone()).collect::<Vec<_>>())
    };
    let (found, buffers) = run();
    for (step, (found, expected)) in found.iter().zip(&expected).enumerate() {
        assert!((found - expected).abs() < 1e-3 * expected, "step {step}: {found} is not {expected}");
    }
    assert!(run() == (found, buffers), "two runs differ");

    // The twin's state moves to a device that had another one.
    let mut half = NerfOriginal::new(small_nerf_original(), &data);
    let mut cameras = CameraResiduals::new(&CameraOptions::default(), &data);
    (0..4).for_each(|step| drop(half.step(&data, &mut cameras, step)));
    let mut gpu = gpu_nerf_original(&data, &context);
    gpu.buffers().into_iter().zip(half.buffers()).for_each(|(to, from)| to.clone_from(from));
    gpu.restored(4).expect("the state fits");
    let next = gpu.step(&data, &mut cameras, 4).expect("a step");
    assert!((next.loss - expected[4]).abs() < 1e-5 * expected[4], "{} is not {}", next.loss, expected[4]);
}

pub fn small_neus_original() -> NeusOriginalOptions {
    let background = FrequencyFieldOptions {
        position_octaves: 3,
        direction_octaves: 2,
        width: 16,
        hidden: 2,
        skip: 1,
        head_width: 16,
        activation: DensityActivation::Softplus,
    };
    let field = SdfFieldOptions {
        position: PositionEncoding::Frequencies(2),
        direction: DirectionEncoding::Frequencies(2),
        width: 32,
        hidden: 3,
        skip: Some(2),
        features: 5,
        softplus: 20.0,
        color_width: 16,
        color_hidden: 2,
        ..SdfFieldOptions::paper()
    };
    NeusOriginalOptions {
        rays: 160,
        samples: 10,
        importance: 9,
        rounds: 3,
        outside: 6,
        field,
        background,
        ..NeusOriginalOptions::paper()
    }
    .with_iterations(5)
}

#[test]
fn rounds_of_sampling_agree_with_their_twin() {
    let Some((context, _guard)) = device() else { return };
    let data = scene(false);
    let cameras = CameraResiduals::new(&CameraOptions::default(), &data);
    let (twin, mut targets, mut probe) =
        (NeusOriginal::new(small_neus_original(), &data), Vec::new(), SdfWorker::default());
    data.draw(&mut rng(1, 0), 100, &cameras, &mut targets);
    let (mut packed, mut even, mut expected) = (Vec::new(), Vec::new(), Vec::new());
    for target in &targets {
        packed.push(pack(target, 0.0, [0.0; 3], target.rgb, 0.0));
        even.extend(twin.even_depths(&target.ray, None));
        expected.extend(twin.depths(&target.ray, None, &mut probe));
    }
    let mut gpu = GpuNeusOriginal::new(twin, Arc::clone(&context));
    let n = gpu.rounds(&context.upload(packed.as_flattened()), packed.len(), &even);
    let found: Vec<f32> = context.read(&gpu.sections.depths, 100 * n).expect("starts");
    // Behind a surface next to nothing is left of the light, and its rounding moves a few starts by part of a section.
    agree("starts", &found, &expected, 2e-3);
    let off = found.iter().zip(&expected).filter(|(a, b)| (**a - **b).abs() > 1e-4).count();
    assert!(off * 50 < found.len(), "{off} of {} starts differ", found.len());
}

#[test]
fn a_step_of_the_original_neus_has_the_gradients_of_its_twin() {
    let Some((context, _guard)) = device() else { return };
    for with_masks in [true, false] {
        let data = scene(with_masks);
        let mut cameras = CameraResiduals::new(&CameraOptions::default(), &data);
        let mut twin = NeusOriginal::new(small_neus_original(), &data);
        let start = NeusOriginal::new(small_neus_original(), &data);
        let mut gpu = OnDevice(GpuNeusOriginal::new(start, Arc::clone(&context)));
        // The warm-up begins with a rate of zero; half of the annealing is over.
        let expected = twin.step(&data, &mut cameras, 1).expect("a step");
        let found = gpu.step(&data, &mut cameras, 1).expect("a step");
        gpu.fetch().expect("parameters");
        assert!((found.rays, found.samples) == (expected.rays, expected.samples), "{found:?} is not {expected:?}");
        assert!((found.loss - expected.loss).abs() < 1e-4 * expected.loss, "{found:?} is not {expected:?}");
        assert!((found.mse - expected.mse).abs() < 1e-4 * expected.mse, "{found:?} is not {expected:?}");
        // First moments are a tenth of the gradients.
        let buffers = gpu.buffers().into_iter().zip(twin.buffers()).enumerate();
        for (i, (found, expected)) in buffers.skip(1).step_by(3) {
            agree(&format!("buffer {i}, masks {with_masks}"), found, expected, 5e-3);
        }
    }
}

#[test]
fn training_of_the_original_neus_follows_the_twin_and_goes_on_from_its_checkpoint() {
    let Some((context, _guard)) = device() else { return };
    let data = scene(false);
    let expected = losses(&mut NeusOriginal::new(small_neus_original(), &data), &data);
    let start = || {
        let twin = NeusOriginal::new(small_neus_original(), &data);
        OnDevice(GpuNeusOriginal::new(twin, Arc::clone(&context)))
    };
    let run = || {
        let mut gpu = start();
        let found = losses(&mut gpu, &data);
        gpu.fetch().expect("parameters");
        (found, gpu.buffers().into_iter().map(|b| b.clone()).collect::<Vec<_>>())
    };
    let (found, buffers) = run();
    for (step, (found, expected)) in found.iter().zip(&expected).enumerate() {
        assert!((found - expected).abs() < 2e-3 * expected, "step {step}: {found} is not {expected}");
    }
    assert!(run() == (found, buffers), "two runs differ");

    // The twin's state moves to a device that had another one.
    let mut half = NeusOriginal::new(small_neus_original(), &data);
    let mut cameras = CameraResiduals::new(&CameraOptions::default(), &data);
    (0..4).for_each(|step| drop(half.step(&data, &mut cameras, step)));
    let mut gpu = start();
    gpu.buffers().into_iter().zip(half.buffers()).for_each(|(to, from)| to.clone_from(from));
    gpu.restored(4).expect("the state fits");
    let next = gpu.step(&data, &mut cameras, 4).expect("a step");
    assert!((next.loss - expected[4]).abs() < 1e-4 * expected[4], "{} is not {}", next.loss, expected[4]);
}
