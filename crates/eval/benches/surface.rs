//! CPU time of a surface score: `cargo bench -p mb-eval --bench surface -- SEQUENCE PREDICTION [PROTOCOL [SEED]]`. Without
//! arguments it scores the test data's prediction with 1 mm of noise by each protocol.

use std::path::PathBuf;

use cpu_time::ProcessTime;
use mb_eval::{SurfaceOptions, SurfaceProtocol, evaluate_surface};

fn main() {
    let args: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let (gt, pred) = match args.as_slice() {
        [] => {
            let Some(folder) = mb_testdata::find("official_scorer") else { return };
            (folder.join("wedge"), folder.join("preds/noise1mm.ply"))
        }
        [gt, pred, ..] => (PathBuf::from(gt), PathBuf::from(pred)),
        [_] => panic!("usage: SEQUENCE PREDICTION [PROTOCOL [SEED]]"),
    };
    let protocols = match args.get(2) {
        Some(name) => vec![name.parse().expect("a protocol")],
        None => SurfaceProtocol::ALL.to_vec(),
    };
    let seed = args.get(3).map_or(0, |seed| seed.parse().expect("a seed"));
    for protocol in protocols {
        let options = SurfaceOptions { protocol, seed, ..SurfaceOptions::default() };
        let start = ProcessTime::now();
        let scores = evaluate_surface(&gt, &pred, &options, &mb_job::Silent).expect("a score");
        let cpu_seconds = start.elapsed().as_secs_f64();
        println!(
            "{protocol}: {cpu_seconds:.2} CPU s, {:.2} s; fitness {:.6}, Chamfer {:.5} mm ({:.5} + {:.5})",
            scores.seconds,
            scores.icp.fitness,
            scores.chamfer.chamfer_mm,
            scores.chamfer.pred_to_gt_mm,
            scores.chamfer.gt_to_pred_mm
        );
        for t in &scores.thresholds {
            println!("  {} mm: accuracy {:.5}, recall {:.5}, F1 {:.5}", t.threshold_mm, t.accuracy, t.recall, t.f1);
        }
    }
}
