//! CPU time of the visibility volume of 40 frames over 400,000 voxels.
//!
//! `cargo bench -p mb-truth`; reading and rendering are not counted.

use cpu_time::ProcessTime;
use mb_capture::Sequence;
use mb_render::View;
use mb_truth::visibility;

fn main() {
    let Some(wedge) = mb_testdata::find("official_scorer/wedge") else { return };
    let sequence = Sequence::open(&wedge).expect("the wedge is a sequence");
    let frames: Vec<_> = sequence
        .frames()
        .iter()
        .map(|f| {
            let depth = sequence.read_gt_depth(f).expect("the wedge has exact depth");
            let cam_from_frame = f.world_from_cam.inverse();
            (View { intrinsics: f.intrinsics, size: depth.size(), cam_from_frame }, depth)
        })
        .collect();
    let mesh = mb_mesh::read_mesh(wedge.join("mesh/cad_mesh.ply")).expect("the wedge has its exact mesh");
    for _ in 0..3 {
        let start = ProcessTime::now();
        let mut volume = visibility::empty_volume(&mesh.bounds(), 0.02, 0.00234).expect("a small volume");
        frames.iter().for_each(|(view, depth)| visibility::observe(&mut volume, depth, view));
        println!("visibility of {} voxels: {:.3} CPU s", volume.mask.len(), start.elapsed().as_secs_f64());
    }
}
