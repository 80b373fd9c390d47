//! Captures of random models on a calibration board, for the study of camera poses.

use std::path::{Path, PathBuf};

use mb_boards::BoardSpec;
use mb_bricks::{RandomOptions, random_model};
use mb_geometry::ImageSize;
use mb_job::{InputError, Progress, Result};
use mb_simulate::{Quality, SimulateOptions};

use crate::model_capture::{ModelCapture, simulate_model};

/// Which sequences to simulate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BoardSequences {
    /// How many, each of another model.
    pub count: usize,
    /// Photographs of each.
    pub frames: usize,
    /// Their size.
    pub size: ImageSize,
    /// Seed of models and captures.
    pub seed: u64,
}

/// Simulates captures of random models that stand on a printed `board`, as folders of `out`, and returns them. A folder
/// that is complete is not simulated again, and an unfinished one is taken up; other options make other folders.
///
/// # Errors
/// A simulation fails, a file cannot be written, or the person asked for a stop.
pub fn simulate_board_sequences(
    board: &BoardSpec,
    options: &BoardSequences,
    out: &Path,
    progress: &dyn Progress,
) -> Result<Vec<PathBuf>> {
    let BoardSequences { count, frames, size, seed } = *options;
    (0..count)
        .map(|i| {
            progress.report("board sequences", i, count);
            let folder = out.join(format!("{i:02}-{frames}-{size}-seed{seed}"));
            // The model is written last; once bundle-adjusted, the sequence's poses are no longer the simulator's.
            if folder.join("model/model.mpd").exists() {
                return same_board(&folder, board).map(|()| folder);
            }
            let model = random_model(&RandomOptions { seed, ..RandomOptions::default() }, i)?.model;
            let capture = ModelCapture {
                simulate: SimulateOptions {
                    frames,
                    size,
                    quality: Quality::Draft,
                    seed: seed.wrapping_add(i as u64),
                    board: Some(board.to_string()),
                    ..SimulateOptions::default()
                },
                ..ModelCapture::default()
            };
            simulate_model(&model, &capture, &folder, progress)?;
            Ok(folder)
        })
        .collect()
}

/// Refuses a finished sequence of another board.
fn same_board(folder: &Path, board: &BoardSpec) -> Result<()> {
    let path = folder.join("simulation/board.json");
    let bytes = std::fs::read(&path).map_err(|e| InputError::unreadable(&path, &e))?;
    let record: serde_json::Value =
        serde_json::from_slice(&bytes).map_err(|e| InputError::new(&path, format!("not JSON ({e})")))?;
    let text = board.to_string();
    if record["board"].as_str() == Some(&text) {
        return Ok(());
    }
    let found = format!("the board is {}, not {text}", record["board"]);
    Err(InputError::new(&path, found).help("Give another output folder for another board").into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_job::Silent;

    #[test]
    fn finished_sequences_are_kept_and_those_of_another_board_refused() {
        let dir = tempfile::tempdir().unwrap();
        let board: BoardSpec = "charuco:7x5:0.030:0.022:DICT_5X5_100".parse().unwrap();
        let options = BoardSequences { count: 2, frames: 2, size: ImageSize::new(160, 120), seed: 4 };
        let folders = simulate_board_sequences(&board, &options, dir.path(), &Silent).unwrap();
        assert_eq!(folders.len(), 2);
        let models: Vec<_> = folders.iter().map(|f| std::fs::read(f.join("model/model.mpd")).unwrap()).collect();
        assert_ne!(models[0], models[1]);
        // What lies there stays: a pose that alignment has changed is not overwritten.
        let pose = folders[0].join("pose/000000.txt");
        std::fs::write(&pose, "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1").unwrap();
        assert_eq!(simulate_board_sequences(&board, &options, dir.path(), &Silent).unwrap(), folders);
        assert!(std::fs::read_to_string(&pose).unwrap().starts_with("1 0 0 0 0 1"));
        let other: BoardSpec = "charuco:5x7:0.030:0.022:DICT_5X5_100".parse().unwrap();
        let refusal = simulate_board_sequences(&other, &options, dir.path(), &Silent).unwrap_err().to_string();
        assert!(refusal.contains("another board"), "{refusal}");
    }
}
