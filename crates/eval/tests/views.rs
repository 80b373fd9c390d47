//! Scores of views: reference values, laws, and input that is not as it should be.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::Path;

use mb_eval::{ColorImage, ViewsOptions, evaluate_views, evaluate_views_method, psnr_of_mse, similarity};
use mb_geometry::ImageSize;
use mb_image::{Image, Mask, write_depth_png, write_jpeg, write_mask_png, write_rgb_png};
use mb_job::Silent;
use proptest::prelude::*;
use serde_json::Value;

fn image_of(size: ImageSize, values: &[f32]) -> ColorImage {
    let mut values = values.iter().copied().cycle();
    Image::from_fn(size, |_, _| std::array::from_fn(|_| values.next().unwrap()))
}

/// An 8-bit test picture with edges, texture and flat parts.
fn picture(size: ImageSize, phase: usize) -> Image<[u8; 3]> {
    Image::from_fn(size, |x, y| {
        let texture = (x * 7 + y * 13 + phase * 5) % 64;
        [(x * 3 + phase) as u8, if x > y { 200 } else { (40 + texture) as u8 }, (y * 2) as u8]
    })
}

/// SSIM by its definition, one window after another, in f64.
fn ssim_by_definition(a: &ColorImage, b: &ColorImage, keep: impl Fn(usize, usize) -> bool) -> f64 {
    let (width, height) = (a.width() as isize, a.height() as isize);
    let gauss = |i: isize| (-((i * i) as f64) / (2.0 * 1.5 * 1.5)).exp();
    let total: f64 = (-5..=5).map(gauss).sum();
    let (mut sum, mut count) = (0.0, 0);
    for y in 0..height {
        for x in (0..width).filter(|&x| keep(x as usize, y as usize)) {
            for c in 0..3 {
                let mut moments = [0.0; 5];
                for (dy, dx) in (-5..=5).flat_map(|dy| (-5..=5).map(move |dx| (dy, dx))) {
                    let (sx, sy) = (x + dx, y + dy);
                    if sx < 0 || sy < 0 || sx >= width || sy >= height {
                        continue;
                    }
                    let weight = gauss(dx) * gauss(dy) / (total * total);
                    let at = (sx as usize, sy as usize);
                    let (p, q) = (f64::from(a[at][c]), f64::from(b[at][c]));
                    let terms = [p, q, p * p, q * q, p * q];
                    moments.iter_mut().zip(terms).for_each(|(m, t)| *m += weight * t);
                }
                let [p, q, pp, qq, pq] = moments;
                let (c1, c2) = (1e-4, 9e-4);
                sum += (2.0 * p * q + c1) * (2.0 * (pq - p * q) + c2)
                    / ((p * p + q * q + c1) * (pp - p * p + qq - q * q + c2));
                count += 1;
            }
        }
    }
    sum / f64::from(count)
}

