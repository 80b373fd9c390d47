//! The published numbers.

use serde::Serialize;

use super::{Better, Column, Row, Table};

/// Where the published numbers come from.
pub const SOURCE: &str = "Li et al., MobileBrick: Building LEGO for 3D Reconstruction on Mobile Devices, CVPR 2023, \
                          means over the 18 test sequences; rows marked `later` as their authors report them \
                          (Voxurf by way of PoRF, ICLR 2024; GS2Mesh, ECCV 2024)";

/// The four tables of the paper.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum PaperTable {
    /// Accuracy, recall, F1 and Chamfer distance of reconstructed surfaces.
    Surfaces,
    /// PSNR, SSIM and LPIPS of novel views.
    Views,
    /// Errors of enhanced depth maps.
    Depth,
    /// Errors of camera poses, and what they cost a reconstruction.
    Poses,
}

/// Surfaces: accuracy, recall, F1 at 2.5 mm and at 5 mm in percent, Chamfer distance in mm.
const SURFACES: [(&str, &str, &str, [f64; 7]); 10] = [
    ("TSDF-Fusion", "depth", "paper", [42.07, 22.21, 28.77, 73.46, 42.75, 53.39, 13.78]),
    ("BNV-Fusion", "depth", "paper", [41.77, 25.96, 33.27, 71.20, 47.09, 55.11, 9.60]),
    ("Neural-RGBD", "RGBD", "paper", [20.61, 10.66, 13.67, 39.62, 22.06, 27.66, 22.78]),
    ("COLMAP", "RGB", "paper", [74.89, 68.20, 71.08, 93.79, 84.53, 88.71, 5.26]),
    ("Vis-MVSNet", "RGB", "paper", [79.83, 47.25, 58.32, 97.35, 65.90, 77.49, 9.27]),
    ("Vis-MVSNet, finetuned", "RGB", "paper", [75.64, 53.64, 62.01, 96.03, 72.42, 81.89, 9.52]),
    ("NeRF", "RGB", "paper", [47.11, 40.86, 43.55, 78.07, 69.93, 73.45, 7.98]),
    ("NeuS", "RGB", "paper", [77.35, 70.85, 73.74, 93.33, 86.11, 89.30, 4.74]),
    ("Voxurf", "RGB", "later", [78.44, 72.41, 75.13, 93.95, 87.53, 90.41, 4.71]),
    ("GS2Mesh", "RGB and masks", "later", [68.77, 69.27, 68.94, 89.46, 87.37, 88.28, 4.94]),
];

/// Views: PSNR in dB, SSIM, LPIPS.
const VIEWS: [(&str, [f64; 3]); 3] =
    [("NeRF", [20.66, 0.64, 0.49]), ("DVGO", [20.64, 0.67, 0.44]), ("NeuS", [21.49, 0.67, 0.48])];

/// Depth: AbsRel, SqRel, RMSE, RMSE log, three deltas.
const DEPTH: [(&str, [f64; 7]); 3] = [
    ("nearest neighbour", [0.0845, 0.0177, 0.0663, 0.1327, 0.9360, 0.9748, 0.9878]),
    ("MSPF", [0.0806, 0.0144, 0.0588, 0.1231, 0.9413, 0.9787, 0.9902]),
    ("MSPF, finetuned", [0.0678, 0.0056, 0.0413, 0.0920, 0.9441, 0.9932, 0.9983]),
];

/// Poses: translation in mm and rotation in degrees, RMS over pairs of frames against a board; share of a TSDF
/// reconstruction's points within 1 mm, and of the truth's, in percent. The last row is a simulation, whose poses were
/// perturbed on purpose; the paper gives no pose error for it.
const POSES: [(&str, [Option<f64>; 4]); 3] = [
    ("ARKit", [Some(4.454), Some(0.581), Some(90.1), Some(91.3)]),
    ("refined", [Some(2.060), Some(0.522), Some(93.7), Some(93.8)]),
    ("perturbed, synthetic depth", [None, None, Some(85.9), Some(84.0)]),
];

