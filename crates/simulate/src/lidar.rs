//! The phone's depth: a few hundred laser dots, spread over the frame with the photograph as a guide.
//!
//! Each dot measures the mean distance over its footprint, with errors that belong to the surface (they stay when the
//! phone comes back) and errors of the moment. Between dots the phone's network fills in smooth surfaces that follow
//! the edges of the photograph as far as it can tell them. Here that is a weighted plane fit in inverse depth (planes
//! of the scene are planes there) with weights of distance and colour. What is smaller than a dot's distance is lost,
//! and edges bleed.

use glam::Vec3;
use mb_geometry::{Camera, ImageSize, Intrinsics, Object, Rigid3};
use mb_image::{Confidence, DepthImage, Image, RgbImage};
use mb_job::rng;
use mb_render::View;
use nalgebra::{Matrix3, Point2, Vector3};
use rand::RngExt;
use rayon::prelude::*;

use crate::develop::blurred;
use crate::random::{hash, noise, noise3, normal};
use crate::stage::{Stage, vec3};
use crate::streams;

/// Size of the phone's depth maps in landscape.
const DEPTH_SIZE: ImageSize = ImageSize::new(256, 192);
/// Dots along the longer and the shorter side.
const DOTS: (usize, usize) = (28, 21);
/// Standard deviation of a dot's momentary error, metres, at any indoor distance.
const JITTER_M: f64 = 0.003;
/// Amplitude of errors that belong to the surface, metres, and their size in space.
const SURFACE_M: f64 = 0.0065;
const SURFACE_SIZE_M: f32 = 0.05;
/// Doubt where no dot speaks.
const NO_TRUST: f32 = 2.0;
/// Range beyond which a dot returns nothing.
const RANGE_M: f64 = 5.0;

struct Dot {
    /// Pixel of the depth map.
    pixel: (f64, f64),
    /// Inverse of the measured depth, 1/m.
    inverse_depth: f64,
    color: Vec3,
    /// Spread of true inverse depth over the footprint, relative: large on edges.
    spread: f64,
    /// Brightness of the return, 0 to 1.
    strength: f64,
}

/// Size of the depth maps beside photographs of `size`: the phone's, turned like the photograph.
pub(crate) fn depth_size(size: ImageSize) -> ImageSize {
    if size.width >= size.height { DEPTH_SIZE } else { ImageSize::new(DEPTH_SIZE.height, DEPTH_SIZE.width) }
}

