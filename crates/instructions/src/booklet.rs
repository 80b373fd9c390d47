//! From a model to a booklet: plan, measure, lay out, draw, write.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder as _};
use mb_bricks::Model;
use mb_geometry::ImageSize;
use mb_job::{Error, InputError, Progress, Result, Steps, write_atomic};
use mb_mesh::TriangleMesh;
use mb_render::{Drawing, DrawingOptions, RgbaImage, ShadeOptions, shade};
use rayon::prelude::*;
use serde::Serialize;

use crate::geometry::{Assembly, PartArt};
use crate::layout::book;
use crate::page::PictureId;
use crate::plan::{PieceKind, Plan, section_title};
use crate::sheet::{Sheets, Shot};
use crate::views::{Look, Shown, Sight};
use crate::{html, pdf};

/// Pixels of a millimetre on paper, in the pictures of steps (200 dots an inch) and of pieces (250).
const STEP_PX: f64 = 200.0 / 25.4;
const PIECE_PX: f64 = 250.0 / 25.4;
/// Pictures of steps that wait to be encoded together: bounds the memory, whatever the thread count.
const AT_ONCE: usize = 4;
/// How far what was there before is faded.
const FADE: f32 = 0.52;
const HIGHLIGHT: [u8; 3] = [255, 96, 0];
/// Width of lines and of the band around new pieces, millimetres.
const LINE_MM: f64 = 0.17;
const BAND_MM: f64 = 0.42;
/// Jumps of depth within a part that show as lines, metres.
const JUMP_M: f64 = 0.0007;
/// What the pictures on the cover and the last page fit into, millimetres.
const COVER_MM: [f64; 2] = [240.0, 138.0];
/// Paper millimetres there for a metre of the model, at most: twice the real size.
const LARGEST_COVER_SCALE: f64 = 2000.0;

/// The form of a booklet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// A PDF, A4 landscape.
    Pdf,
    /// One HTML page that needs no other file.
    Html,
}

impl Form {
    /// The form that a file's ending asks for.
    ///
    /// # Errors
    /// `Error::Input` for another ending than `.pdf` and `.html`.
    pub fn of(path: &Path) -> Result<Self> {
        let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
        match ending.as_str() {
            "pdf" => Ok(Self::Pdf),
            "html" | "htm" => Ok(Self::Html),
            _ => Err(InputError::new(path, "the ending says neither PDF nor HTML")
                .help("Name the output something.pdf or something.html")
                .into()),
        }
    }
}

/// What a booklet holds: the document of `model instructions`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct BookletSummary {
    /// Pages, cover included.
    pub pages: usize,
    /// Steps, those of submodels once.
    pub steps: usize,
    /// Submodels that are built on their own, the model itself not counted.
    pub submodels: usize,
    /// Bricks in all; what the steps add, copies of submodels included, is exactly this.
    pub parts: usize,
    /// Different bricks: part and colour.
    pub distinct_parts: usize,
    /// Bricks whose parts are nowhere: the parts list names them, no step adds them.
    pub missing_parts: usize,
    /// Sections whose steps are ours, because the author gave none.
    pub automatic_sections: usize,
    /// How often the view changes from one step to the next.
    pub view_changes: usize,
    /// Size of the file.
    pub bytes: usize,
    /// What the reader should know.
    pub warnings: Vec<String>,
}

/// Writes the building instructions of a model.
///
/// # Errors
/// The file cannot be written, or the person asked for a stop; nothing is left behind then.
pub fn write_booklet(model: &Model, plan: &Plan, path: &Path, progress: &dyn Progress) -> Result<BookletSummary> {
    let form = Form::of(path)?;
    let (bytes, summary) = booklet(model, plan, form, progress)?;
    write_atomic(path, &bytes)?;
    Ok(summary)
}

/// The booklet's bytes; the same each time.
///
/// # Errors
/// The person asked for a stop, or (which no model is known to cause) the PDF cannot be made.
pub fn booklet(model: &Model, plan: &Plan, form: Form, progress: &dyn Progress) -> Result<(Vec<u8>, BookletSummary)> {
    let art = PartArt::of(model);
    let sheets = Sheets::measure(model, &art, plan, progress)?;
    let title = title(model, plan);
    let cover = plan.main().map(|_| whole_shot(model, &art, plan, &Look::usual()));
    let back = plan.main().map(|_| whole_shot(model, &art, plan, &Look::around(180.0)));
    let size = |shot: &Option<Shot>| shot.as_ref().map_or([1.0; 2], Shot::size_mm);
    let book = book(model, plan, &sheets, &title, size(&cover), size(&back));

    let mut pictures: BTreeMap<PictureId, Vec<u8>> = BTreeMap::new();
    draw_pieces(model, &art, plan, &sheets, progress, &mut pictures)?;
    draw_steps(model, &art, plan, &sheets, progress, &mut pictures)?;
    if let (Some(cover), Some(back), Some(main)) = (cover, back, plan.main()) {
        let assembly = Assembly::of_section(model, &art, main);
        let mesh = assembly.mesh(0..assembly.bricks());
        for (id, shot) in [(PictureId::Cover, cover), (PictureId::Back, back)] {
            if progress.stop_requested() {
                return Err(Error::Stopped);
            }
            pictures.insert(id, png(&portrait(&assembly, &mesh, &shot))?);
        }
    }
    let bytes = match form {
        Form::Pdf => pdf::pdf(&book.pages, pictures, &title)?,
        Form::Html => html::page(&book.pages, &pictures, &title).into_bytes(),
    };
    let totals = plan.totals();
    let mut warnings = model.warnings().to_vec();
    warnings.extend(plan.warnings.iter().cloned());
    let summary = BookletSummary {
        pages: book.pages.len(),
        steps: plan.order.len(),
        submodels: plan.sections.len().saturating_sub(1),
        parts: totals.iter().map(|(_, count)| count).sum(),
        distinct_parts: totals.len(),
        missing_parts: plan.missing.iter().map(|(_, count)| count).sum(),
        automatic_sections: plan.sections.iter().filter(|section| section.automatic).count(),
        view_changes: book.view_changes,
        bytes: bytes.len(),
        warnings,
    };
    Ok((bytes, summary))
}