impl PaperTable {
    /// The four, in the order of the paper.
    pub const ALL: [Self; 4] = [Self::Surfaces, Self::Views, Self::Depth, Self::Poses];

    /// The name on the command line, and of the files that hold the table.
    pub fn name(self) -> &'static str {
        match self {
            Self::Surfaces => "surfaces",
            Self::Views => "views",
            Self::Depth => "depth",
            Self::Poses => "poses",
        }
    }

    /// The protocol whose numbers may stand beside the published ones.
    pub fn protocol(self) -> &'static str {
        match self {
            Self::Surfaces => crate::SurfaceProtocol::MobileBrick2023.name(),
            Self::Views => crate::VIEWS_PROTOCOL,
            Self::Depth => crate::DEPTH_PROTOCOL,
            Self::Poses => crate::POSES_PROTOCOL,
        }
    }

    /// The column by which methods are compared: F1 at 2.5 mm, PSNR, AbsRel, translation.
    pub fn headline(self) -> usize {
        match self {
            Self::Surfaces => 2,
            Self::Views | Self::Depth | Self::Poses => 0,
        }
    }

    /// The table as published.
    pub fn published(self) -> Table {
        let (title, columns, rows): (&str, Vec<Column>, Vec<Row>) = match self {
            Self::Surfaces => (
                "Reconstructed surfaces",
                columns(
                    &["acc 2.5 mm %", "rec 2.5 mm %", "F1 2.5 mm %", "acc 5 mm %", "rec 5 mm %", "F1 5 mm %"],
                    Better::Higher,
                    2,
                )
                .chain(columns(&["Chamfer mm"], Better::Lower, 2))
                .collect(),
                SURFACES.iter().map(|(m, input, origin, v)| row(m, input, origin, v.map(Some))).collect(),
            ),
            Self::Views => (
                "Novel views",
                columns(&["PSNR dB"], Better::Higher, 2)
                    .chain(columns(&["SSIM"], Better::Higher, 2))
                    .chain(columns(&["LPIPS"], Better::Lower, 2))
                    .collect(),
                VIEWS.iter().map(|(m, v)| row(m, "RGB", "paper", v.map(Some))).collect(),
            ),
            Self::Depth => (
                "Enhanced depth maps",
                columns(&["AbsRel", "SqRel m", "RMSE m", "RMSE log"], Better::Lower, 4)
                    .chain(columns(&["delta 1", "delta 2", "delta 3"], Better::Higher, 4))
                    .collect(),
                DEPTH.iter().map(|(m, v)| row(m, "", "paper", v.map(Some))).collect(),
            ),
            Self::Poses => (
                "Camera poses",
                columns(&["translation mm", "rotation deg"], Better::Lower, 3)
                    .chain(columns(&["acc 1 mm %", "rec 1 mm %"], Better::Higher, 1))
                    .collect(),
                POSES.iter().map(|(m, v)| row(m, "", "paper", *v)).collect(),
            ),
        };
        Table { title: title.to_owned(), columns, rows }
    }
}

fn columns<'a>(names: &'a [&str], better: Better, digits: usize) -> impl Iterator<Item = Column> + use<'a> {
    names.iter().map(move |name| Column { name: (*name).to_owned(), better, digits })
}

fn row<const N: usize>(method: &str, input: &str, origin: &str, values: [Option<f64>; N]) -> Row {
    Row { method: method.to_owned(), input: input.to_owned(), origin: origin.to_owned(), values: values.to_vec() }
}

/// From the lower-case name.
impl std::str::FromStr for PaperTable {
    type Err = String;
    fn from_str(name: &str) -> Result<Self, String> {
        let names = Self::ALL.map(Self::name);
        let found = Self::ALL.into_iter().find(|t| t.name() == name);
        found.ok_or_else(|| format!("no table {name:?}; there are {}", names.join(", ")))
    }
}
