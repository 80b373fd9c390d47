//! Trains a method on a sequence and prints its curve: `cargo bench -p mb-neural --bench train -- SEQ METHOD [STEPS]
//! [MAX_SIDE_PX] [OUT]`. Wall and CPU seconds, PSNR of training and held-out views; with OUT, a render of each held-out
//! view beside its photograph.

use cpu_time::ProcessTime;
use mb_capture::Sequence;
use mb_job::Silent;
use mb_neural::dataset::{DataOptions, RayDataset};
use mb_neural::model::Model;
use mb_neural::nerf::{Nerf, NerfOptions};
use mb_neural::neus::{Neus, NeusOptions};
use mb_neural::trainer::{image_psnr_db, psnr_db, render_view};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let [sequence, method, rest @ ..] = arguments.as_slice() else {
        println!("nothing to do: give a sequence folder and a method");
        return;
    };
    let number = |i: usize, default: usize| rest.get(i).map_or(default, |v: &String| v.parse().expect("a number"));
    let steps = number(0, 1000) as u64;
    let data = DataOptions { max_side_px: number(1, 360), ..DataOptions::default() };
    let sequence = Sequence::open(sequence).expect("a sequence");
    let data = RayDataset::open(&sequence, &data, &Silent).expect("photographs");
    println!("{} views, region {:?}", data.views().len(), data.region());
    let mut model: Box<dyn Model> = match method.as_str() {
        "nerf" => Box::new(Nerf::new(NerfOptions::default().with_iterations(steps))),
        "neus" => Box::new(Neus::new(NeusOptions::default().with_iterations(steps), &data)),
        other => panic!("no method {other}"),
    };
    let (clock, cpu) = (std::time::Instant::now(), ProcessTime::now());
    let (mut mse, mut rays, mut samples) = (0.0, 0, 0);
    let every = (steps / 20).max(1);
    for step in 0..steps {
        let report = model.step(&data, step);
        mse += report.mse;
        rays += report.rays;
        samples += report.samples;
        if (step + 1).is_multiple_of(every) {
            println!(
                "step {:6}  {:6.1} s wall {:6.1} s CPU  train {:.2} dB  loss {:.5}  {:.1} samples/ray  {:.0} k samples/CPU s",
                step + 1,
                clock.elapsed().as_secs_f64(),
                cpu.elapsed().as_secs_f64(),
                psnr_db(mse / every as f64),
                report.loss,
                samples as f64 / rays as f64,
                samples as f64 / every as f64 * (step + 1) as f64 / cpu.elapsed().as_secs_f64() / 1e3,
            );
            (mse, rays, samples) = (0.0, 0, 0);
        }
    }
    let mut sum = 0.0;
    let held_out: Vec<_> = data.held_out().collect();
    for view in &held_out {
        let image = render_view(model.as_ref(), view);
        sum += image_psnr_db(&image, &view.rgb);
        if let Some(out) = rest.get(2) {
            let size = mb_geometry::ImageSize::new(2 * view.size().width, view.size().height);
            let pair = mb_image::Image::from_fn(size, |x, y| {
                if x < view.size().width { image[(x, y)] } else { view.rgb[(x - view.size().width, y)] }
            });
            mb_image::write_rgb_png(std::path::Path::new(out).join(format!("{}.png", view.frame)), &pair)
                .expect("a picture is written");
        }
    }
    println!("held out: {:.2} dB over {} views", sum / held_out.len() as f64, held_out.len());
}
