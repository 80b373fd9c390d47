//! Simulated photographs beside real ones: statistics, speed, and a sheet to look at.
//!
//! `cargo bench -p mb-simulate --bench photographs -- MESH.ply [SHEET.png] [TABLE ...]` takes two photographs of a model
//! (object frame, metres) on each table in standard quality, prints [`PhotoStatistics`] of them, and of the
//! real photographs at hand, at full size and averaged down to 720x540, and puts all of them side by side.

use cpu_time::ProcessTime;
use mb_geometry::ImageSize;
use mb_image::{Image, RgbImage};
use mb_job::Silent;
use mb_simulate::{PhotoStatistics, Quality, SimulateOptions, Table, simulate};

/// A column of the tables: a name and its photographs.
type Group = (String, Vec<RgbImage>);

/// Every photograph of a folder, at most `count`, evenly chosen, landscape.
fn read_all(folder: &std::path::Path, count: usize) -> Vec<RgbImage> {
    let mut paths: Vec<_> = std::fs::read_dir(folder).expect("a folder").map(|e| e.expect("an entry").path()).collect();
    paths.sort();
    let step = paths.len().div_ceil(count).max(1);
    let photos = paths.iter().step_by(step).map(|p| mb_image::read_rgb(p).expect("a photograph"));
    photos.map(|p| if p.width() < p.height() { p.rotated_clockwise(3) } else { p }).collect()
}

/// The photograph averaged down to `width` pixels.
fn averaged(photo: &RgbImage, width: usize) -> RgbImage {
    let size = ImageSize::new(width, photo.height() * width / photo.width());
    Image::from_fn(size, |x, y| {
        let span = |i: usize, small: usize, large: usize| i * large / small..((i + 1) * large / small).max(1);
        let (mut sum, mut count) = ([0u32; 3], 0);
        for v in span(y, size.height, photo.height()) {
            for u in span(x, size.width, photo.width()) {
                (0..3).for_each(|c| sum[c] += u32::from(photo[(u, v)][c]));
                count += 1;
            }
        }
        sum.map(|s| (s / count.max(1)) as u8)
    })
}

fn print_table(title: &str, groups: &[Group]) {
    println!("\n{title}\n{:20}{}", "", groups.iter().map(|g| format!("{:>12}", g.0)).collect::<String>());
    let columns: Vec<[f64; 20]> = groups
        .iter()
        .map(|(_, photos)| {
            let mut mean = [0.0; 20];
            for photo in photos {
                let values = PhotoStatistics::of(photo).expect("a large photograph").values();
                (0..20).for_each(|i| mean[i] += values[i] / photos.len() as f64);
            }
            mean
        })
        .collect();
    for (i, name) in PhotoStatistics::NAMES.iter().enumerate() {
        println!("{name:20}{}", columns.iter().map(|c| format!("{:12.3}", c[i])).collect::<String>());
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let Some(model) = arguments.first() else { return println!("give a mesh to photograph") };
    let sheet = arguments.get(1).cloned();
    let model = mb_mesh::read_mesh(model).expect("a mesh");
    let mut full: Vec<Group> = Vec::new();
    for name in ["mobilebrick_5frames", "mobilebrick-video"] {
        if let Some(root) = mb_testdata::find(name) {
            full.push((name.replace("mobilebrick", "real"), read_all(&root.join("image"), 5)));
        }
    }
    for (i, table) in Table::ALL.into_iter().enumerate() {
        let name = format!("{table:?}").to_lowercase();
        if arguments.len() > 2 && !arguments[2..].contains(&name) {
            continue;
        }
        let folder = tempfile::tempdir().expect("a folder");
        let options = SimulateOptions {
            frames: 2,
            quality: Quality::Standard,
            seed: 11 + i as u64,
            table: Some(table),
            elevations_deg: vec![38.0],
            ..SimulateOptions::default()
        };
        let start = ProcessTime::now();
        simulate(&model, &options, folder.path(), &Silent).expect("a capture");
        println!("{name}: two standard photographs in {:.1} CPU s", start.elapsed().as_secs_f64());
        full.push((name, read_all(&folder.path().join("image"), 2)));
    }
    let wide: Vec<Group> = full.iter().filter(|g| g.1[0].width() > 1000).cloned().collect();
    print_table("as stored, 1920x1440", &wide);
    let small: Vec<Group> =
        full.iter().map(|g| (g.0.clone(), g.1.iter().map(|p| averaged(p, 720)).collect())).collect();
    print_table("averaged down to 720 pixels", &small);
    if let Some(path) = sheet {
        // One row a group, two photographs each, upright.
        let (w, h) = (540, 720);
        let mut all = Image::filled(ImageSize::new(w * small.len(), 2 * h), [0u8; 3]);
        for (column, (_, photos)) in small.iter().enumerate() {
            for (row, photo) in photos.iter().take(2).enumerate() {
                let upright = photo.rotated_clockwise(1);
                for y in 0..h.min(upright.height()) {
                    for x in 0..w.min(upright.width()) {
                        all[(column * w + x, row * h + y)] = upright[(x, y)];
                    }
                }
            }
        }
        mb_image::write_rgb_png(&path, &all).expect("a sheet");
        println!("\nwrote {path}");
    }
}
