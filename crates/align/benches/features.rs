//! CPU time of `detect_features`, and its features for comparison with OpenCV's.
//!
//! `cargo bench -p mb-align --bench features -- FOLDER UPSAMPLE IMAGE...` writes, for each image, `FOLDER/NAME.txt` with
//! one feature a line (x, y, scale, angle, contrast, 128 bytes of descriptor), from which `benches/opencv_sift.py` compares
//! repeatability, accuracy and time. UPSAMPLE is `yes` or `no`.

use std::fmt::Write as _;
use std::path::Path;

use cpu_time::ProcessTime;
use mb_align::{FeatureOptions, detect_features};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let [folder, upsample, images @ ..] = arguments.as_slice() else {
        println!("usage: features FOLDER UPSAMPLE IMAGE...");
        return;
    };
    let options = FeatureOptions { upsample: upsample == "yes", ..FeatureOptions::default() };
    let (mut seconds, mut count) = (0.0, 0);
    for path in images.iter().map(Path::new) {
        let image = mb_image::read_rgb(path).expect("an image");
        let start = ProcessTime::now();
        let features = detect_features(&image, &options);
        seconds += start.elapsed().as_secs_f64();
        count += features.len();
        let mut text = String::new();
        for f in &features {
            let _ = write!(text, "{} {} {} {} {}", f.pixel.x, f.pixel.y, f.scale_px, f.angle_rad, f.contrast);
            f.descriptor.iter().for_each(|d| _ = write!(text, " {d}"));
            text.push('\n');
        }
        let name = path.with_extension("txt");
        let name = name.file_name().expect("a file");
        mb_job::write_atomic(Path::new(folder).join(name), text.as_bytes()).expect("the features can be written");
    }
    let n = images.len().max(1);
    println!("{n} images, {} features an image, {:.3} CPU s an image", count / n, seconds / n as f64);
}
