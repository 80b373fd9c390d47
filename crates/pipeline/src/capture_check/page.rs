//! The page of a check: where the cameras were, what the photographs and the depth show, and what is wrong.

use std::collections::{BTreeMap, BTreeSet};

use mb_capture::{Frame, FrameId, Sequence};
use mb_image::{DepthImage, RgbImage};
use mb_job::{Progress, Result, Steps};
use mb_render::heat_colors;
use nalgebra::{Point2, Point3, Vector3};

use crate::frame_pictures::{enlarged, spread, thumbnail, turns_to_upright};
use crate::report::chart::frame_chart;
use crate::report::{Drawings, Gallery, Picture, Report, Table};

use super::CaptureCheck;
use super::path_drawing::PathDrawing;

/// Photographs on the contact sheet.
const SHEET: usize = 24;
/// Longer side of a picture, pixels.
const PICTURE: usize = 480;
/// Photographs with their depth over them.
const OVERLAYS: usize = 6;
/// Frames whose depth is drawn, and points of each.
const CLOUD: (usize, usize) = (12, 260);

/// Builds the page of a check.
///
/// # Errors
/// The person asked for a stop. Photographs and depth that cannot be read are left out: the check has named them.
pub fn check_report(sequence: &Sequence, check: &CaptureCheck, progress: &dyn Progress) -> Result<Report> {
    let steps = Steps::new(progress, "report", 3);
    let summary = &check.capture;
    let metric = sequence.meta().and_then(|meta| meta.provenance.get("metric")?.as_bool()).unwrap_or(true);
    let up = up_in_world(sequence.frames(), metric);
    let flagged: BTreeMap<FrameId, Vec<&str>> =
        summary.problems.iter().fold(BTreeMap::new(), |mut flagged, problem| {
            if let Some(frame) = problem.frame {
                flagged.entry(frame).or_insert_with(Vec::new).push(problem.kind);
            }
            flagged
        });
    let cloud = cloud(sequence);
    steps.step()?;
    let drawing = PathDrawing {
        frames: sequence.frames(),
        size: sequence.image_size(),
        flagged: &flagged.keys().copied().collect(),
        cloud: &cloud,
        up,
        metric,
    };
    let mut report = Report {
        title: format!("Capture check: {}", sequence.name()),
        lead: match summary.problems.len() {
            0 => "Nothing is wrong with this capture.".to_owned(),
            1 => "One thing is wrong with this capture.".to_owned(),
            n => format!("{n} things are wrong with this capture."),
        },
        highlights: highlights(check, metric),
        warnings: problems(check),
        tables: vec![measured(sequence, check, metric)],
        drawings: vec![
            Drawings {
                title: "The camera path".to_owned(),
                note: "Each pyramid is a photograph: its tip the camera, its base what it saw. Dark is early, light is late, \
                       red is a frame with a problem. Points are what the depth maps show, placed by the poses."
                    .to_owned(),
                figures: drawing.draw(),
            },
            Drawings {
                title: "Frame by frame".to_owned(),
                note: "Frames with a problem are red.".to_owned(),
                figures: charts(sequence, check, &flagged.keys().copied().collect(), metric),
            },
        ],
        ..Report::default()
    };
    report.galleries.extend(contact_sheet(sequence, &flagged, &up));
    steps.step()?;
    report.galleries.extend(depth_overlays(sequence, &up));
    steps.step()?;
    Ok(report)
}

/// The world's up: y for phones; elsewhere the photographs are taken to be upright.
fn up_in_world(frames: &[Frame], metric: bool) -> Vector3<f64> {
    if metric {
        return Vector3::y();
    }
    let sum: Vector3<f64> = frames.iter().map(|f| f.world_from_cam.rotate(&-Vector3::y())).sum();
    sum.try_normalize(1e-6).unwrap_or_else(Vector3::y)
}

fn length(mm: f64, metric: bool) -> String {
    if metric { format!("{mm:.1} mm") } else { format!("{:.4}", mm * 1e-3) }
}

fn highlights(check: &CaptureCheck, metric: bool) -> Vec<(String, String)> {
    let summary = &check.capture;
    let mut cards = vec![
        (summary.problems.len().to_string(), "problems".to_owned()),
        (summary.frames.to_string(), "frames".to_owned()),
        (format!("{:.0} %", 100.0 * summary.orbit_coverage), "of the way round".to_owned()),
        (length(summary.step_median_mm, metric), "median step".to_owned()),
    ];
    if let Some(mm) = summary.depth_disagreement_mm {
        cards.push((length(mm, metric), "depth against poses, median".to_owned()));
    }
    if let Some(epipolar) = &check.epipolar {
        cards.push((format!("{:.2} px", epipolar.median_px), "matches against poses, median".to_owned()));
    }
    cards
}

