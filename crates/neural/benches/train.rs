//! Trains a method on a sequence and prints its curve: `cargo bench -p mb-neural --bench train -- SEQ METHOD STEPS
//! MAX_SIDE_PX OUT [OPTIONS]`. Every twentieth of the run: wall and CPU seconds, PSNR of the training rays, PSNR of the
//! held-out views on every 61st pixel (its time is not counted), and what a step took on average since the row before
//! (`pytorch_methods.py` beside this file takes as many rays and samples; light reaches the lit ones). At the end the
//! held-out views in full, each written to OUT beside its photograph. OPTIONS is JSON that replaces options of the
//! preset, such as `{"samples_per_step": 32768}`; `"cameras"` and `"data"` in it replace those.

use std::time::Instant;

use cpu_time::ProcessTime;
use mb_capture::Sequence;
use mb_image::Image;
use mb_job::Silent;
use mb_neural::FieldOptions;
use mb_neural::cameras::CameraResiduals;
use mb_neural::dataset::RayDataset;
use mb_neural::model::Model;
use mb_neural::trainer::{image_psnr_db, psnr_db, render_view};
use serde_json::Value;

/// Replaces what `patch` names, inside objects.
fn merge(into: &mut Value, patch: &Value) {
    match (into, patch) {
        (Value::Object(into), Value::Object(patch)) => {
            for (key, value) in patch {
                merge(into.entry(key.clone()).or_insert(Value::Null), value);
            }
        }
        (into, patch) => *into = patch.clone(),
    }
}

/// PSNR of the held-out views on every 61st pixel.
fn quick_psnr_db(model: &dyn Model, data: &RayDataset, cameras: &CameraResiduals) -> f64 {
    let views: Vec<_> = data.views().iter().enumerate().filter(|(_, v)| v.held_out).collect();
    let sum: f64 = views
        .iter()
        .map(|(index, view)| {
            let pixels: Vec<(usize, usize)> =
                (0..view.size().pixels()).step_by(61).map(|i| (i % view.size().width, i / view.size().width)).collect();
            let rays: Vec<_> = pixels.iter().map(|(x, y)| cameras.ray(view, *index, [*x as f32, *y as f32])).collect();
            let colors = model.render(&rays);
            let shown = view.shown(model.only_object());
            let squared: f64 = colors
                .iter()
                .zip(&pixels)
                .flat_map(|(c, p)| c.iter().zip(shown[*p]).map(|(a, b)| f64::from(a - f32::from(b) / 255.0).powi(2)))
                .sum();
            psnr_db(squared / (3 * pixels.len()) as f64)
        })
        .sum();
    sum / views.len().max(1) as f64
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let [sequence, method, steps, max_side, out, rest @ ..] = arguments.as_slice() else {
        println!("nothing to do: give SEQ METHOD STEPS MAX_SIDE_PX OUT [OPTIONS]");
        return;
    };
    let steps: u64 = steps.parse().expect("a number of steps");
    let options = FieldOptions::preset(method, "fast", 0).expect("a known method").with_iterations(steps);
    let mut json = serde_json::to_value(&options).expect("options are plain data");
    if let Some(patch) = rest.first() {
        let patch: Value = serde_json::from_str(patch).expect("JSON");
        for (key, value) in patch.as_object().expect("an object") {
            match key.as_str() {
                "data" | "cameras" => merge(&mut json[key], value),
                _ => merge(&mut json["method"][method][key], value),
            }
        }
    }
    json["data"]["max_side_px"] = max_side.parse::<usize>().expect("a number of pixels").into();
    let options: FieldOptions = serde_json::from_value(json).expect("options as the method has them");
    let sequence = Sequence::open(sequence).expect("a sequence");
    let data = RayDataset::open(&sequence, &options.data, &Silent).expect("photographs");
    println!("{} views, region {:?}", data.views().len(), data.region());
    let mut model = options.model(&data);
    let mut cameras = CameraResiduals::new(&options.cameras, &data);
    println!("{} parameters, {} MiB", model.parameter_count(), (model.bytes() + data.bytes()) >> 20);
    let (mut wall, mut cpu) = (0.0, 0.0);
    let (mut mse, mut rays, mut samples, mut lit, mut before) = (0.0, 0, 0, 0, (0.0, 0.0));
    let every = (steps / 20).max(1);
    for step in 0..steps {
        let (clock, cpu_clock) = (Instant::now(), ProcessTime::now());
        let report = model.step(&data, &mut cameras, step).expect("a step");
        wall += clock.elapsed().as_secs_f64();
        cpu += cpu_clock.elapsed().as_secs_f64();
        mse += report.mse;
        rays += report.rays;
        samples += report.samples;
        lit += report.lit;
        if (step + 1).is_multiple_of(every) {
            println!(
                "step {:6}  {wall:6.1} s wall {cpu:6.1} s CPU  train {:.2} dB  held out {:.2} dB  loss {:.5}  \
                 a step: {} rays, {} samples, {} lit, {:.4} CPU s, {:.4} wall s  cameras {:?}",
                step + 1,
                psnr_db(mse / every as f64),
                quick_psnr_db(model.as_ref(), &data, &cameras),
                report.loss,
                rays as u64 / every,
                samples as u64 / every,
                lit as u64 / every,
                (cpu - before.1) / every as f64,
                (wall - before.0) / every as f64,
                cameras.size(),
            );
            (mse, rays, samples, lit, before) = (0.0, 0, 0, 0, (wall, cpu));
        }
    }
    let mut sum = 0.0;
    let held_out: Vec<_> = data.views().iter().enumerate().filter(|(_, v)| v.held_out).collect();
    for (index, view) in &held_out {
        let image = render_view(model.as_ref(), view, *index, &cameras);
        let shown = view.shown(model.only_object());
        sum += image_psnr_db(&image, &shown);
        let size = mb_geometry::ImageSize::new(2 * view.size().width, view.size().height);
        let pair =
            Image::from_fn(
                size,
                |x, y| {
                    if x < view.size().width { image[(x, y)] } else { shown[(x - view.size().width, y)] }
                },
            );
        mb_image::write_rgb_png(std::path::Path::new(out).join(format!("{}.png", view.frame)), &pair)
            .expect("a picture is written");
    }
    println!("held out: {:.2} dB over {} views", sum / held_out.len().max(1) as f64, held_out.len());
}