/// What stands on the cover: what the author calls the model, or the file's name where that says nothing.
fn title(model: &Model, plan: &Plan) -> String {
    const SAY_NOTHING: [&str; 6] = ["", "main", "main model", "model", "untitled", "untitled model"];
    let stated = plan.main().map(|main| section_title(model, main)).unwrap_or_default();
    if SAY_NOTHING.contains(&stated.to_lowercase().as_str()) {
        model.path().file_stem().map_or_else(|| "Model".to_owned(), |stem| stem.to_string_lossy().into_owned())
    } else {
        stated
    }
}

/// The whole model, as large as the cover allows.
fn whole_shot(model: &Model, art: &PartArt, plan: &Plan, look: &Look) -> Shot {
    let main = plan.main().expect("asked for only where there is something to build");
    let assembly = Assembly::of_section(model, art, main);
    let sight = Sight::new(*look, &assembly.bounds());
    // Room for the shadow on the ground.
    let frame = sight.frames(&assembly)[assembly.bricks()].grown([0.1, 0.06]);
    let size = frame.size_m();
    let scale = (0..2).map(|i| COVER_MM[i] / size[i].max(1e-9)).fold(LARGEST_COVER_SCALE, f64::min);
    Shot { sight, frame, scale }
}

fn draw_pieces(
    model: &Model,
    art: &PartArt,
    plan: &Plan,
    sheets: &Sheets,
    progress: &dyn Progress,
    pictures: &mut BTreeMap<PictureId, Vec<u8>>,
) -> Result<()> {
    let counter = Steps::new(progress, "drawing parts", sheets.pieces.len());
    let pieces: Vec<(&PieceKind, &Shot)> = sheets.pieces.iter().collect();
    for chunk in pieces.chunks(8 * AT_ONCE) {
        let drawn: Vec<Result<(PictureId, Vec<u8>)>> = chunk
            .par_iter()
            .map(|(kind, shot)| {
                let assembly = match **kind {
                    PieceKind::Part(part, color) => Assembly::of_part(model, art, part, color),
                    PieceKind::Submodel(section) => Assembly::of_section(model, art, &plan.sections[section]),
                };
                let picture = whole(&assembly, shot, PIECE_PX);
                counter.step()?;
                Ok((PictureId::Piece(**kind), png(&picture)?))
            })
            .collect();
        for one in drawn {
            let (id, bytes) = one?;
            pictures.insert(id, bytes);
        }
    }
    Ok(())
}

fn draw_steps(
    model: &Model,
    art: &PartArt,
    plan: &Plan,
    sheets: &Sheets,
    progress: &dyn Progress,
    pictures: &mut BTreeMap<PictureId, Vec<u8>>,
) -> Result<()> {
    let counter = Steps::new(progress, "drawing steps", plan.order.len());
    for (index, section) in plan.sections.iter().enumerate() {
        let assembly = Assembly::of_section(model, art, section);
        let shots = &sheets.steps[index];
        let mut picker = Picker { assembly: &assembly, shots, canvas: None, there: 0 };
        let mut waiting = vec![];
        for (step, content) in section.steps.iter().enumerate() {
            waiting.push((PictureId::Step(index, step), picker.step(step, content.bricks().count())));
            counter.step()?;
            if waiting.len() == AT_ONCE || step + 1 == section.steps.len() {
                let encoded: Vec<Result<_>> =
                    std::mem::take(&mut waiting).par_iter().map(|(id, picture)| Ok((*id, png(picture)?))).collect();
                for one in encoded {
                    let (id, bytes) = one?;
                    pictures.insert(id, bytes);
                }
            }
        }
    }
    Ok(())
}

