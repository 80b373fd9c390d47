//! The report of one sequence: where the model is in the photographs, what the phone measured, what a method made of it
//! and where it is wrong.

use std::path::PathBuf;

use mb_capture::Sequence;
use mb_eval::{SurfaceProtocol, SurfaceScores, SurfaceTruth};
use mb_geometry::ImageSize;
use mb_image::{DepthImage, RgbImage};
use mb_job::{Progress, Result, Steps};
use mb_mesh::TriangleMesh;
use mb_render::{heat_colors, overlay_edges};
use mb_truth::ExactScene;
use nalgebra::Vector3;

use crate::frame_pictures::{enlarged, spread, turns_to_upright};
use crate::pictures::{HEAT_LIMIT_MM, Studio, heated};
use crate::report::{ColorScale, Curves, Gallery, Picture, Report, Table};

/// Depth differences are shown up to this, millimetres.
const DEPTH_LIMIT_MM: f64 = 10.0;
const PICTURE: ImageSize = ImageSize::new(900, 700);
const EDGE: [u8; 3] = [255, 40, 160];

/// A method's result with its scores, one entry per protocol.
#[derive(Debug, Clone)]
pub struct Scored {
    /// Name of the method.
    pub method: String,
    /// Its mesh, world frame.
    pub mesh: PathBuf,
    /// Its scores.
    pub scores: Vec<SurfaceScores>,
}

/// Builds the report of a sequence that has its ground truth.
///
/// # Errors
/// A file of the sequence or a mesh cannot be read, or the person asked for a stop.
pub fn scene_report(sequence: &Sequence, scored: &[Scored], progress: &dyn Progress) -> Result<Report> {
    let steps = Steps::new(progress, "report", 3 + scored.len());
    let alignment = sequence.read_alignment()?;
    let exact = ExactScene::with_alignment(sequence, &alignment)?;
    let up = alignment.world_from_object.rotate(&Vector3::y());
    let mut report = Report {
        title: format!("MobileBrick report: {}", sequence.name()),
        lead: "A brick model of exactly known geometry, filmed and aligned, gives ground truth without a scanner; \
               methods are scored against it."
            .to_owned(),
        highlights: highlights(sequence, scored),
        tables: vec![score_table(scored)],
        curves: scored.iter().flat_map(score_curves).collect(),
        ..Report::default()
    };
    report.galleries.push(alignment_gallery(sequence, &exact, &up)?);
    steps.step()?;
    report.galleries.extend(depth_gallery(sequence, &exact, &up)?);
    steps.step()?;
    let truth = SurfaceTruth::read(sequence.root(), SurfaceProtocol::MobileBrick2023)?;
    steps.step()?;
    for method in scored {
        report.galleries.extend(error_galleries(&truth, &exact, method, &up)?);
        steps.step()?;
    }
    Ok(report)
}

fn percent(fraction: f64) -> String {
    format!("{:.2}", fraction * 100.0)
}

fn highlights(sequence: &Sequence, scored: &[Scored]) -> Vec<(String, String)> {
    let mut cards = vec![(sequence.frames().len().to_string(), format!("frames of {} pixels", sequence.image_size()))];
    if let Some((method, scores)) = scored.iter().find_map(|m| Some((&m.method, m.scores.first()?))) {
        for t in scores.thresholds.iter().take(2) {
            cards.push((format!("{} %", percent(t.f1)), format!("{method}: F1 at {} mm", t.threshold_mm)));
        }
        cards.push((format!("{:.2} mm", scores.chamfer.chamfer_mm), format!("{method}: Chamfer, both ways")));
    }
    cards
}

fn score_table(scored: &[Scored]) -> Table {
    let mut head: Vec<String> = ["method", "protocol"].map(str::to_owned).to_vec();
    let thresholds = scored.iter().find_map(|m| m.scores.first()).map(|s| s.thresholds.clone()).unwrap_or_default();
    for t in &thresholds {
        head.extend(["acc", "rec", "F1"].map(|what| format!("{what} {} mm", t.threshold_mm)));
    }
    head.push("Chamfer, mm".to_owned());
    let mut rows = Vec::new();
    for (method, scores) in scored.iter().flat_map(|m| m.scores.iter().map(|s| (&m.method, s))) {
        let mut row = vec![method.clone(), scores.protocol.to_string()];
        for t in &scores.thresholds {
            row.extend([t.accuracy, t.recall, t.f1].map(percent));
        }
        row.push(format!("{:.2}", scores.chamfer.chamfer_mm));
        rows.push(row);
    }
    Table {
        title: "Scores".to_owned(),
        note: "mobilebrick-2023 repeats the published script; exact-1 measures exact distances to the exact visible \
               surface and aligns nothing. Accuracy, recall and F1 in percent."
            .to_owned(),
        head,
        rows,
    }
}

fn score_curves(method: &Scored) -> Vec<Curves> {
    let curve = |scores: &SurfaceScores| {
        let line = |value: fn(&mb_eval::CurvePoint) -> f64| {
            scores.curve.points.iter().map(|p| (p.threshold_mm, value(p))).collect()
        };
        Curves {
            title: format!("{}, {}", method.method, scores.protocol),
            lines: vec![
                ("accuracy".to_owned(), line(|p| p.accuracy)),
                ("recall".to_owned(), line(|p| p.recall)),
                ("F1".to_owned(), line(|p| p.f1)),
            ],
        }
    };
    method.scores.iter().map(curve).collect()
}

