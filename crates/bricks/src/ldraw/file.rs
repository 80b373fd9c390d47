//! One LDraw file in memory: what its lines say, before anything is looked up.

use nalgebra::{Matrix3, Point3, Vector3};

use super::colors::ColorCode;

/// Index of a file within its [`Model`](crate::Model).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct FileId(pub(crate) u32);

impl FileId {
    /// Position in [`Model::files`](crate::Model::files).
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

/// What a file is, as its `!LDRAW_ORG` line, its name or its place in the library says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileKind {
    /// A model or submodel: it is made of parts.
    Model,
    /// A part or shortcut: one brick, when a model refers to it.
    Part,
    /// A piece of a part (subpart or primitive).
    Piece,
}

/// An affine map between two LDraw frames, LDraw units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Affine {
    /// Linear part.
    pub linear: Matrix3<f64>,
    /// Image of the origin.
    pub offset: Vector3<f64>,
}

impl Affine {
    /// The map that changes nothing.
    pub fn identity() -> Self {
        Self { linear: Matrix3::identity(), offset: Vector3::zeros() }
    }

    /// A shift by `offset`.
    pub fn translation(offset: Vector3<f64>) -> Self {
        Self { linear: Matrix3::identity(), offset }
    }

    /// `self` after `inner`.
    #[must_use]
    pub fn then_inner(&self, inner: &Self) -> Self {
        Self { linear: self.linear * inner.linear, offset: self.linear * inner.offset + self.offset }
    }

    /// The image of a point.
    pub fn apply(&self, p: &Point3<f64>) -> Point3<f64> {
        Point3::from(self.linear * p.coords + self.offset)
    }

    /// Whether the map turns left hands into right hands.
    pub fn is_mirrored(&self) -> bool {
        self.linear.determinant() < 0.0
    }

    /// The inverse, where there is one.
    pub fn inverse(&self) -> Option<Self> {
        let linear = self.linear.try_inverse()?;
        Some(Self { linear, offset: -(linear * self.offset) })
    }

    pub(crate) fn is_finite(&self) -> bool {
        self.linear.iter().chain(self.offset.iter()).all(|v| v.is_finite())
    }
}

/// A line of type 1: another file, placed and coloured.
#[derive(Debug, Clone, PartialEq)]
pub struct Reference {
    /// Name of the file, as [`normalized_name`] writes it.
    pub name: String,
    /// The file it stands for; `None` where no such file was found.
    pub target: Option<FileId>,
    /// Its colour; [`ColorCode::INHERIT`] takes the colour of the file that holds this line.
    pub color: ColorCode,
    /// Placement.
    pub parent_from_child: Affine,
    /// Whether `0 BFC INVERTNEXT` turns its surfaces inside out.
    pub inverted: bool,
    /// Whether back faces may be hidden (`0 BFC CLIP`, the default).
    pub clipped: bool,
    /// Line in the text file, counted from 1.
    pub line: u32,
    /// How many step lines come before it in its file.
    pub step: u32,
}

/// A triangle (a quad is two), counter-clockwise seen from outside wherever the file is certified.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Face {
    /// Its colour.
    pub color: ColorCode,
    /// Corners, LDraw units.
    pub corners: [Point3<f64>; 3],
    /// Whether nothing is known about its winding (uncertified) or both sides count (`NOCLIP`).
    pub two_sided: bool,
}

/// A line of type 2: a sharp edge, for drawings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EdgeLine {
    /// Its colour (nearly always 24, the edge colour of the part's colour).
    pub color: ColorCode,
    /// Ends, LDraw units.
    pub ends: [Point3<f64>; 2],
}

/// How `0 ROTSTEP` turns the view for the step it ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StepView {
    /// `REL`: about the default view, degrees about x, y, z.
    Relative([f64; 3]),
    /// `ABS`: instead of the default view.
    Absolute([f64; 3]),
    /// `ADD`: on top of the last step's view.
    Additive([f64; 3]),
    /// `END`: back to the default view.
    Default,
}

/// A `0 STEP` or `0 ROTSTEP` line: the end of a building step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepLine {
    /// Line in the text file, counted from 1.
    pub line: u32,
    /// The view that the step asks for, where it asks.
    pub view: Option<StepView>,
}

/// A stud: the middle of its foot, and the direction in which it points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StudSite {
    /// Middle of the circle where it leaves the part, LDraw units.
    pub foot: Point3<f64>,
    /// Unit vector towards its tip.
    pub axis: Vector3<f64>,
}

/// One LDraw file: a model, a part or a piece of a part.
#[derive(Debug, Clone, PartialEq)]
pub struct LdrawFile {
    /// Its name, as [`normalized_name`] writes it.
    pub name: String,
    /// The first comment line: what it is, for people. That of a part that moved is the new part's.
    pub description: String,
    /// What it is, for us.
    pub kind: FileKind,
    /// The text file that holds it (several may share one), for messages.
    pub source: String,
    /// Whether its windings can be trusted: `Some(true)` by `0 BFC CERTIFY`, `Some(false)` by `NOCERTIFY`.
    pub certified: Option<bool>,
    /// Where the part went, when this is a `~Moved to` file.
    pub moved_to: Option<String>,
    /// Lines of type 1, in order.
    pub references: Vec<Reference>,
    /// Lines of type 3 and 4, as triangles, in order.
    pub faces: Vec<Face>,
    /// Lines of type 2, in order.
    pub edges: Vec<EdgeLine>,
    /// Studs that the file itself states (`0 !MOBILEBRICK STUD x y z dx dy dz`), as our own parts do.
    pub studs: Vec<StudSite>,
    /// Step lines, in order. References after the last one form a last step.
    pub steps: Vec<StepLine>,
    /// Its own text, for copies that carry everything.
    pub text: String,
}

/// The name by which files find each other: lower case, forward slashes, no blanks around it.
pub fn normalized_name(name: &str) -> String {
    name.trim().to_lowercase().replace('\\', "/")
}