#[test]
fn the_published_script_agrees() {
    let Some(folder) = mb_testdata::find("official_scorer/nvs") else { return };
    let expected: Value = serde_json::from_slice(&std::fs::read(folder.join("expected_nvs.json")).unwrap()).unwrap();
    let scores = evaluate_views(&folder, &folder, &ViewsOptions::default(), None, &Silent).unwrap();
    assert_eq!(scores.images, 1);
    assert_eq!(scores.per_image[0].name, "000000");
    assert!((scores.psnr - expected["pair"]["psnr"].as_f64().unwrap()).abs() < 5e-6, "{}", scores.psnr);
    // The published value is off by 3.0e-5 itself: it subtracts squares of means in f32. In f64 it is 0.65317165.
    assert!((scores.ssim - expected["pair"]["ssim"].as_f64().unwrap()).abs() < 5e-5, "{}", scores.ssim);
    assert!((scores.ssim - 0.65317165).abs() < 3e-6, "{}", scores.ssim);
    let document = serde_json::to_value(&scores).unwrap();
    assert_eq!(document["lpips"], Value::Null);
    assert!(document["warnings"][0].as_str().unwrap().contains("lpips is empty"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn ssim_is_what_its_definition_says(
        width in 1usize..40, height in 1usize..30,
        a in prop::collection::vec(0f32..1.0, 50..90), b in prop::collection::vec(0f32..1.0, 50..90),
    ) {
        let size = ImageSize::new(width, height);
        let (a, b) = (image_of(size, &a), image_of(size, &b));
        let found = similarity(&a, &b, None).unwrap();
        prop_assert!((found.ssim - ssim_by_definition(&a, &b, |_, _| true)).abs() < 2e-5);
        let mse = a.data().as_flattened().iter().zip(b.data().as_flattened())
            .map(|(p, q)| f64::from(p - q).powi(2)).sum::<f64>() / (3 * size.pixels()) as f64;
        prop_assert!((found.psnr + 10.0 * mse.log10()).abs() < 1e-4);
        // Both measures treat the two images alike.
        prop_assert_eq!(similarity(&b, &a, None).unwrap(), found);
    }

    #[test]
    fn an_image_is_like_itself(width in 1usize..60, height in 1usize..40, values in prop::collection::vec(0f32..1.0, 1..90)) {
        let image = image_of(ImageSize::new(width, height), &values);
        let found = similarity(&image, &image, None).unwrap();
        prop_assert_eq!(found.psnr, 100.0);
        prop_assert!((found.ssim - 1.0).abs() < 1e-6);
    }

    #[test]
    fn mirrored_images_score_the_same(
        width in 1usize..40, height in 1usize..30,
        a in prop::collection::vec(0f32..1.0, 50..90), b in prop::collection::vec(0f32..1.0, 50..90),
    ) {
        let size = ImageSize::new(width, height);
        let (a, b) = (image_of(size, &a), image_of(size, &b));
        let mirror = |image: &ColorImage| Image::from_fn(size, |x, y| image[(width - 1 - x, height - 1 - y)]);
        let (straight, mirrored) =
            (similarity(&a, &b, None).unwrap(), similarity(&mirror(&a), &mirror(&b), None).unwrap());
        prop_assert!((straight.ssim - mirrored.ssim).abs() < 1e-6);
        prop_assert!((straight.psnr - mirrored.psnr).abs() < 1e-4);
    }
}

/// Wider than a strip and higher than a band of the fast code, so that their seams lie inside.
#[test]
fn seams_of_the_fast_code_do_not_show() {
    let size = ImageSize::new(331, 203);
    let unit = |image: &Image<[u8; 3]>| image.map(|p| p.map(|v| f32::from(v) / 255.0));
    let (a, b) = (unit(&picture(size, 0)), unit(&picture(size, 9)));
    assert!((similarity(&a, &b, None).unwrap().ssim - ssim_by_definition(&a, &b, |_, _| true)).abs() < 1e-5);
    // Golden values of the protocol, computed in f64 with numpy.
    let golden = similarity(&a, &b, None).unwrap();
    assert!((golden.ssim - 0.8506558224836247).abs() < 1e-6, "{}", golden.ssim);
    assert!((golden.psnr - 19.888898720359236).abs() < 1e-5, "{}", golden.psnr);
    let mask = Mask::from_fn(size, |x, y| (x / 40 + y / 30) % 3 == 0);
    let found = similarity(&a, &b, Some(&mask)).unwrap();
    assert!((found.ssim - ssim_by_definition(&a, &b, |x, y| mask[(x, y)])).abs() < 1e-5);
}

#[test]
fn a_constant_difference_has_its_closed_form() {
    let size = ImageSize::new(50, 40);
    let (a, b) = (ColorImage::filled(size, [0.25; 3]), ColorImage::filled(size, [0.35; 3]));
    let found = similarity(&a, &b, None).unwrap();
    assert!((found.psnr - 20.0).abs() < 1e-5, "{}", found.psnr);
    // Away from the border the variances are zero, and the luminance term is all of SSIM.
    let mask = Mask::from_fn(size, |x, y| (5..45).contains(&x) && (5..35).contains(&y));
    let inside = similarity(&a, &b, Some(&mask)).unwrap().ssim;
    let luminance = (2.0 * 0.25 * 0.35 + 1e-4) / (0.25f64.powi(2) + 0.35f64.powi(2) + 1e-4);
    assert!((inside - luminance).abs() < 1e-5, "{inside} is not {luminance}");
    assert!(psnr_of_mse(f64::NAN).is_nan(), "NaN must not become a perfect score");
}

#[test]
fn threads_do_not_change_a_bit() {
    let size = ImageSize::new(200, 500);
    let unit = |image: &Image<[u8; 3]>| image.map(|p| p.map(|v| f32::from(v) / 255.0));
    let (a, b) = (unit(&picture(size, 0)), unit(&picture(size, 9)));
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| similarity(&a, &b, None).unwrap())
    };
    assert_eq!(with(1), with(4));
}

struct Folders {
    dir: tempfile::TempDir,
}

impl Folders {
    /// `count` images `000000.png`... in `gt`, and nothing in `pred`.
    fn with_gt(count: usize) -> Self {
        let folders = Self { dir: tempfile::tempdir().unwrap() };
        std::fs::create_dir(folders.path("pred")).unwrap();
        for i in 0..count {
            write_rgb_png(folders.path(&format!("gt/{i:06}.png")), &picture(ImageSize::new(32, 24), i)).unwrap();
        }
        folders
    }

