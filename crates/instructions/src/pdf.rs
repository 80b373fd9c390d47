//! Pages as a PDF.

use std::collections::BTreeMap;

use krilla::color::rgb;
use krilla::geom::{Path, PathBuilder, Point, Size, Transform};
use krilla::image::Image;
use krilla::metadata::Metadata;
use krilla::num::NormalizedF32;
use krilla::page::PageSettings;
use krilla::paint::{Fill, Stroke};
use krilla::surface::Surface;
use krilla::text::{Font, GlyphId, KrillaGlyph};
use krilla::{Document, SerializeSettings};
use mb_job::{Error, Result};

use crate::page::{Align, Element, PAGE_MM, Page, PictureId, Rgb, Segment, rounded};
use crate::text::Weight;

/// PDF points in a millimetre.
const POINTS: f64 = 72.0 / 25.4;

/// The file's bytes. Pictures are PNG files.
pub(crate) fn pdf(pages: &[Page], pictures: BTreeMap<PictureId, Vec<u8>>, title: &str) -> Result<Vec<u8>> {
    let failed = |what: String| Error::Failed(format!("the PDF could not be written: {what}"));
    let mut images = BTreeMap::new();
    for (id, bytes) in pictures {
        images.insert(id, Image::from_png(bytes.into(), true).map_err(failed)?);
    }
    let font = |weight: Weight| Font::new(weight.bytes().into(), 0);
    let (Some(regular), Some(bold)) = (font(Weight::Regular), font(Weight::Bold)) else {
        return Err(failed("the font is not valid".to_owned()));
    };
    let mut document = Document::new_with(SerializeSettings::default());
    document.set_metadata(
        Metadata::new().title(title.to_owned()).creator("MobileBrick".to_owned()).language("en".to_owned()),
    );
    let size = PAGE_MM.map(|v| (v * POINTS) as f32);
    let settings = PageSettings::from_wh(size[0], size[1]).ok_or_else(|| failed("a page without area".to_owned()))?;
    for page in pages {
        let mut sheet = document.start_page_with(settings.clone());
        let mut surface = sheet.surface();
        for element in &page.elements {
            draw(&mut surface, element, &images, [&regular, &bold]);
        }
        surface.finish();
        sheet.finish();
    }
    document.finish().map_err(|e| failed(format!("{e:?}")))
}

fn draw(surface: &mut Surface, element: &Element, images: &BTreeMap<PictureId, Image>, fonts: [&Font; 2]) {
    match element {
        Element::Box { rect, radius, fill, line } => shape(surface, &rounded(rect, *radius), *fill, *line),
        Element::Path { segments, fill, line } => shape(surface, segments, *fill, *line),
        Element::Picture { rect, id } => {
            let Some(image) = images.get(id) else { return };
            let size = Size::from_wh((rect.w * POINTS) as f32, (rect.h * POINTS) as f32);
            if let Some(size) = size {
                surface.push_transform(&Transform::from_translate((rect.x * POINTS) as f32, (rect.y * POINTS) as f32));
                surface.draw_image(image.clone(), size);
                surface.pop();
            }
        }
        Element::Text { x, y, size, weight, color, align, text } => {
            let width = weight.width(text, *size);
            let left = match align {
                Align::Left => *x,
                Align::Center => x - 0.5 * width,
                Align::Right => x - width,
            };
            let starts: Vec<usize> = text.char_indices().map(|(i, _)| i).chain([text.len()]).collect();
            let glyphs: Vec<KrillaGlyph> = weight
                .glyphs(text)
                .iter()
                .zip(starts.windows(2))
                .map(|((glyph, advance), range)| {
                    KrillaGlyph::new(GlyphId::new(glyph.to_u32()), *advance, 0.0, 0.0, 0.0, range[0]..range[1], None)
                })
                .collect();
            let font = if *weight == Weight::Regular { fonts[0] } else { fonts[1] };
            surface.set_fill(Some(solid(*color)));
            surface.set_stroke(None);
            let at = Point::from_xy((left * POINTS) as f32, (y * POINTS) as f32);
            surface.draw_glyphs(at, &glyphs, font.clone(), text, (size * POINTS) as f32, false);
        }
    }
}

fn shape(surface: &mut Surface, segments: &[Segment], fill: Option<Rgb>, line: Option<(Rgb, f64)>) {
    let Some(path) = path(segments) else { return };
    surface.set_fill(fill.map(solid));
    surface.set_stroke(line.map(|(color, width)| Stroke {
        paint: rgb::Color::new(color[0], color[1], color[2]).into(),
        width: (width * POINTS) as f32,
        ..Stroke::default()
    }));
    surface.draw_path(&path);
}

fn solid(color: Rgb) -> Fill {
    let paint = rgb::Color::new(color[0], color[1], color[2]).into();
    Fill { paint, opacity: NormalizedF32::ONE, ..Fill::default() }
}

fn path(segments: &[Segment]) -> Option<Path> {
    let point = |p: &[f64; 2]| p.map(|v| (v * POINTS) as f32);
    let mut builder = PathBuilder::new();
    for segment in segments {
        match segment {
            Segment::Move(p) => {
                let [x, y] = point(p);
                builder.move_to(x, y);
            }
            Segment::Line(p) => {
                let [x, y] = point(p);
                builder.line_to(x, y);
            }
            Segment::Curve(a, b, p) => {
                let ([ax, ay], [bx, by], [x, y]) = (point(a), point(b), point(p));
                builder.cubic_to(ax, ay, bx, by, x, y);
            }
            Segment::Close => builder.close(),
        }
    }
    builder.finish()
}
