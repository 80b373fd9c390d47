//! Golden scores of views, depth and poses: if one of these moves, its protocol needs a new name. Surfaces have theirs
//! in `surface.rs`, where the box that they score is made.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use mb_capture::FrameId;
use mb_eval::{
    DEPTH_PROTOCOL, DepthOptions, POSES_PROTOCOL, PosePair, VIEWS_PROTOCOL, ViewsOptions, evaluate_views, score_depth,
    score_poses,
};
use mb_geometry::{Camera, ImageSize, Rigid3, World};
use mb_image::{Image, write_rgb_png};
use mb_job::Silent;
use nalgebra::Vector6;
use serde::Serialize;
use serde_json::Value;

/// `key: value` of every number of a document, six digits each.
fn numbers(document: &impl Serialize) -> String {
    fn walk(prefix: &str, value: &Value, lines: &mut Vec<String>) {
        match value {
            Value::Number(n) => lines.push(format!("{prefix}: {:.6}", n.as_f64().unwrap())),
            Value::Array(items) => {
                items.iter().enumerate().for_each(|(i, v)| walk(&format!("{prefix}[{i}]"), v, lines));
            }
            Value::Object(entries) => {
                let dot = if prefix.is_empty() { "" } else { "." };
                entries.iter().for_each(|(key, v)| walk(&format!("{prefix}{dot}{key}"), v, lines));
            }
            Value::Null | Value::Bool(_) | Value::String(_) => {}
        }
    }
    let mut lines = Vec::new();
    walk("", &serde_json::to_value(document).unwrap(), &mut lines);
    lines.join("\n")
}

#[test]
fn views() {
    let dir = tempfile::tempdir().unwrap();
    let size = ImageSize::new(61, 43);
    for i in 0..2 {
        let photo = Image::from_fn(size, |x, y| [(x * 4) as u8, if x > y { 200 } else { 40 }, (x * y + 31 * i) as u8]);
        let render = photo.map(|&[r, g, b]| [r.saturating_add(9), g, (b / 8) * 8]);
        write_rgb_png(dir.path().join(format!("gt_{i:06}.png")), &photo).unwrap();
        write_rgb_png(dir.path().join(format!("render_{i:06}.png")), &render).unwrap();
    }
    let scores = evaluate_views(dir.path(), dir.path(), &ViewsOptions::default(), None, &Silent).unwrap();
    insta::assert_snapshot!(format!("golden_{VIEWS_PROTOCOL}"), numbers(&scores));
}

#[test]
fn depth() {
    let size = ImageSize::new(24, 18);
    let step = |x: usize| if x < 12 { 0.4 } else { 0.55 };
    let gt = Image::from_fn(size, |x, y| if y == 0 { 0.0 } else { step(x) + 0.001 * y as f64 });
    let pred = Image::from_fn(size, |x, y| if x == 3 { 0.0 } else { gt[(x, y)] * (0.9 + 0.02 * x as f64) });
    let scores = score_depth(&[(gt, pred)], &DepthOptions::default()).unwrap();
    insta::assert_snapshot!(format!("golden_{DEPTH_PROTOCOL}"), numbers(&scores));
}

#[test]
fn poses() {
    let pairs: Vec<PosePair> = (0..5)
        .map(|i| {
            let t = f64::from(i);
            let gt_world_from_cam =
                Rigid3::<World, Camera>::exp(&Vector6::new(0.1 * t, -0.3, 0.02 * t, 0.05 * t, 0.2, -0.01 * t * t));
            let drift =
                Rigid3::<World, World>::exp(&Vector6::new(0.002 * t, 0.0, 0.001, 0.0005 * t * t, 0.001, -0.002 * t));
            PosePair { frame: FrameId(i), gt_world_from_cam, pred_world_from_cam: drift * gt_world_from_cam }
        })
        .collect();
    insta::assert_snapshot!(format!("golden_{POSES_PROTOCOL}"), numbers(&score_poses(&pairs, None).unwrap()));
}
