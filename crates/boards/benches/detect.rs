//! Time to find a board in photographs: `cargo bench -p mb-boards -- BOARD PHOTO...`; `opencv_boards.py` beside this file
//! times OpenCV on the same ones.

use cpu_time::ProcessTime;
use mb_boards::{BoardDetector, BoardSpec, luma};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let [board, photos @ ..] = arguments.as_slice() else {
        println!("usage: cargo bench -p mb-boards -- BOARD PHOTO...");
        return;
    };
    let board = BoardSpec::parse(board).expect("a board");
    let detector = BoardDetector::new(&board);
    for photo in photos {
        let image = luma(&mb_image::read_rgb(photo).expect("a photograph"));
        let runs = 10;
        let mut best = f64::INFINITY;
        let mut corners = 0;
        for _ in 0..runs {
            let start = ProcessTime::now();
            corners = detector.detect(&image).corners.len();
            best = best.min(start.elapsed().as_secs_f64());
        }
        println!("{photo}: {}, {corners} corners, {:.1} ms of CPU (best of {runs})", image.size(), best * 1e3);
    }
}