    fn path(&self, relative: &str) -> std::path::PathBuf {
        self.dir.path().join(relative)
    }

    fn predict(&self, name: &str, phase: usize) {
        write_rgb_png(self.path("pred").join(name), &picture(ImageSize::new(32, 24), phase)).unwrap();
    }

    fn score(&self, options: &ViewsOptions) -> mb_job::Result<mb_eval::ViewsScores> {
        evaluate_views(&self.path("gt"), &self.path("pred"), options, None, &Silent)
    }

    fn refusal(&self) -> String {
        let error = self.score(&ViewsOptions::default()).unwrap_err();
        assert!(matches!(error, mb_job::Error::Input(_)), "{error:?}");
        error.to_string()
    }
}

#[test]
fn missing_and_unpaired_images_are_named_and_not_counted() {
    let folders = Folders::with_gt(4);
    folders.predict("000001.png", 1);
    folders.predict("000003.png", 3);
    folders.predict("000009.png", 0);
    let scores = folders.score(&ViewsOptions::default()).unwrap();
    assert_eq!((scores.images, scores.psnr), (2, 100.0));
    assert_eq!(scores.missing, ["000000", "000002"]);
    assert_eq!(scores.unpaired, ["000009"]);
    assert!(scores.warnings.iter().any(|w| w.contains("000000 and 000002")), "{:?}", scores.warnings);
}

#[test]
fn the_hold_out_takes_every_nth_ground_truth_image() {
    let folders = Folders::with_gt(10);
    for i in 0..10 {
        folders.predict(&format!("{i:06}.png"), i + usize::from(i % 4 != 0));
    }
    let held_out = ViewsOptions { hold_out: Some(4), ..Default::default() };
    let scores = folders.score(&held_out).unwrap();
    let names: Vec<&str> = scores.per_image.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["000000", "000004", "000008"]);
    assert_eq!(scores.psnr, 100.0);
    std::fs::remove_file(folders.path("pred/000004.png")).unwrap();
    assert_eq!(folders.score(&held_out).unwrap().missing, ["000004"]);
}

#[test]
fn jpeg_is_paired_with_png_and_grey_with_colour() {
    let folders = Folders::with_gt(1);
    write_jpeg(folders.path("pred/000000.jpg"), &picture(ImageSize::new(32, 24), 0), 95).unwrap();
    let scores = folders.score(&ViewsOptions::default()).unwrap();
    assert!(scores.psnr > 20.0 && scores.psnr < 100.0, "{}", scores.psnr);

    let folders = Folders::with_gt(0);
    let grey = Image::from_fn(ImageSize::new(16, 16), |x, y| (x * 16 + y) as u8);
    write_rgb_png(folders.path("gt/a.png"), &grey.map(|&v| [v; 3])).unwrap();
    image_of_kind(&folders.path("pred/a.png"), &grey, image::ExtendedColorType::L8, |v| vec![v]);
    assert_eq!(folders.score(&ViewsOptions::default()).unwrap().psnr, 100.0);
    // 16 bits: 257 v / 65535 = v / 255.
    image_of_kind(&folders.path("pred/a.png"), &grey, image::ExtendedColorType::L16, |v| {
        (u16::from(v) * 257).to_ne_bytes().to_vec()
    });
    assert_eq!(folders.score(&ViewsOptions::default()).unwrap().psnr, 100.0);
    // Opaque alpha says nothing; a transparent pixel has no colour.
    image_of_kind(&folders.path("pred/a.png"), &grey, image::ExtendedColorType::Rgba8, |v| vec![v, v, v, 255]);
    assert_eq!(folders.score(&ViewsOptions::default()).unwrap().psnr, 100.0);
    image_of_kind(&folders.path("pred/a.png"), &grey, image::ExtendedColorType::Rgba8, |v| vec![v, v, v, v | 0xf0]);
    let message = folders.refusal();
    assert!(message.contains("transparent") && message.contains("pixel (0, 0)"), "{message}");
}

fn image_of_kind(path: &Path, grey: &Image<u8>, kind: image::ExtendedColorType, pixel: impl Fn(u8) -> Vec<u8>) {
    let bytes: Vec<u8> = grey.data().iter().flat_map(|&v| pixel(v)).collect();
    image::save_buffer(path, &bytes, grey.width() as u32, grey.height() as u32, kind).unwrap();
}

