//! The lines of an LDraw text file (LDR, DAT, MPD).
//!
//! Written from the LDraw file format 1.0.2, the MPD extension, the BFC extension and the TEXMAP extension
//! (ldraw.org/article/218.html and its neighbours). A line that makes no sense is reported and skipped, so that a
//! damaged file shows what is left of it; a number that is not finite is an error, because it would spread.

use mb_job::{InputError, Result};
use nalgebra::{Matrix3, Point3, Vector3};

use super::colors::{Color, ColorCode};
use super::file::{
    Affine, EdgeLine, Face, FileKind, LdrawFile, Reference, StepLine, StepView, StudSite, normalized_name,
};
use super::warnings::Warnings;

/// The longest line that is read. Real lines are a few hundred bytes.
const MAX_LINE_BYTES: usize = 100_000;

/// Coordinates beyond this (400 km) are refused: products of such numbers overflow.
const MAX_COORDINATE: f64 = 1e9;

/// The files in one text, and the colours it defines.
pub(crate) struct Document {
    /// At least one; the first is the one that the text as a whole stands for.
    pub files: Vec<LdrawFile>,
    pub colors: Vec<Color>,
    /// Lines that draw or place something.
    pub useful_lines: usize,
}

/// Reads the bytes of a text file. `source` is its name for messages, `name` the name of its content where no
/// `0 FILE` line gives one, `kind` what it is where no `!LDRAW_ORG` line says.
pub(crate) fn parse(
    bytes: &[u8],
    source: &str,
    name: &str,
    kind: Option<FileKind>,
    warnings: &mut Warnings,
) -> Result<Document> {
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err(InputError::new(source, "the text is UTF-16").help("Save it as UTF-8").into());
    }
    let bytes = bytes.strip_prefix(&[0xef, 0xbb, 0xbf]).unwrap_or(bytes);
    if bytes.contains(&0) {
        return Err(InputError::new(source, "this is not a text file (it holds zero bytes)")
            .help("LDraw models are text: .ldr, .mpd, .dat, or a Studio .io archive")
            .into());
    }
    let text = String::from_utf8_lossy(bytes);
    let mut reader =
        Reader { source, warnings, files: vec![OpenFile::new(name, source, kind)], colors: vec![], useful: 0 };
    let mut offset = 0;
    for (index, raw) in text.split_inclusive('\n').enumerate() {
        let start = offset;
        offset += raw.len();
        if raw.len() > MAX_LINE_BYTES {
            return Err(InputError::new(source, format!("the line is {} bytes long", raw.len()))
                .at_line(index + 1)
                .help("No LDraw line is longer than a few hundred bytes: the file is damaged or of another kind")
                .into());
        }
        reader.line(raw.trim(), index as u32 + 1, start, offset)?;
    }
    Ok(reader.finish(&text))
}

/// A file that is being read.
struct OpenFile {
    file: LdrawFile,
    /// Bytes of the text that belong to it.
    span: std::ops::Range<usize>,
    has_name_line: bool,
    stated_kind: bool,
    described: bool,
    clockwise: bool,
    clip: bool,
    invert_next: bool,
    /// After `NOFILE` or `!DATA`: lines belong to nothing.
    closed: bool,
}

impl OpenFile {
    fn new(name: &str, source: &str, kind: Option<FileKind>) -> Self {
        let name = normalized_name(name);
        let by_name = if name.ends_with(".dat") { FileKind::Part } else { FileKind::Model };
        let file = LdrawFile {
            name,
            description: String::new(),
            kind: kind.unwrap_or(by_name),
            source: source.to_owned(),
            certified: None,
            moved_to: None,
            references: vec![],
            faces: vec![],
            edges: vec![],
            studs: vec![],
            steps: vec![],
            text: String::new(),
        };
        Self {
            file,
            span: 0..0,
            has_name_line: false,
            stated_kind: kind.is_some(),
            described: false,
            clockwise: false,
            clip: true,
            invert_next: false,
            closed: false,
        }
    }

