//! `align`: where the object and the cameras are.

use clap::{Args, Subcommand};
use mb_job::Result;

use super::SequenceArgument;
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Where the object and the cameras are
#[derive(Debug, Subcommand)]
pub enum Align {
    /// The object's pose from clicked points (annotation/keypoints.json)
    Keypoints(Keypoints),
}

impl Align {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Keypoints(c) => c.run(terminal),
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