/// Problems as sentences; many of one kind are summed up.
fn problems(check: &CaptureCheck) -> Vec<String> {
    const SHOWN: usize = 8;
    let mut sentences = Vec::new();
    let kinds: BTreeSet<&str> = check.capture.problems.iter().map(|p| p.kind).collect();
    for kind in kinds {
        let of_kind: Vec<_> = check.capture.problems.iter().filter(|p| p.kind == kind).collect();
        for problem in of_kind.iter().take(SHOWN) {
            let place = problem.frame.map(|frame| format!("frame {frame} ")).unwrap_or_default();
            sentences.push(format!("{kind}: {place}{}", problem.message));
        }
        if of_kind.len() > SHOWN {
            sentences.push(format!("{kind}: {} more", of_kind.len() - SHOWN));
        }
    }
    sentences.extend(check.capture.warnings.iter().take(SHOWN).map(|warning| format!("mended: {warning}")));
    sentences
}

fn measured(sequence: &Sequence, check: &CaptureCheck, metric: bool) -> Table {
    let s = &check.capture;
    let mut rows = vec![
        ("photographs", format!("{} of {} frames, {}", s.frames_with_photo, s.frames, sequence.image_size())),
        ("depth maps", format!("{} of {} frames", s.frames_with_depth, s.frames)),
        ("frame numbers absent", s.frame_numbers_absent.to_string()),
        ("step, turn between neighbours (median)", {
            format!("{}, {:.2} deg", length(s.step_median_mm, metric), s.turn_median_deg)
        }),
        ("elevation of the cameras", format!("{:.0} to {:.0} deg", s.elevation_deg[0], s.elevation_deg[1])),
        ("rotations that were mended", {
            let r = &s.rotation;
            format!("{} (worst determinant {:.5})", r.frames_mended, r.worst_determinant)
        }),
    ];
    if let Some(h) = &s.hashes {
        let found = format!("{} files, {} changed, {} missing, {} new", h.files, h.changed, h.missing, h.unknown);
        rows.push(("files since the import", found));
    }
    if let Some(epipolar) = &check.epipolar {
        let matches: usize = epipolar.pairs.iter().map(|p| p.matches).sum();
        let worst = epipolar.pairs.iter().map(|p| p.median_px).fold(0.0, f64::max);
        rows.push(("matches between photographs", {
            format!("{matches} in {} pairs, worst median {worst:.2} px", epipolar.pairs.len())
        }));
    }
    Table {
        title: "What was measured".to_owned(),
        note: String::new(),
        head: vec![String::new(), String::new()],
        rows: rows.into_iter().map(|(name, value)| vec![name.to_owned(), value]).collect(),
    }
}

fn charts(sequence: &Sequence, check: &CaptureCheck, flagged: &BTreeSet<FrameId>, metric: bool) -> Vec<maud::Markup> {
    let photos = &check.capture.photographs;
    let bars = |value: fn(&mb_capture::PhotoCheck) -> f64| -> Vec<(u32, f64, bool)> {
        photos.iter().map(|p| (p.frame.0, value(p), flagged.contains(&p.frame))).collect()
    };
    let scale = if metric { 1e3 } else { 1.0 };
    let steps: Vec<(u32, f64, bool)> = sequence
        .frames()
        .windows(2)
        .map(|pair| {
            let step = (pair[1].world_from_cam.translation() - pair[0].world_from_cam.translation()).norm();
            (pair[1].id.0, step * scale, flagged.contains(&pair[1].id))
        })
        .collect();
    let mut charts = Vec::new();
    if !photos.is_empty() {
        charts.push(frame_chart("Sharpness: difference of neighbouring pixels", "levels", &bars(|p| p.sharpness)));
        charts.push(frame_chart("Brightness: mean luma", "levels", &bars(|p| p.brightness)));
    }
    if !steps.is_empty() {
        let unit = if metric { "mm" } else { "" };
        charts.push(frame_chart("Step from the frame before", unit, &steps));
    }
    charts
}

fn contact_sheet(sequence: &Sequence, flagged: &BTreeMap<FrameId, Vec<&str>>, up: &Vector3<f64>) -> Option<Gallery> {
    // Frames with problems come first when places are short.
    let mut shown = spread(sequence.frames(), SHEET);
    let wrong = sequence.frames().iter().filter(|f| f.image.is_some() && flagged.contains_key(&f.id)).take(SHEET / 3);
    for frame in wrong {
        if !shown.iter().any(|s| s.id == frame.id) {
            shown.push(frame);
        }
    }
    shown.sort_by_key(|f| f.id);
    let pictures: Vec<Picture> = shown
        .into_iter()
        .filter_map(|frame| {
            let photo = sequence.read_image(frame).ok()?;
            let image = thumbnail(&photo, PICTURE).rotated_clockwise(turns_to_upright(frame, up));
            let kinds = flagged.get(&frame.id).map(|kinds| format!(": {}", kinds.join(", "))).unwrap_or_default();
            Some(Picture { caption: format!("frame {}{kinds}", frame.id), image })
        })
        .collect();
    (!pictures.is_empty()).then(|| Gallery {
        title: "Contact sheet".to_owned(),
        note: "Photographs spread over the capture, upright.".to_owned(),
        pictures,
        scale: None,
    })
}