/// Measures depth with its confidence, 256x192 (192x256 beside portrait photographs).
pub(crate) fn measure(
    stage: &Stage,
    intrinsics: &Intrinsics,
    photo: &RgbImage,
    object_from_cam: &Rigid3<Object, Camera>,
    seed: u64,
    frame: u64,
) -> (DepthImage, Confidence) {
    let size = depth_size(photo.size());
    let view =
        View { intrinsics: intrinsics.resized(photo.size(), size), size, cam_from_frame: object_from_cam.inverse() };
    let exact = stage.scene.render(&view);
    let guide = shrink(photo, size);
    let mut rng = rng(seed, streams::LIDAR + frame);
    // The scale of a frame is off by a little, as a whole.
    let frame_scale = 1.0 + 0.005 * normal(&mut rng);

    let (columns, rows) = if size.width >= size.height { DOTS } else { (DOTS.1, DOTS.0) };
    let pitch = (size.width as f64 / columns as f64, size.height as f64 / rows as f64);
    let mut dots = Vec::with_capacity(columns * rows);
    for row in 0..rows {
        for column in 0..columns {
            // Rows of dots are staggered.
            let stagger = 0.25 - 0.5 * (row % 2) as f64;
            let x = (column as f64 + 0.5 + stagger) * pitch.0 - 0.5;
            let y = (row as f64 + 0.5) * pitch.1 - 0.5;
            // Drawn for every dot, so that a missing return does not shift the others' noise.
            let (jitter, lost) = (normal(&mut rng), rng.random::<f64>());
            let (cx, cy) = (x.round().clamp(0.0, size.width as f64 - 1.0) as usize, y.round() as usize);
            let footprint: Vec<f64> = (cy.saturating_sub(1)..(cy + 2).min(size.height))
                .flat_map(|v| (cx.saturating_sub(1)..(cx + 2).min(size.width)).map(move |u| (u, v)))
                .map(|at| f64::from(exact.depth[at]))
                .filter(|z| *z > 0.0)
                .collect();
            if footprint.is_empty() || exact.depth[(cx, cy)] <= 0.0 {
                continue;
            }
            let mean = footprint.iter().sum::<f64>() / footprint.len() as f64;
            let (near, far) = footprint.iter().fold((f64::MAX, 0.0f64), |(a, b), z| (a.min(*z), b.max(*z)));
            let p = view.intrinsics.cam_from_img(&Point2::new(cx as f64, cy as f64), mean);
            let place = vec3(&(*object_from_cam * p));
            let camera = object_from_cam.translation();
            let towards = (Vec3::new(camera.x as f32, camera.y as f32, camera.z as f32) - place).normalize();
            let surface = stage.surface(exact.triangle[(cx, cy)], place, towards, (mean / view.intrinsics.fx) as f32);
            let facing = f64::from(surface.normal.dot(towards).max(0.0));
            let bright = f64::from(surface.finish.albedo.element_sum() / 3.0);
            let strength = (facing * (0.15 + bright) / (mean * mean).max(0.04) * 0.5).min(1.0);
            if mean > RANGE_M || lost < 0.25 * (1.0 - strength / 0.06).max(0.0) {
                continue;
            }
            // Light enters plastic a little before it returns, more where the surface is dark or seen at a slant.
            let of_surface = f64::from(noise3(place / SURFACE_SIZE_M, seed as u32))
                + 0.5 * f64::from(noise3(place / (0.4 * SURFACE_SIZE_M), seed as u32 ^ 7));
            let slant = 0.002 * (1.0 - facing) + 0.0015 * (1.0 - bright);
            let z = mean * frame_scale
                + SURFACE_M * of_surface
                + slant
                + JITTER_M * jitter * (1.0 + 0.5 * (0.1 / strength.max(0.02)).min(3.0));
            dots.push(Dot {
                pixel: (x, y),
                inverse_depth: 1.0 / z.max(0.05),
                color: guide[(cx, cy)],
                spread: (far - near) / mean,
                strength,
            });
        }
    }
    spread_out(&dots, &guide, size, pitch.0, hash(frame as i32, seed as i32, 91))
}

/// The photograph, averaged to the size of the depth map, 0 to 1.
fn shrink(photo: &RgbImage, size: ImageSize) -> Image<Vec3> {
    Image::from_fn(size, |x, y| {
        let span = |i: usize, small: usize, large: usize| {
            let low = i * large / small;
            low..((i + 1) * large / small).clamp(low + 1, large.max(low + 1))
        };
        let (mut sum, mut count) = (Vec3::ZERO, 0.0);
        for v in span(y, size.height, photo.height()) {
            for u in span(x, size.width, photo.width()) {
                if let Some(p) = photo.get(u, v) {
                    sum += Vec3::from(p.map(f32::from));
                    count += 255.0;
                }
            }
        }
        if count > 0.0 { sum / count } else { Vec3::ZERO }
    })
}

