//! The report: one self-contained HTML page, pictures and charts inside.

pub(crate) mod chart;
mod overview;

use std::io::Cursor;
use std::path::Path;

use base64::Engine as _;
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder as _};
use maud::{DOCTYPE, Markup, PreEscaped, html};
use mb_image::RgbImage;
use mb_job::{Error, Result, write_atomic};

use self::chart::{Line, fraction_chart};

/// What a report shows. Sections without content are left out.
#[derive(Debug, Default)]
pub struct Report {
    /// Heading.
    pub title: String,
    /// One or two sentences under it.
    pub lead: String,
    /// Figures in large type: value and what it is.
    pub highlights: Vec<(String, String)>,
    /// Score tables.
    pub tables: Vec<Table>,
    /// Rows of pictures.
    pub galleries: Vec<Gallery>,
    /// Threshold curves.
    pub curves: Vec<Curves>,
    /// Drawings and charts of other kinds.
    pub drawings: Vec<Drawings>,
    /// What was run, stage after stage.
    pub stages: Vec<Stage>,
    /// What the reader should know although everything ran.
    pub warnings: Vec<String>,
}

/// A table; the first column names the row.
#[derive(Debug)]
pub struct Table {
    /// Heading.
    pub title: String,
    /// A sentence on how to read it.
    pub note: String,
    /// Column heads, the first over the names.
    pub head: Vec<String>,
    /// Rows of as many cells as the head.
    pub rows: Vec<Vec<String>>,
}

/// Pictures side by side.
#[derive(Debug)]
pub struct Gallery {
    /// Heading.
    pub title: String,
    /// A sentence on how to read it.
    pub note: String,
    /// The pictures.
    pub pictures: Vec<Picture>,
    /// A colour scale that all of them share.
    pub scale: Option<ColorScale>,
}

/// One picture.
#[derive(Debug)]
pub struct Picture {
    /// Its name.
    pub caption: String,
    /// Its pixels.
    pub image: RgbImage,
}

/// Colours from 0 to a largest value.
#[derive(Debug)]
pub struct ColorScale {
    /// Colours at equal steps, first = 0.
    pub colors: Vec<[u8; 3]>,
    /// Largest value with its unit, such as `5 mm`.
    pub largest: String,
}

/// Accuracy, recall and F1 over the threshold.
#[derive(Debug)]
pub struct Curves {
    /// Heading.
    pub title: String,
    /// Name and (threshold in mm, fraction) of each line.
    pub lines: Vec<(String, Vec<(f64, f64)>)>,
}

/// Drawings side by side.
#[derive(Debug)]
pub struct Drawings {
    /// Heading.
    pub title: String,
    /// A sentence on how to read them.
    pub note: String,
    /// Inline SVG with a caption each.
    pub(crate) figures: Vec<Markup>,
}

/// One stage of the work.
#[derive(Debug)]
pub struct Stage {
    /// Its name, as the command has it.
    pub name: String,
    /// Options it ran with, seeds included.
    pub options: serde_json::Value,
    /// What it found.
    pub summary: serde_json::Value,
    /// Wall time, seconds.
    pub seconds: f64,
}

impl Report {
    /// Writes the page.
    ///
    /// # Errors
    /// A picture cannot be encoded, or the file cannot be written.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        write_atomic(path, self.page()?.into_string().as_bytes())
    }

    fn page(&self) -> Result<Markup> {
        let galleries = self.galleries.iter().map(gallery).collect::<Result<Vec<_>>>()?;
        Ok(html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    meta name="viewport" content="width=device-width, initial-scale=1";
                    title { (self.title) }
                    style { (PreEscaped(include_str!("style.css"))) }
                }
                body { main {
                    header { h1 { (self.title) } p.lead { (self.lead) } }
                    @if !self.highlights.is_empty() {
                        div.cards { @for (value, what) in &self.highlights { div.card { b { (value) } span { (what) } } } }
                    }
                    @for warning in &self.warnings { div.warning { (warning) } }
                    @for t in &self.tables { (table(t)) }
                    @if !self.curves.is_empty() {
                        h2 { "Scores over the threshold" }
                        p { "Share of the surface within a distance, as the distance grows. Dashed lines are the thresholds of the tables." }
                        div.charts { @for c in &self.curves { (curves(c)) } }
                    }
                    @for d in &self.drawings {
                        h2 { (d.title) }
                        p { (d.note) }
                        div.charts { @for figure in &d.figures { (figure) } }
                    }
                    @for g in &galleries { (g) }
                    @if !self.stages.is_empty() { (stages(&self.stages)) }
                    footer { "Made by mobilebrick " (env!("CARGO_PKG_VERSION")) "." }
                } }
            }
        })
    }
}