    fn is_empty(&self) -> bool {
        self.file.references.is_empty() && self.file.faces.is_empty() && self.file.edges.is_empty()
    }
}

struct Reader<'a> {
    source: &'a str,
    warnings: &'a mut Warnings,
    files: Vec<OpenFile>,
    colors: Vec<Color>,
    useful: usize,
}

impl Reader<'_> {
    fn open(&mut self) -> &mut OpenFile {
        self.files.last_mut().expect("there is always one")
    }

    fn line(&mut self, line: &str, number: u32, start: usize, end: usize) -> Result<()> {
        let mut tokens = Tokens(line);
        let Some(kind) = tokens.next() else { return Ok(()) };
        if kind == "0"
            && let Some(name) = file_line(tokens.0)
        {
            self.begin_file(name, number, start, end);
            return Ok(());
        }
        if self.open().closed {
            return Ok(());
        }
        self.open().span.end = end;
        let understood = match kind {
            "0" => {
                self.meta(tokens, number);
                return Ok(());
            }
            "1" => self.reference(tokens, number),
            "2" => self.edge(tokens),
            "3" => self.polygon::<3>(tokens),
            "4" => self.polygon::<4>(tokens),
            // Conditional lines only matter to line drawings from a moving view.
            "5" => Ok(()),
            _ => Err(Malformed::Line("it begins with no line type")),
        };
        match understood {
            Ok(()) => {
                self.useful += 1;
                Ok(())
            }
            Err(Malformed::Line(why)) => {
                let shown: String = line.chars().take(60).collect();
                self.warnings
                    .add("malformed line", format!("{}: line {number}: {why}, skipped: `{shown}`", self.source));
                Ok(())
            }
            Err(Malformed::Number(token)) => {
                let shown: String = token.chars().take(40).collect();
                Err(InputError::new(self.source, format!("the number `{shown}` is not finite, or absurdly large"))
                    .at_line(number as usize)
                    .help("Mend or remove the line")
                    .into())
            }
        }
    }

    fn begin_file(&mut self, name: &str, number: u32, start: usize, end: usize) {
        let (source, first) = (self.source, self.files.len() == 1);
        if first && self.open().is_empty() && !self.open().has_name_line {
            // What came before the first FILE line was comments.
            self.files.clear();
        }
        if name.is_empty() {
            self.warnings.add("file without name", format!("{source}: line {number}: `0 FILE` without a name"));
        }
        let mut file = OpenFile::new(name, source, None);
        file.has_name_line = true;
        file.span = start..end;
        self.files.push(file);
    }

    fn meta(&mut self, mut tokens: Tokens, number: u32) {
        let source = self.source;
        let whole = tokens.0.trim();
        let (command, open) = (tokens.next(), self.files.last_mut().expect("there is always one"));
        match command {
            Some("NOFILE") | Some("!DATA") => open.closed = true,
            Some("STEP") => open.file.steps.push(StepLine { line: number, view: None }),
            Some("ROTSTEP") => {
                let view = rotation_step(tokens);
                if view.is_none() {
                    self.warnings.add("malformed line", format!("{source}: line {number}: ROTSTEP without angles"));
                }
                open.file.steps.push(StepLine { line: number, view });
            }
            Some("BFC") => open.culling(tokens),
            Some("!LDRAW_ORG") => {
                if let Some(kind) = tokens.next().and_then(organization_kind)
                    && !open.stated_kind
                {
                    // A name that ends in .dat is a part, whatever its header says.
                    if open.file.kind == FileKind::Model || kind != FileKind::Model {
                        open.file.kind = kind;
                    }
                    open.stated_kind = true;
                }
            }
            // The textured branch hides in `0 !:` comments; the fallback branch is plain lines, so it is what we draw.
            Some("!TEXMAP") => {
                if matches!(tokens.next(), Some("START" | "NEXT")) {
                    let picture = tokens.0.split_whitespace().last().unwrap_or("");
                    self.warnings.add(
                        "texture",
                        format!(
                            "{source}: line {number}: the texture {picture} is not drawn; plain geometry stands in"
                        ),
                    );
                }
            }
            Some("!:") => {}
            Some("!MOBILEBRICK") => {
                if tokens.next() == Some("STUD")
                    && let Ok([x, y, z, dx, dy, dz]) = tokens.numbers()
                    && let Some(axis) = Vector3::new(dx, dy, dz).try_normalize(1e-6)
                {
                    open.file.studs.push(StudSite { foot: Point3::new(x, y, z), axis });
                }
            }
            Some("!COLOUR") => match Color::parse(tokens.0) {
                Some(color) => self.colors.push(color),
                None => self.warnings.add(
                    "malformed line",
                    format!("{source}: line {number}: a colour definition without name, CODE or VALUE"),
                ),
            },
            _ => {
                if !open.described && !whole.is_empty() {
                    open.described = true;
                    let lower = whole.to_lowercase();
                    if let Some(target) = lower.strip_prefix("~moved to ") {
                        let target = normalized_name(target);
                        open.file.moved_to = Some(if target.ends_with(".dat") { target } else { target + ".dat" });
                    }
                    open.file.description = whole.to_owned();
                }
                return;
            }
        }
        // The description is the first line of a file, or none.
        open.described = true;
    }

    fn reference(&mut self, mut tokens: Tokens, number: u32) -> Result<(), Malformed> {
        let open = self.open();
        // Spent here, whatever becomes of the rest of the line.
        let inverted = std::mem::take(&mut open.invert_next);
        let color = tokens.color()?;
        let [x, y, z, a, b, c, d, e, f, g, h, i] = tokens.numbers()?;
        let name = normalized_name(tokens.0);
        if name.is_empty() {
            return Err(Malformed::Line("the reference names no file"));
        }
        let parent_from_child =
            Affine { linear: Matrix3::new(a, b, c, d, e, f, g, h, i), offset: Vector3::new(x, y, z) };
        let (clipped, step) = (open.clip, open.file.steps.len() as u32);
        open.file.references.push(Reference {
            name,
            target: None,
            color,
            parent_from_child,
            inverted,
            clipped,
            line: number,
            step,
        });
        Ok(())
    }

    fn edge(&mut self, mut tokens: Tokens) -> Result<(), Malformed> {
        let color = tokens.color()?;
        let [a, b, c, d, e, f] = tokens.numbers()?;
        self.open().file.edges.push(EdgeLine { color, ends: [Point3::new(a, b, c), Point3::new(d, e, f)] });
        Ok(())
    }

    fn polygon<const CORNERS: usize>(&mut self, mut tokens: Tokens) -> Result<(), Malformed> {
        let color = tokens.color()?;
        let mut corners = [Point3::origin(); CORNERS];
        for corner in &mut corners {
            let [x, y, z] = tokens.numbers()?;
            *corner = Point3::new(x, y, z);
        }
        let open = self.open();
        if open.clockwise {
            corners.reverse();
        }
        let two_sided = !open.clip || open.file.certified != Some(true);
        let mut push = |a, b, c| open.file.faces.push(Face { color, corners: [a, b, c], two_sided });
        if CORNERS == 3 {
            push(corners[0], corners[1], corners[2]);
        } else {
            let [a, b, c, d] = [corners[0], corners[1], corners[2], corners[3]];
            // A quad with a re-entrant corner must be cut at that corner.
            let normal = |p: Point3<f64>, q: Point3<f64>, r: Point3<f64>| (q - p).cross(&(r - p));
            if normal(a, b, c).dot(&normal(a, c, d)) >= 0.0 {
                push(a, b, c);
                push(a, c, d);
            } else {
                push(b, c, d);
                push(b, d, a);
            }
        }
        Ok(())
    }

    fn finish(self, text: &str) -> Document {
        let single = self.files.len() == 1 && !self.files[0].has_name_line;
        let files = self
            .files
            .into_iter()
            .map(|mut open| {
                open.file.text =
                    if single { text.to_owned() } else { body(&text[open.span.clone()], open.has_name_line) };
                open.file
            })
            .collect();
        Document { files, colors: self.colors, useful_lines: self.useful }
    }
}