#[test]
fn sixteen_bits_are_not_rounded_to_eight() {
    let folders = Folders::with_gt(0);
    let size = ImageSize::new(16, 16);
    // Steps of one 16-bit unit, which 8 bits cannot tell apart.
    let depth = |offset: f32| Image::from_fn(size, move |x, _| (30_000.0 + x as f32 + offset) * 1e-3);
    write_depth_png(folders.path("gt/a.png"), &depth(0.0)).unwrap();
    write_depth_png(folders.path("pred/a.png"), &depth(2.0)).unwrap();
    let psnr = folders.score(&ViewsOptions::default()).unwrap().psnr;
    assert!((psnr + 20.0 * (2.0f64 / 65535.0).log10()).abs() < 0.01, "{psnr}");
}

#[test]
fn a_mask_leaves_its_black_pixels_out() {
    let folders = Folders::with_gt(1);
    let mut pred = picture(ImageSize::new(32, 24), 0);
    for x in 0..16 {
        pred[(x, 3)] = [0, 255, 0];
    }
    write_rgb_png(folders.path("pred/000000.png"), &pred).unwrap();
    let masks = folders.path("mask");
    write_mask_png(masks.join("000000.png"), &Mask::from_fn(ImageSize::new(32, 24), |_, y| y > 12)).unwrap();
    let masked = ViewsOptions { masks: Some(masks.clone()), ..Default::default() };
    assert!(folders.score(&ViewsOptions::default()).unwrap().psnr < 30.0);
    assert_eq!(folders.score(&masked).unwrap().psnr, 100.0);
    write_mask_png(masks.join("000000.png"), &Mask::filled(ImageSize::new(32, 24), false)).unwrap();
    assert!(folders.score(&masked).unwrap_err().to_string().contains("mask leaves no pixel"));
    write_mask_png(masks.join("000000.png"), &Mask::filled(ImageSize::new(8, 8), true)).unwrap();
    assert!(folders.score(&masked).unwrap_err().to_string().contains("8x8"));
}

#[test]
fn bad_input_is_named() {
    let folders = Folders::with_gt(2);
    assert!(folders.refusal().contains("no image"));
    folders.predict("another.png", 0);
    assert!(folders.refusal().contains("no file name in common"));
    write_rgb_png(folders.path("pred/000001.png"), &picture(ImageSize::new(31, 24), 0)).unwrap();
    let message = folders.refusal();
    assert!(message.contains("31x24") && message.contains("32x24") && message.contains("000001.png"), "{message}");
    folders.predict("000001.png", 0);
    write_jpeg(folders.path("pred/000001.jpg"), &picture(ImageSize::new(32, 24), 0), 90).unwrap();
    assert!(folders.refusal().contains("Keep one of the two"));
    std::fs::remove_file(folders.path("pred/000001.jpg")).unwrap();
    let whole = std::fs::read(folders.path("pred/000001.png")).unwrap();
    std::fs::write(folders.path("pred/000001.png"), &whole[..whole.len() / 2]).unwrap();
    assert!(folders.refusal().contains("damaged"));
    assert!(
        evaluate_views(&folders.path("none"), &folders.path("pred"), &ViewsOptions::default(), None, &Silent).is_err()
    );
}

#[test]
fn a_method_in_the_published_layout_becomes_a_table() {
    let folders = Folders::with_gt(0);
    let size = ImageSize::new(24, 24);
    for (sequence, images) in [("boat", 1), ("jeep", 3)] {
        for i in 0..images {
            let at = |kind| folders.path(&format!("nvs/ours/{sequence}/{kind}_{i:06}.png"));
            write_rgb_png(at("gt"), &picture(size, 0)).unwrap();
            write_rgb_png(at("render"), &picture(size, if sequence == "boat" { 3 } else { 0 })).unwrap();
        }
    }
    let list = ["boat", "porsche", "jeep"].map(str::to_owned);
    let table =
        evaluate_views_method(&folders.path("nvs/ours"), &list, &ViewsOptions::default(), None, &Silent).unwrap();
    assert_eq!((table.method.as_str(), table.images), ("ours", 4));
    assert_eq!(table.missing_sequences, ["porsche"]);
    let boat = table.per_sequence[0].scores.psnr;
    assert!(boat < 50.0);
    assert!((table.psnr - (boat + 300.0) / 4.0).abs() < 1e-9, "the published mean is over images");
    let csv = table.to_csv(&list);
    let rows: Vec<Vec<&str>> = csv.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(rows.len(), 4);
    assert_eq!(rows[0], ["boat", "porsche", "jeep"]);
    assert_eq!(rows[1][1..], ["", "100"]);
    assert_eq!(rows[3], ["", "", ""]);
}