fn table(table: &Table) -> Markup {
    html! {
        h2 { (table.title) }
        p { (table.note) }
        div.scroll { table {
            thead { tr { @for cell in &table.head { th { (cell) } } } }
            tbody { @for row in &table.rows { tr { @for cell in row { td { (cell) } } } } }
        } }
    }
}

fn curves(curves: &Curves) -> Markup {
    let lines: Vec<Line<'_>> =
        curves.lines.iter().map(|(name, points)| Line { name, points: points.clone() }).collect();
    fraction_chart(&curves.title, "threshold, mm", &[2.5, 5.0], &lines)
}

fn gallery(gallery: &Gallery) -> Result<Markup> {
    let pictures =
        gallery.pictures.iter().map(|p| Ok((&p.caption, jpeg_data_uri(&p.image)?))).collect::<Result<Vec<_>>>()?;
    Ok(html! {
        h2 { (gallery.title) }
        p { (gallery.note) }
        @if let Some(scale) = &gallery.scale {
            div.scale { "0" div.bar style=(gradient(&scale.colors)) {} (scale.largest) " and more" }
        }
        div.pictures { @for (caption, uri) in &pictures {
            figure { img src=(uri) alt=(caption) loading="lazy"; figcaption { (caption) } }
        } }
    })
}

/// A colour bar as a CSS background.
pub(crate) fn gradient(colors: &[[u8; 3]]) -> String {
    let stops: Vec<String> = colors.iter().map(|[r, g, b]| format!("rgb({r},{g},{b})")).collect();
    format!("background:linear-gradient(to right,{})", stops.join(","))
}

fn stages(stages: &[Stage]) -> Markup {
    html! {
        h2 { "What was run" }
        p { "Each stage with its options, seeds and findings. The same options and seed give the same bytes." }
        div.scroll { table {
            thead { tr { th { "stage" } th { "seconds" } } }
            tbody { @for stage in stages { tr { td { (stage.name) } td { (format!("{:.1}", stage.seconds)) } } } }
        } }
        @for stage in stages { details {
            summary { (stage.name) }
            p { "Options" } pre { (format!("{:#}", stage.options)) }
            p { "Findings" } pre { (format!("{:#}", stage.summary)) }
        } }
    }
}

/// A JPEG inside the page. Pictures are for looking: quality 88 keeps a page of twenty under a few megabytes.
fn jpeg_data_uri(image: &RgbImage) -> Result<String> {
    let mut bytes = Cursor::new(Vec::new());
    JpegEncoder::new_with_quality(&mut bytes, 88)
        .write_image(image.data().as_flattened(), image.width() as u32, image.height() as u32, ExtendedColorType::Rgb8)
        .map_err(|e| Error::Failed(format!("a picture of the report cannot be encoded: {e}")))?;
    let encoded = base64::engine::general_purpose::STANDARD.encode(bytes.into_inner());
    Ok(format!("data:image/jpeg;base64,{encoded}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_geometry::ImageSize;

    #[test]
    fn the_page_is_self_contained_and_escapes_what_it_shows() {
        let report = Report {
            title: "a <b> & c".into(),
            galleries: vec![Gallery {
                title: "pictures".into(),
                note: String::new(),
                pictures: vec![Picture {
                    caption: "one".into(),
                    image: RgbImage::filled(ImageSize::new(4, 4), [9, 8, 7]),
                }],
                scale: Some(ColorScale { colors: vec![[0, 0, 0], [255, 0, 0]], largest: "5 mm".into() }),
            }],
            curves: vec![Curves { title: "F1".into(), lines: vec![("tsdf".into(), vec![(0.0, 0.0), (10.0, 1.0)])] }],
            ..Report::default()
        };
        let overview = report.overview().unwrap();
        assert_eq!(overview.size(), ImageSize::new(420, 420));
        assert!(overview.data().iter().all(|p| *p == [9, 8, 7]));
        assert!(Report::default().overview().is_none());
        let page = report.page().unwrap().into_string();
        assert!(page.contains("a &lt;b&gt; &amp; c"));
        assert!(page.contains("data:image/jpeg;base64,"));
        assert!(!page.contains("http"), "the page must not reach for the network");
        assert!(page.contains("M46.0 258.0L504.0 16.0"), "the curve runs from the lower left to the upper right");
    }
}