fn alignment_gallery(sequence: &Sequence, exact: &ExactScene, up: &Vector3<f64>) -> Result<Gallery> {
    let pictures = spread(&exact.frames, 4)
        .into_iter()
        .map(|frame| {
            let photo = sequence.read_image(frame)?;
            let overlay = overlay_edges(&photo, &exact.mesh, &exact.view(frame), EDGE);
            let image = overlay.rotated_clockwise(turns_to_upright(frame, up));
            Ok(Picture { caption: format!("frame {}", frame.id), image })
        })
        .collect::<Result<_>>()?;
    Ok(Gallery {
        title: "The model on the photographs".to_owned(),
        note: "Edges of the aligned model, drawn with each frame's camera. Lines beside the bricks show what is left \
               of the error of alignment and poses."
            .to_owned(),
        pictures,
        scale: None,
    })
}

fn depth_gallery(sequence: &Sequence, exact: &ExactScene, up: &Vector3<f64>) -> Result<Option<Gallery>> {
    let Some(frame) = exact.frames.iter().find(|f| f.arkit_depth.is_some() && f.image.is_some()) else {
        return Ok(None);
    };
    let photo = sequence.read_image(frame)?;
    let (phone, _) = sequence.read_arkit_depth(frame)?;
    let truth = exact.render(frame).depth;
    let phone = enlarged(&phone, truth.size());
    // One range for both maps: that of the object, with some room behind it for the table.
    let valid = || truth.data().iter().copied().filter(|z| *z > 0.0);
    let near = f64::from(valid().fold(f32::INFINITY, f32::min));
    let far = f64::from(valid().fold(0.0, f32::max)) * 1.1;
    let difference: Vec<f64> = phone
        .data()
        .iter()
        .zip(truth.data())
        .map(|(&p, &t)| if p > 0.0 && t > 0.0 { f64::from((p - t).abs()) * 1e3 } else { f64::NAN })
        .collect();
    let turns = turns_to_upright(frame, up);
    let picture =
        |caption: &str, image: RgbImage| Picture { caption: caption.to_owned(), image: image.rotated_clockwise(turns) };
    let colored = |values: &[f64], low, high| {
        RgbImage::from_data(truth.size(), heat_colors(values, low, high)).expect("one colour per pixel")
    };
    let metres = |depth: &DepthImage| -> Vec<f64> {
        depth.data().iter().map(|&z| if z > 0.0 { f64::from(z) } else { f64::NAN }).collect()
    };
    Ok(Some(Gallery {
        title: "Depth".to_owned(),
        note: format!(
            "Frame {}: the photograph, the phone's depth, the exact depth of the same view, and how far they are apart.",
            frame.id
        ),
        pictures: vec![
            picture("photograph", photo),
            picture("phone depth", colored(&metres(&phone), near, far)),
            picture("exact depth", colored(&metres(&truth), near, far)),
            picture("difference, see the scale", colored(&difference, 0.0, DEPTH_LIMIT_MM)),
        ],
        scale: Some(color_scale(DEPTH_LIMIT_MM)),
    }))
}

fn color_scale(limit_mm: f64) -> ColorScale {
    let values: Vec<f64> = (0..=16).map(|i| f64::from(i) / 16.0).collect();
    ColorScale { colors: heat_colors(&values, 0.0, 1.0), largest: format!("{limit_mm} mm") }
}

fn error_galleries(
    truth: &SurfaceTruth,
    exact: &ExactScene,
    method: &Scored,
    up: &Vector3<f64>,
) -> Result<Vec<Gallery>> {
    let studio = Studio { truth, up: *up, size: PICTURE };
    let prediction = studio.judged_part(mb_mesh::read_mesh(&method.mesh)?);
    let angles = [("front", 0.6), ("back", 0.6 + std::f64::consts::PI)];
    let draw = |caption: String, mesh: &TriangleMesh, azimuth: f64, smooth: bool| Picture {
        caption,
        image: studio.look(mesh, azimuth, smooth),
    };
    let wrong = heated(&prediction, &truth.mesh);
    let missing = heated(&truth.mesh, &prediction);
    let mut looks = Vec::new();
    let mut errors = Vec::new();
    for (side, azimuth) in angles {
        looks.push(draw(format!("model, {side}"), &exact.mesh, azimuth, false));
        looks.push(draw(format!("{}, {side}", method.method), &prediction, azimuth, true));
        errors.push(draw(format!("wrong: {} to truth, {side}", method.method), &wrong, azimuth, true));
        errors.push(draw(format!("missing: truth to {}, {side}", method.method), &missing, azimuth, true));
    }
    Ok(vec![
        Gallery {
            title: format!("{}: the surface", method.method),
            note: "The brick model and the reconstruction inside the volume that the cameras could judge.".to_owned(),
            pictures: looks,
            scale: None,
        },
        Gallery {
            title: format!("{}: the errors", method.method),
            note: "Distance from each point of one surface to the other, on one scale.".to_owned(),
            pictures: errors,
            scale: Some(color_scale(HEAT_LIMIT_MM)),
        },
    ])
}