/// Fills the depth map from the dots.
fn spread_out(dots: &[Dot], guide: &Image<Vec3>, size: ImageSize, pitch: f64, salt: u32) -> (DepthImage, Confidence) {
    // Dots by cell of one pitch, so that a pixel looks at its neighbourhood alone.
    let cells = (size.width as f64 / pitch).ceil() as usize + 1;
    let cell_rows = (size.height as f64 / pitch).ceil() as usize + 1;
    let mut by_cell: Vec<Vec<usize>> = vec![Vec::new(); cells * cell_rows];
    let cell = |v: f64, count: usize| ((v / pitch).max(0.0) as usize).min(count - 1);
    for (i, dot) in dots.iter().enumerate() {
        by_cell[cell(dot.pixel.1, cell_rows) * cells + cell(dot.pixel.0, cells)].push(i);
    }
    let filled: Vec<(f32, f32)> = (0..size.pixels())
        .into_par_iter()
        .map(|i| {
            let (x, y) = ((i % size.width) as f64, (i / size.width) as f64);
            let color = guide[(i % size.width, i / size.width)];
            let mut normal_matrix = Matrix3::<f64>::zeros();
            let mut right = Vector3::<f64>::zeros();
            let (mut total, mut mean, mut square, mut spread, mut strength) = (0.0, 0.0, 0.0, 0.0, 0.0);
            let (ci, cj) = (cell(x, cells), cell(y, cell_rows));
            for j in cj.saturating_sub(2)..(cj + 3).min(cell_rows) {
                for i in ci.saturating_sub(2)..(ci + 3).min(cells) {
                    for &d in &by_cell[j * cells + i] {
                        let dot = &dots[d];
                        let (dx, dy) = ((dot.pixel.0 - x) / pitch, (dot.pixel.1 - y) / pitch);
                        let off_color = f64::from((dot.color - color).length());
                        // Colour guides, but cannot cut: some of the weight always stays.
                        let alike = 0.08 + 0.92 * (-0.5 * (off_color / 0.12).powi(2)).exp();
                        let weight = (-0.5 * (dx * dx + dy * dy) / (0.95 * 0.95)).exp() * alike;
                        let row = Vector3::new(1.0, dx, dy);
                        normal_matrix += row * row.transpose() * weight;
                        right += row * (weight * dot.inverse_depth);
                        total += weight;
                        mean += weight * dot.inverse_depth;
                        square += weight * dot.inverse_depth * dot.inverse_depth;
                        spread += weight * dot.spread;
                        strength += weight * dot.strength;
                    }
                }
            }
            if total < 0.05 {
                return (0.0, NO_TRUST);
            }
            mean /= total;
            let deviation = (square / total - mean * mean).max(0.0).sqrt();
            // A ridge on the slopes keeps the fit tame where dots are few or lie on one line.
            normal_matrix[(1, 1)] += 0.02 * total;
            normal_matrix[(2, 2)] += 0.02 * total;
            let fitted = normal_matrix.cholesky().map_or(mean, |c| c.solve(&right)[0]);
            // Never beyond what the dots saw.
            let inverse_depth = fitted.clamp(mean - 1.5 * deviation, mean + 1.5 * deviation);
            let (spread, strength) = (spread / total, strength / total);
            // Towards the border fewer and fewer dots speak.
            let border = x.min(y).min(size.width as f64 - 1.0 - x).min(size.height as f64 - 1.0 - y) / pitch;
            let fray = 0.7 * f64::from(noise((x / pitch) as f32, (y / pitch) as f32, salt));
            let doubt = spread * 6.0
                + deviation / mean * 2.0
                + (0.02 / strength.max(0.004)).min(1.0)
                + 1.6 * (0.35 + fray - border).max(0.0);
            ((1.0 / inverse_depth.max(1e-3)) as f32, doubt as f32)
        })
        .collect();
    let (depth, doubt): (Vec<f32>, Vec<f32>) = filled.into_iter().unzip();
    let doubt = Image::from_data(size, doubt).expect("one doubt for each pixel");
    // Trust is decided by regions, not by pixels.
    let confidence = blurred(&doubt, 0.2 * pitch as f32).map(|doubt| match doubt {
        d if *d < 0.65 => 2,
        d if *d < 1.1 => 1,
        _ => 0,
    });
    let depth = DepthImage::from_data(size, depth).expect("one depth for each pixel");
    (depth, confidence)
}
