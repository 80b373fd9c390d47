//! `board`: calibration boards to print, and cameras calibrated with them.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use mb_boards::{BoardSpec, Paper};
use mb_job::{Error, InputError, Result, write_atomic};
use serde::Serialize;

use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Calibration boards: print one, or calibrate a camera with it
#[derive(Debug, Subcommand)]
pub enum Board {
    /// A board to print in true size (.pdf), or as an image (.png)
    Print(Print),
    /// The camera that took some photographs of a board
    Calibrate(Calibrate),
}

impl Board {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Print(c) => c.run(),
            Self::Calibrate(c) => c.run(terminal),
        }
    }
}

/// Which board.
#[derive(Debug, Args)]
pub struct BoardArgument {
    /// `charuco:COLUMNSxROWS:SQUARE_M:MARKER_M:DICTIONARY[:legacy]`, `grid:COLUMNSxROWS:MARKER_M:GAP_M:DICTIONARY[:FIRST_ID]`,
    /// or a .json or .yml file (docs/formats.md)
    #[arg(long, value_name = "SPEC")]
    board: String,
}

impl BoardArgument {
    /// The board.
    pub fn parse(&self) -> Result<BoardSpec> {
        BoardSpec::parse(&self.board)
    }
}

/// Paper sizes.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum PaperName {
    /// A page of the board's own size
    Fit,
    A4,
    A3,
    A2,
    A1,
    A0,
    Letter,
}

impl PaperName {
    fn paper(self) -> Paper {
        match self {
            Self::Fit => Paper::Fit,
            Self::A4 => Paper::A4,
            Self::A3 => Paper::A3,
            Self::A2 => Paper::A2,
            Self::A1 => Paper::A1,
            Self::A0 => Paper::A0,
            Self::Letter => Paper::Letter,
        }
    }
}

/// A board to print in true size (.pdf), or as an image (.png)
#[derive(Debug, Args)]
pub struct Print {
    /// The board, such as charuco:5x7:0.04:0.02:DICT_6X6_250
    #[arg(value_name = "SPEC")]
    board: String,

    /// The file: .pdf (vectors, true size) or .png
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,

    /// Paper of a PDF
    #[arg(long, value_enum, default_value = "fit")]
    paper: PaperName,

    /// Dots per inch of a PNG
    #[arg(long, value_name = "N", default_value_t = 300.0)]
    dpi: f64,
}

/// What was printed.
#[derive(Serialize)]
struct Printed {
    board: String,
    width_mm: f64,
    height_mm: f64,
    markers: usize,
    corners: usize,
    written: PathBuf,
}

impl Print {
    fn run(&self) -> Result<Outcome> {
        let board = BoardSpec::parse(&self.board)?;
        let extension = self.output.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
        match extension.as_str() {
            "pdf" => write_atomic(&self.output, &board.pdf(self.paper.paper())?)?,
            "png" => {
                const MARGIN_M: f64 = 0.01;
                if !(10.0..=2400.0).contains(&self.dpi)
                    || board.texture_size(self.dpi, MARGIN_M).pixels() > mb_image::MAX_PIXELS
                {
                    return Err(Error::Failed(format!(
                        "--dpi {} makes no image: choose 10 to 2400, or less",
                        self.dpi
                    )));
                }
                let gray = board.texture(self.dpi, MARGIN_M);
                mb_image::write_rgb_png(&self.output, &gray.map(|v| [*v; 3]))?;
            }
            _ => {
                return Err(InputError::new(&self.output, "neither a .pdf nor a .png")
                    .help("Name the output with one of the two endings")
                    .into());
            }
        }
        let [width_mm, height_mm] = board.size_m().map(|m| m * 1e3);
        let printed = Printed {
            board: board.to_string(),
            width_mm,
            height_mm,
            markers: board.markers().len(),
            corners: board.corners().len(),
            written: self.output.clone(),
        };
        let text = format!(
            "{board}: {width_mm:.1} x {height_mm:.1} mm, {} markers, {} corners\nwrote {}",
            printed.markers,
            printed.corners,
            self.output.display()
        );
        Outcome::new(&printed, text)
    }
}

/// The camera that took some photographs of a board
#[derive(Debug, Args)]
pub struct Calibrate {
    /// Photographs (PNG or JPEG) of one camera with a fixed focus, the board tilted differently in each
    #[arg(value_name = "PHOTO", required = true)]
    photos: Vec<PathBuf>,

    #[command(flatten)]
    board: BoardArgument,
}

impl Calibrate {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let result = mb_align::calibrate_photos(&self.photos, &self.board.parse()?, terminal)?;
        let c = &result.calibration;
        let k = c.camera.intrinsics;
        let [k1, k2, p1, p2, k3] = c.camera.distortion;
        let text = format!(
            "fx {:.2} fy {:.2} cx {:.2} cy {:.2} px, k1 {k1:.4} k2 {k2:.4} p1 {p1:.5} p2 {p2:.5} k3 {k3:.4}; {:.3} px rms over \
             {} views",
            k.fx, k.fy, k.cx, k.cy, c.rms_px, c.views
        );
        Outcome::new(&result, text)
    }
}
