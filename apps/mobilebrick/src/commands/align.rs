//! `align`: where the object and the cameras are.

use clap::{Args, Subcommand};
use mb_align::{BoardOptions, BundleOptions, RefineOptions};
use mb_job::Result;

use super::board::BoardArgument;
use super::{Seed, SequenceArgument};
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Where the object and the cameras are
#[derive(Debug, Subcommand)]
pub enum Align {
    /// The object's pose from clicked points (annotation/keypoints.json)
    Keypoints(Keypoints),
    /// The object's pose from the model's edges in the photographs; starts from an alignment
    Refine(Refine),
    /// Every camera, with the model as the map; starts from an alignment
    Bundle(Bundle),
    /// Reference cameras from a calibration board in view (written to board/)
    Board(Board),
}

impl Align {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Keypoints(c) => c.run(terminal),
            Self::Refine(c) => c.run(terminal),
            Self::Bundle(c) => c.run(terminal),
            Self::Board(c) => c.run(terminal),
        }
    }
}

/// The object's pose from clicked points (annotation/keypoints.json)
#[derive(Debug, Args)]
pub struct Keypoints {
    #[command(flatten)]
    sequence: SequenceArgument,
}

impl Keypoints {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let sequence = self.sequence.open()?;
        let summary = mb_align::align_keypoints(&sequence, &Default::default(), terminal)?;
        let text = format!(
            "{} of {} clicks in {} frames, {:.2} px rms; standard deviation {:.2} mm, {:.3} deg\nwrote {}",
            summary.inliers,
            summary.points,
            summary.frames,
            summary.rms_px,
            summary.translation_std_mm,
            summary.rotation_std_deg,
            summary.written.display()
        );
        Outcome::new(&summary, text)
    }
}

/// The object's pose from the model's edges in the photographs; starts from an alignment
#[derive(Debug, Args)]
pub struct Refine {
    #[command(flatten)]
    sequence: SequenceArgument,

    /// Photographs to use, spread over the sequence
    #[arg(long, value_name = "N", default_value_t = RefineOptions::default().frames)]
    frames: usize,

    /// Estimate the object's size too, as the phone measures it
    #[arg(long)]
    scale: bool,

    #[command(flatten)]
    seed: Seed,
}

impl Refine {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let options =
            RefineOptions { frames: self.frames, scale: self.scale, seed: self.seed.seed, ..RefineOptions::default() };
        let summary = mb_align::align_refine(&self.sequence.open()?, &options, terminal)?;
        let text = format!(
            "moved {:.2} mm and {:.3} deg; {:.0} % of the visible edges found, {:.2} px rms; confidence {:.2}, \
             expected error {:.2} mm and {:.3} deg",
            summary.moved_mm,
            summary.turned_deg,
            summary.agreement * 100.0,
            summary.rms_px,
            summary.confidence,
            summary.expected_error_mm,
            summary.expected_error_deg
        );
        Outcome::new(&summary, text)
    }
}

/// Every camera, with the model as the map; starts from an alignment
#[derive(Debug, Args)]
pub struct Bundle {
    #[command(flatten)]
    sequence: SequenceArgument,

    /// Leave out features beside the model, as the paper does
    #[arg(long)]
    no_free_points: bool,

    /// Leave out the model's edges, as the paper does
    #[arg(long)]
    no_contours: bool,

    /// Leave out the phone's poses as priors from frame to frame
    #[arg(long)]
    no_relative_poses: bool,

    /// Estimate each frame's focal length too; the phone's intrinsics are kept in intrinsic_arkit/
    #[arg(long)]
    focal: bool,

    #[command(flatten)]
    seed: Seed,
}

impl Bundle {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let options = BundleOptions {
            free_points: !self.no_free_points,
            contours: !self.no_contours,
            relative_poses: !self.no_relative_poses,
            focal: self.focal,
            seed: self.seed.seed,
            ..BundleOptions::default()
        };
        let summary = mb_align::align_bundle(&self.sequence.open()?, &options, terminal)?;
        let text = format!(
            "{} cameras from {} points on the model and {} beside it, {:.2} px rms; cameras moved {:.2} mm rms",
            summary.frames.len(),
            summary.surface_points,
            summary.free_points,
            summary.rms_px,
            summary.moved_rms_mm
        );
        Outcome::new(&summary, text)
    }
}

/// Reference cameras from a calibration board in view (written to board/)
#[derive(Debug, Args)]
pub struct Board {
    #[command(flatten)]
    sequence: SequenceArgument,

    #[command(flatten)]
    board: BoardArgument,

    /// Estimate one camera with a lens for all frames, in the place of intrinsic/
    #[arg(long)]
    calibrate: bool,
}

impl Board {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let options = BoardOptions { calibrate: self.calibrate };
        let board = self.board.parse()?;
        let summary = mb_align::align_board(&self.sequence.open()?, &board, &options, terminal)?;
        let text = format!(
            "{} of {} frames posed from {} corners, {:.3} px rms\nwrote {}",
            summary.posed,
            summary.frames.len(),
            summary.corners,
            summary.rms_px,
            summary.written.display()
        );
        Outcome::new(&summary, text)
    }
}
