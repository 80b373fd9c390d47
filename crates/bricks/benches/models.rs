//! What reading, flattening and checking models cost, in CPU seconds. `cargo bench -p mb-bricks`

use cpu_time::ProcessTime;
use mb_bricks::{
    BatchSummary, CheckOptions, MeshOptions, Model, PartLibrary, RandomOptions, demo_model, random_models,
};
use mb_job::Silent;

fn timed<T>(what: &str, run: impl FnOnce() -> T) -> T {
    let start = ProcessTime::now();
    let result = run();
    println!("{what}: {:.3} CPU s", start.elapsed().as_secs_f64());
    result
}

fn main() {
    let castle = timed("built-in castle: draw its bricks", demo_model);
    timed("built-in castle: mesh", || castle.mesh(&MeshOptions::default()));
    timed("built-in castle: check", || castle.check(&CheckOptions::default())).expect("the castle is complete");
    let Some(library) = mb_testdata::find("ldraw/parts.zip") else { return };
    for name in ["10214-1-tower-bridge", "10182-1-cafe-corner"] {
        let Some(path) = mb_testdata::find(&format!("ldraw/models/{name}.mpd")) else { return };
        let (model, triangles) = timed(&format!("{name}: open the library, read, flatten"), || {
            let library = PartLibrary::open(&library).expect("a library");
            let model = Model::read(&path, Some(&library)).expect("a model");
            let mesh = model.mesh(&MeshOptions::default());
            (model, mesh.triangles.len())
        });
        println!("{name}: {triangles} triangles");
        let report = timed(&format!("{name}: check"), || model.check(&CheckOptions::default()));
        if let Ok(report) = report {
            println!(
                "{name}: {} parts, {} covered, {} studs gripped, {:?}, {} groups, {} collisions, stable: {}",
                report.parts,
                report.covered_parts,
                report.connections,
                report.joints,
                report.groups,
                report.collisions.len(),
                report.stable.map_or("unknown", |stable| if stable { "yes" } else { "no" })
            );
        }
    }
    let batch = timed("135 random models", || random_models(&RandomOptions::default(), 135, &Silent));
    if let Ok(batch) = batch {
        println!("random models: {:#?}", BatchSummary::of(&batch));
    }
    let options = RandomOptions { bricks: 150, ..RandomOptions::default() };
    if let Ok(large) = mb_bricks::random_model(&options, 0) {
        timed("random model of 150 bricks: check", || large.model.check(&CheckOptions::default()))
            .expect("random models are complete");
    }
}
