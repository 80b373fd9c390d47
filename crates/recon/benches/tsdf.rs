//! CPU time of fusing 40 depth maps of 1440x1920 at 1 mm a voxel, apart from reading the files.
//!
//! `cargo bench -p mb-recon`; `benches/open3d_tsdf.py` does the same with Open3D.

use cpu_time::ProcessTime;
use mb_capture::Sequence;
use mb_recon::TsdfVolume;

fn main() {
    let Some(root) = mb_testdata::find("official_scorer/wedge") else { return };
    let sequence = Sequence::open(root).expect("the wedge is a sequence");
    let frames = sequence.frames();
    let depths: Vec<_> = frames.iter().map(|f| sequence.read_gt_depth(f).expect("the wedge has exact depth")).collect();
    for run in 0..3 {
        let start = ProcessTime::now();
        let mut volume = TsdfVolume::new(0.001, 0.004).expect("valid sizes");
        for (frame, depth) in frames.iter().zip(&depths) {
            volume.integrate(depth, None, &frame.intrinsics, &frame.world_from_cam.inverse()).expect("a small volume");
        }
        let integrated = start.elapsed().as_secs_f64();
        let mesh = volume.extract_mesh(1.0);
        let extracted = start.elapsed().as_secs_f64() - integrated;
        println!(
            "run {run}: {} frames {}: integrate {integrated:.3} CPU s, extract {extracted:.3} CPU s, {} blocks, {} triangles",
            frames.len(),
            sequence.image_size(),
            volume.blocks(),
            mesh.triangles.len()
        );
    }
}
