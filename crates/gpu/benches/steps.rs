//! Steps of training on a device: `cargo bench -p mb-gpu --features wgpu --bench steps -- gpu|gpu:N SEQ METHOD PRESET STEPS
//! MAX_SIDE_PX [OPTIONS]`. First as they run, a row for every tenth: wall and CPU milliseconds, rays and samples of a step,
//! PSNR of the training rays. Then as many again, the device's time in each kernel, which is waited for. OPTIONS is JSON
//! that replaces options of the method.

use std::sync::Arc;
use std::time::Instant;

use cpu_time::ProcessTime;
use mb_capture::Sequence;
use mb_gpu::DeviceChoice;
use mb_gpu::context::Context;
use mb_job::Silent;
use mb_neural::FieldOptions;
use mb_neural::cameras::CameraResiduals;
use mb_neural::dataset::RayDataset;
use mb_neural::trainer::psnr_db;
use serde_json::Value;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let [device, sequence, method, preset, steps, max_side, rest @ ..] = arguments.as_slice() else {
        println!("nothing to do: give gpu|gpu:N SEQ METHOD PRESET STEPS MAX_SIDE_PX [OPTIONS]");
        return;
    };
    let DeviceChoice::Gpu(number) = device.parse().expect("gpu or gpu:N") else { panic!("gpu or gpu:N") };
    let steps: u64 = steps.parse().expect("a number of steps");
    let options = FieldOptions::preset(method, preset, 0).expect("a known method and preset");
    let mut json = serde_json::to_value(&options).expect("options are plain data");
    json["data"]["max_side_px"] = max_side.parse::<usize>().expect("a number of pixels").into();
    if let Some(patch) = rest.first() {
        let patch: Value = serde_json::from_str(patch).expect("JSON");
        let method = json["method"].as_object_mut().and_then(|m| m.values_mut().next()).expect("options of a method");
        for (key, value) in patch.as_object().expect("an object") {
            method[key] = value.clone();
        }
    }
    let options: FieldOptions = serde_json::from_value(json).expect("options as the method has them");
    let sequence = Sequence::open(sequence).expect("a sequence");
    let data = RayDataset::open(&sequence, &options.data, &Silent).expect("photographs");
    for profiled in [false, true] {
        let open = if profiled { Context::profiled } else { Context::numbered };
        let context = Arc::new(open(number).expect("a device"));
        let mut model = mb_gpu::on(Arc::clone(&context)).model(&options, &data).expect("a model");
        let mut cameras = CameraResiduals::new(&options.cameras, &data);
        let start = Instant::now();
        let (mut clock, mut cpu) = (Instant::now(), ProcessTime::now());
        let (mut mse, mut rays, mut samples) = (0.0, 0, 0);
        let every = (steps / 10).max(1);
        for step in 0..steps {
            let report = model.step(&data, &mut cameras, step).expect("a step");
            mse += report.mse;
            rays += report.rays;
            samples += report.samples;
            if (step + 1).is_multiple_of(every) && !profiled {
                let [wall, cpu_ms] = [clock.elapsed(), cpu.elapsed()].map(|t| 1e3 * t.as_secs_f64() / every as f64);
                let psnr = psnr_db(mse / every as f64);
                println!(
                    "{method} {preset}, step {:6}: {wall:.2} ms, {cpu_ms:.2} CPU ms, {} rays, {} samples, {psnr:.2} dB",
                    step + 1,
                    rays as u64 / every,
                    samples as u64 / every,
                );
                (mse, rays, samples) = (0.0, 0, 0);
                (clock, cpu) = (Instant::now(), ProcessTime::now());
            }
        }
        let spent = context.spent();
        let milliseconds = |seconds: f64| 1e3 * seconds / steps as f64;
        if profiled {
            let all: f64 = spent.iter().map(|s| s.1).sum();
            println!(
                "{:.2} ms a step, {:.2} of them in kernels on {}",
                milliseconds(start.elapsed().as_secs_f64()),
                milliseconds(all),
                context.name
            );
            println!("| kernel | ms a step | runs a step |\n|---|---|---|");
            for (name, seconds, runs) in spent {
                println!("| {name} | {:.3} | {:.1} |", milliseconds(seconds), runs as f64 / steps as f64);
            }
        }
    }
}