impl OpenFile {
    fn culling(&mut self, tokens: Tokens) {
        for word in tokens.0.split_whitespace() {
            match word {
                "CERTIFY" => self.file.certified = Some(true),
                "NOCERTIFY" => self.file.certified = Some(false),
                "CW" => self.clockwise = true,
                "CCW" => self.clockwise = false,
                "CLIP" => self.clip = true,
                "NOCLIP" => self.clip = false,
                "INVERTNEXT" => self.invert_next = true,
                _ => {}
            }
            // Any statement but NOCERTIFY declares that the author took care of windings. INVERTNEXT alone is also
            // written into models, which say nothing about their parts.
            if matches!(word, "CW" | "CCW" | "CLIP" | "NOCLIP") && self.file.certified.is_none() {
                self.file.certified = Some(true);
            }
        }
    }
}

/// The text of a file in a container, without its `0 FILE` line.
fn body(span: &str, has_name_line: bool) -> String {
    if has_name_line { span.split_once('\n').map_or("", |(_, rest)| rest).to_owned() } else { span.to_owned() }
}

fn file_line(rest: &str) -> Option<&str> {
    let rest = rest.trim_start();
    let name = rest.strip_prefix("FILE")?;
    if name.is_empty() || name.starts_with([' ', '\t']) { Some(name.trim()) } else { None }
}

