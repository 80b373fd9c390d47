//! Pages as one HTML file that needs nothing else: pages are SVG, pictures and fonts are inside.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use maud::{DOCTYPE, PreEscaped, html};

use crate::page::{Align, Element, PAGE_MM, Page, PictureId, Rgb, Segment, rounded};
use crate::text::Weight;

const STYLE: &str = "
body { margin: 0; background: #dfe3e8; font-family: 'Booklet', sans-serif; }
svg.page { display: block; width: min(96vw, 1500px); height: auto; margin: 2vh auto; background: white;
  box-shadow: 0 1px 6px #0004; }
@media print {
  @page { size: A4 landscape; margin: 0; }
  body { background: white; }
  svg.page { width: 297mm; height: 210mm; margin: 0; box-shadow: none; break-after: page; }
}
";

/// The page's text. Pictures are PNG files.
pub(crate) fn page(pages: &[Page], pictures: &BTreeMap<PictureId, Vec<u8>>, title: &str) -> String {
    let shown: Vec<PictureId> = pictures.keys().copied().collect();
    let mut placed = BTreeSet::new();
    let fonts = [(Weight::Regular, 400), (Weight::Bold, 700)].map(|(weight, number)| {
        format!(
            "@font-face {{ font-family: 'Booklet'; font-weight: {number}; src: url(data:font/ttf;base64,{}); }}\n",
            STANDARD.encode(weight.bytes())
        )
    });
    let bodies: Vec<String> = pages.iter().map(|page| svg(page, &shown, pictures, &mut placed)).collect();
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) }
                style { (PreEscaped(fonts.concat())) (PreEscaped(STYLE)) }
            }
            body {
                @for (number, body) in bodies.iter().enumerate() {
                    (PreEscaped(format!(
                        "<svg class=\"page\" id=\"page-{}\" viewBox=\"0 0 {} {}\" role=\"img\" aria-label=\"{}\" \
                         xmlns=\"http://www.w3.org/2000/svg\">",
                        number + 1, PAGE_MM[0], PAGE_MM[1], escaped(&pages[number].title)
                    )))
                    (PreEscaped(body))
                    (PreEscaped("</svg>\n"))
                }
            }
        }
    }
    .into_string()
}

fn svg(
    page: &Page,
    shown: &[PictureId],
    pictures: &BTreeMap<PictureId, Vec<u8>>,
    placed: &mut BTreeSet<PictureId>,
) -> String {
    let mut text = String::new();
    for element in &page.elements {
        match element {
            Element::Box { rect, radius, fill, line } => shape(&mut text, &rounded(rect, *radius), *fill, *line),
            Element::Path { segments, fill, line } => shape(&mut text, segments, *fill, *line),
            Element::Picture { rect, id } => {
                let (Ok(number), Some(bytes)) = (shown.binary_search(id), pictures.get(id)) else { continue };
                // The first time it is defined, one unit wide and as high as it is; then it is used again.
                if placed.insert(*id) {
                    let ratio = rect.h / rect.w;
                    let _ = write!(
                        text,
                        "<defs><image id=\"p{number}\" width=\"1\" height=\"{ratio:.5}\" preserveAspectRatio=\"none\" \
                         href=\"data:image/png;base64,{}\"/></defs>",
                        STANDARD.encode(bytes)
                    );
                }
                let (x, y, scale) = (rect.x, rect.y, rect.w);
                let _ =
                    write!(text, "<use href=\"#p{number}\" transform=\"translate({x:.3} {y:.3}) scale({scale:.4})\"/>");
            }
            Element::Text { x, y, size, weight, color, align, text: words } => {
                let anchor = match align {
                    Align::Left => "start",
                    Align::Center => "middle",
                    Align::Right => "end",
                };
                let number = if *weight == Weight::Bold { 700 } else { 400 };
                let _ = write!(
                    text,
                    "<text x=\"{x:.3}\" y=\"{y:.3}\" font-size=\"{size:.3}\" font-weight=\"{number}\" fill=\"{}\" \
                     text-anchor=\"{anchor}\">{}</text>",
                    hex(*color),
                    escaped(words)
                );
            }
        }
    }
    text
}

fn shape(text: &mut String, segments: &[Segment], fill: Option<Rgb>, line: Option<(Rgb, f64)>) {
    let mut path = String::new();
    for segment in segments {
        let _ = match segment {
            Segment::Move([x, y]) => write!(path, "M{x:.3} {y:.3}"),
            Segment::Line([x, y]) => write!(path, "L{x:.3} {y:.3}"),
            Segment::Curve([ax, ay], [bx, by], [x, y]) => {
                write!(path, "C{ax:.3} {ay:.3} {bx:.3} {by:.3} {x:.3} {y:.3}")
            }
            Segment::Close => write!(path, "Z"),
        };
    }
    let fill = fill.map_or_else(|| "none".to_owned(), hex);
    let line = line.map_or_else(String::new, |(color, width)| {
        format!(" stroke=\"{}\" stroke-width=\"{width:.3}\" stroke-linejoin=\"round\"", hex(color))
    });
    let _ = write!(text, "<path d=\"{path}\" fill=\"{fill}\"{line}/>");
}

fn hex([r, g, b]: Rgb) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// Text for the inside of elements and attributes.
pub(crate) fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            // Control characters are not allowed in XML.
            c if c.is_control() => safe.push(' '),
            c => safe.push(c),
        }
    }
    safe
}