/// Draws the steps of a section one after the other.
struct Picker<'a> {
    assembly: &'a Assembly<'a>,
    shots: &'a [Shot],
    /// What is drawn so far from the present side, with room for all steps until the next turn; and its first pixel.
    canvas: Option<(Drawing<Shown>, [i64; 2])>,
    /// Bricks that are there.
    there: usize,
}

impl Picker<'_> {
    /// The picture of the next step, which adds `count` bricks: they have a band around them, what was there is faded.
    fn step(&mut self, step: usize, count: usize) -> RgbaImage {
        let shot = &self.shots[step];
        let look = |shot: &Shot| shot.sight.look;
        let turned = step == 0 || look(&self.shots[step - 1]) != look(shot);
        if turned {
            let until = (step..self.shots.len()).take_while(|&later| look(&self.shots[later]) == look(shot)).last();
            let last = &self.shots[until.unwrap_or(step)];
            let mut drawing = drawing(last, STEP_PX);
            add(&mut drawing, self.assembly, 0..self.there, FADE, false);
            self.canvas = Some((drawing, last.pixels(STEP_PX).0));
        }
        let (drawing, origin) = self.canvas.as_mut().expect("the first step turns");
        for brick in (0..self.there).rev() {
            // From the newest back to what has been faded.
            if !drawing.set_look(brick as u32, self.assembly.look(brick, FADE, false)) {
                break;
            }
        }
        add(drawing, self.assembly, self.there..self.there + count, 0.0, self.there > 0);
        self.there += count;
        let (first, size) = shot.pixels(STEP_PX);
        cropped(drawing.picture(), [first[0] - origin[0], first[1] - origin[1]], size)
    }
}

/// A part of a picture; transparent where it reaches beyond.
fn cropped(picture: &RgbaImage, first: [i64; 2], size: ImageSize) -> RgbaImage {
    let at = |v: usize, first: i64| usize::try_from(v as i64 + first).unwrap_or(usize::MAX);
    RgbaImage::from_fn(size, |x, y| picture.get(at(x, first[0]), at(y, first[1])).copied().unwrap_or_default())
}

fn drawing(shot: &Shot, px_per_mm: f64) -> Drawing<Shown> {
    let options = DrawingOptions {
        samples: 3,
        line_px: LINE_MM * px_per_mm,
        highlight_px: BAND_MM * px_per_mm,
        highlight: HIGHLIGHT,
        jump: JUMP_M.max(2.5 / (shot.scale * px_per_mm)),
    };
    Drawing::new(&shot.view(px_per_mm), &options)
}

/// Adds bricks to a drawing, a few at a time: their surfaces together would be large.
fn add(drawing: &mut Drawing<Shown>, assembly: &Assembly, bricks: Range<usize>, fade: f32, highlighted: bool) {
    const FEW: usize = 32;
    for from in bricks.clone().step_by(FEW) {
        let some = from..(from + FEW).min(bricks.end);
        let looks: Vec<_> = some.clone().map(|brick| assembly.look(brick, fade, highlighted)).collect();
        drawing.add(&assembly.surface(some).art(&looks));
    }
}

/// All bricks, as they are.
fn whole(assembly: &Assembly, shot: &Shot, px_per_mm: f64) -> RgbaImage {
    let mut drawing = drawing(shot, px_per_mm);
    add(&mut drawing, assembly, 0..assembly.bricks(), 0.0, false);
    drawing.into_picture()
}

/// The model as on the box: lines and colours of the drawings, in daylight, on a ground that takes its shadow. `white`
/// is its bare geometry.
fn portrait(assembly: &Assembly, white: &TriangleMesh, shot: &Shot) -> RgbaImage {
    let drawing = whole(assembly, shot, STEP_PX);
    let options = ShadeOptions { samples: 1, color: [255; 3], ..ShadeOptions::default() };
    let light = shade(white, &shot.view(STEP_PX), &options);
    let mut at = 0;
    drawing.map(|&[r, g, b, a]| {
        let [l, _, _, shadow] = light.data()[at];
        at += 1;
        let lit = f32::from(a) / 255.0;
        // Even shading is in the drawing already: daylight only darkens what is hidden from it.
        let dim = if shadow == 0 { 1.0 } else { (0.42 + 0.66 * f32::from(l) / 255.0).min(1.06) };
        let ground = f32::from(shadow) * (1.0 - lit) / 255.0;
        let opacity = lit + ground * (1.0 - lit);
        if opacity <= 0.0 {
            return [0; 4];
        }
        let mix = |v: u8| (f32::from(v) * dim * lit / opacity).round().clamp(0.0, 255.0) as u8;
        [mix(r), mix(g), mix(b), (opacity * 255.0).round() as u8]
    })
}

fn png(picture: &RgbaImage) -> Result<Vec<u8>> {
    let mut bytes = vec![];
    let size = picture.size();
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Default, FilterType::Adaptive)
        .write_image(picture.data().as_flattened(), size.width as u32, size.height as u32, ExtendedColorType::Rgba8)
        .map_err(|e| Error::Failed(format!("a picture cannot be encoded: {e}")))?;
    Ok(bytes)
}