fn organization_kind(word: &str) -> Option<FileKind> {
    let word = word.strip_prefix("Unofficial_").unwrap_or(word);
    match word.to_ascii_lowercase().as_str() {
        "part" | "shortcut" => Some(FileKind::Part),
        "subpart" | "primitive" | "8_primitive" | "48_primitive" => Some(FileKind::Piece),
        "model" => Some(FileKind::Model),
        _ => None,
    }
}

fn rotation_step(mut tokens: Tokens) -> Option<StepView> {
    if tokens.0.trim().eq_ignore_ascii_case("END") {
        return Some(StepView::Default);
    }
    let angles = tokens.numbers().ok()?;
    Some(match tokens.next() {
        Some(mode) if mode.eq_ignore_ascii_case("ABS") => StepView::Absolute(angles),
        Some(mode) if mode.eq_ignore_ascii_case("ADD") => StepView::Additive(angles),
        _ => StepView::Relative(angles),
    })
}

enum Malformed {
    Line(&'static str),
    Number(String),
}

/// The words of a line, one after the other.
#[derive(Clone, Copy)]
struct Tokens<'a>(&'a str);

impl<'a> Tokens<'a> {
    fn next(&mut self) -> Option<&'a str> {
        let rest = self.0.trim_start();
        if rest.is_empty() {
            return None;
        }
        let end = rest.find(|c: char| c.is_ascii_whitespace()).unwrap_or(rest.len());
        let (word, rest) = rest.split_at(end);
        self.0 = rest;
        Some(word)
    }

    fn color(&mut self) -> Result<ColorCode, Malformed> {
        let word = self.next().ok_or(Malformed::Line("it ends before its colour"))?;
        ColorCode::parse(word).ok_or(Malformed::Line("its colour is no number"))
    }

    fn numbers<const N: usize>(&mut self) -> Result<[f64; N], Malformed> {
        let mut numbers = [0.0_f64; N];
        for number in &mut numbers {
            let word = self.next().ok_or(Malformed::Line("it ends too early"))?;
            *number = word.parse().map_err(|_| Malformed::Line("one of its numbers is none"))?;
            if number.is_nan() || number.abs() > MAX_COORDINATE {
                return Err(Malformed::Number(word.to_owned()));
            }
        }
        Ok(numbers)
    }
}
