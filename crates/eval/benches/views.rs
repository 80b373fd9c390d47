//! CPU seconds of PSNR and SSIM of two full-size images in memory.
//!
//! `cargo bench -p mb-eval --bench views`

use std::time::Instant;

use cpu_time::ProcessTime;
use mb_eval::{ColorImage, similarity};
use mb_geometry::ImageSize;

fn main() {
    let image = |phase: usize| {
        ColorImage::from_fn(ImageSize::new(1920, 1440), |x, y| {
            std::array::from_fn(|c| ((x * 7 + y * 13 + c * 31 + phase * (x / 50 % 3)) % 256) as f32 / 255.0)
        })
    };
    let (a, b) = (image(0), image(3));
    let mut best = (f64::INFINITY, f64::INFINITY);
    for _ in 0..15 {
        let (cpu, wall) = (ProcessTime::now(), Instant::now());
        let found = similarity(&a, &b, None);
        best = (best.0.min(cpu.elapsed().as_secs_f64()), best.1.min(wall.elapsed().as_secs_f64()));
        assert!(found.is_some());
    }
    println!("psnr and ssim, 1920x1440: {:.1} ms CPU, {:.1} ms wall", best.0 * 1e3, best.1 * 1e3);
}