/// Nearest and farthest of the middle 96 % of a depth map; `None` where it is empty.
fn range(depth: &DepthImage) -> Option<(f64, f64)> {
    let mut values: Vec<f32> = depth.data().iter().copied().filter(|z| *z > 0.0).collect();
    values.sort_by(f32::total_cmp);
    let at = |share: f64| values.get((share * values.len() as f64) as usize).map(|z| f64::from(*z));
    Some((at(0.02)?, at(0.98)?))
}

fn depth_overlays(sequence: &Sequence, up: &Vector3<f64>) -> Option<Gallery> {
    let with_depth: Vec<Frame> = sequence.frames().iter().filter(|f| f.arkit_depth.is_some()).cloned().collect();
    let pictures: Vec<Picture> = spread(&with_depth, OVERLAYS)
        .into_iter()
        .filter_map(|frame| {
            let photo = thumbnail(&sequence.read_image(frame).ok()?, PICTURE);
            let (depth, _) = sequence.read_arkit_depth(frame).ok()?;
            let depth = enlarged(&depth, photo.size());
            let (near, far) = range(&depth)?;
            let values: Vec<f64> = depth.data().iter().map(|z| f64::from(*z)).collect();
            let colors = heat_colors(&values, near, far);
            let mixed = photo.data().iter().zip(colors).zip(&values).map(|((photo, color), z)| {
                let share = if *z > 0.0 { 0.6 } else { 0.0 };
                let grey = photo.iter().map(|v| f64::from(*v)).sum::<f64>() / 3.0;
                std::array::from_fn(|c| ((1.0 - share) * grey + share * f64::from(color[c])).round() as u8)
            });
            let image = RgbImage::from_data(photo.size(), mixed.collect())?;
            let caption = format!("frame {}: {near:.2} to {far:.2} m", frame.id);
            Some(Picture { caption, image: image.rotated_clockwise(turns_to_upright(frame, up)) })
        })
        .collect();
    (!pictures.is_empty()).then(|| Gallery {
        title: "Depth on the photographs".to_owned(),
        note: "The phone's depth over the photograph in grey, dark near and light far; where there is no colour there is no \
               depth. Edges of both should coincide."
            .to_owned(),
        pictures,
        scale: None,
    })
}

/// Points of some depth maps with the photographs' colours, within half again the distance from the middle of the cameras to
/// the farthest of them or to what they look at.
fn cloud(sequence: &Sequence) -> Vec<(Point3<f64>, [u8; 3])> {
    let with_depth: Vec<Frame> = sequence.frames().iter().filter(|f| f.arkit_depth.is_some()).cloned().collect();
    let mut points = Vec::new();
    for frame in spread(&with_depth, CLOUD.0) {
        let (Ok(photo), Ok((depth, _))) = (sequence.read_image(frame), sequence.read_arkit_depth(frame)) else {
            continue;
        };
        let k = frame.intrinsics.resized(sequence.image_size(), depth.size());
        let step = ((depth.size().pixels() as f64 / CLOUD.1 as f64).sqrt() as usize).max(1);
        for y in (step / 2..depth.height()).step_by(step) {
            for x in (step / 2..depth.width()).step_by(step) {
                let z = f64::from(depth[(x, y)]);
                if z > 0.0 {
                    let p = frame.world_from_cam * k.cam_from_img(&Point2::new(x as f64, y as f64), z);
                    let in_photo = |v: usize, of: usize, to: usize| ((2 * v + 1) * to / (2 * of)).min(to - 1);
                    let (u, v) =
                        (in_photo(x, depth.width(), photo.width()), in_photo(y, depth.height(), photo.height()));
                    points.push((p, photo[(u, v)]));
                }
            }
        }
    }
    let count = points.len().max(1) as f64;
    let middle = points.iter().map(|(p, _)| p.coords).sum::<Vector3<f64>>() / count;
    let mut distances: Vec<f64> = points.iter().map(|(p, _)| (p.coords - middle).norm()).collect();
    distances.sort_by(f64::total_cmp);
    // Far walls seen past the object would shrink it to a dot.
    let limit = 2.5 * distances.get(distances.len() / 2).copied().unwrap_or(0.0);
    points.retain(|(p, _)| (p.coords - middle).norm() <= limit);
    points
}
