//! Random models that can really be built.
//!
//! A model grows brick by brick on the grid of studs and plates. A new brick goes onto free studs of earlier ones (or,
//! rarely, under them), where its cells and the whole way above (or below) it are free; so bricks never overlap, all
//! hold together, and the order of growth is an order of building. A style says where bricks may go, which makes
//! towers, walls, clusters, bridges and trees. The finished model is then judged like any other by
//! [`Model::check`](crate::Model::check): one that collides, tips or comes apart is thrown away and grown anew.

mod grid_part;
mod grow;
mod profile;

use std::collections::{BTreeMap, BTreeSet};

use mb_job::{Error, Progress, Result, Steps, rng};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::check::CheckOptions;
use crate::model::Model;
use grid_part::GridPart;
use grow::Growth;

pub use profile::{RandomProfile, Style};

/// How often a model is grown anew before giving up.
const ATTEMPTS: u64 = 60;
/// No stud of a random model bears more than this share of its clutch force: real bricks vary.
const MAX_LOAD: f64 = 0.8;

/// What to grow.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RandomOptions {
    /// Bricks of each model, 2 to 2000; 0 draws a number between 25 and 150 for each.
    pub bricks: usize,
    /// Seed; the same seed gives the same models.
    pub seed: u64,
    /// Distributions and limits.
    pub profile: RandomProfile,
}

/// What a random model is like.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RandomSummary {
    /// Its number in the batch.
    pub index: usize,
    /// Its shape.
    pub style: Style,
    /// Bricks.
    pub parts: usize,
    /// Edges of its box in the object frame (y up), millimetres.
    pub size_mm: [f64; 3],
    /// Share of its columns of studs that stand on nothing.
    pub overhang: f64,
    /// Largest share of the clutch force that a stud bears.
    pub load: f64,
    /// How many bricks of each part.
    pub bricks: BTreeMap<String, usize>,
    /// How many bricks of each colour.
    pub colors: BTreeMap<String, usize>,
}

/// A random model with its figures.
#[derive(Debug, Clone)]
pub struct RandomModel {
    /// The model; [`Model::write_ldraw`] writes it with steps.
    pub model: Model,
    /// Its figures.
    pub summary: RandomSummary,
}

/// One random model: number `index` of the batch that `options` describe.
///
/// # Errors
/// `Error::Failed` where the options leave no room for a model that stands.
pub fn random_model(options: &RandomOptions, index: usize) -> Result<RandomModel> {
    let parts = prepare(options)?;
    grow_until_it_stands(options, &parts, index)
}

/// A batch of `count` random models, no two alike.
///
/// # Errors
/// As for [`random_model`]; `Error::Stopped`.
pub fn random_models(options: &RandomOptions, count: usize, progress: &dyn Progress) -> Result<Vec<RandomModel>> {
    let parts = prepare(options)?;
    let steps = Steps::new(progress, "growing models", count);
    let models: Vec<RandomModel> = (0..count)
        .into_par_iter()
        .map(|index| {
            let model = grow_until_it_stands(options, &parts, index)?;
            steps.step()?;
            Ok(model)
        })
        .collect::<Result<_>>()?;
    let mut seen = BTreeSet::new();
    if let Some(twin) = models.iter().find(|model| !seen.insert(model.model.to_ldraw())) {
        let index = twin.summary.index;
        return Err(Error::Failed(format!("model {index} is like an earlier one: the profile leaves too few choices")));
    }
    Ok(models)
}

/// The bricks of the profile in all orientations, with their weights.
fn prepare(options: &RandomOptions) -> Result<Vec<(GridPart, f64)>> {
    options.profile.validate().map_err(|found| Error::Failed(format!("the profile cannot be used: {found}")))?;
    if options.bricks == 1 || options.bricks > 2000 {
        return Err(Error::Failed("a random model has 2 to 2000 bricks (0 draws the number)".to_owned()));
    }
    let mut parts = vec![];
    for (number, &weight) in &options.profile.bricks {
        for part in GridPart::orientations(number) {
            if weight > 0.0 && !part.sockets.is_empty() {
                parts.push((part, weight / 4.0));
            }
        }
    }
    if parts.iter().all(|(part, _)| part.studs.is_empty()) {
        return Err(Error::Failed("the profile has no brick with studs that fits the grid".to_owned()));
    }
    Ok(parts)
}

fn grow_until_it_stands(options: &RandomOptions, parts: &[(GridPart, f64)], index: usize) -> Result<RandomModel> {
    for attempt in 0..ATTEMPTS {
        // One stream for each attempt at each model.
        let mut rng = rng(options.seed, index as u64 * ATTEMPTS + attempt);
        let growth = Growth::new(options, parts, &mut rng).run(&mut rng);
        let Some(sketch) = growth.sketch(&format!("Random model {index} (seed {})", options.seed)) else { continue };
        let model = Model::from_text(&sketch, "random.ldr", None)?;
        let info = model.info();
        let Some(bounds) = info.bbox_mm else { continue };
        let size_mm: [f64; 3] = std::array::from_fn(|i| bounds.max[i] - bounds.min[i]);
        let largest = size_mm.iter().copied().fold(0.0, f64::max);
        if largest < options.profile.min_size_mm || largest > options.profile.max_size_mm {
            continue;
        }
        let report = model.check(&CheckOptions::default())?;
        let load = report.weakest.as_ref().map_or(0.0, |weakest| weakest.load);
        let sound = report.connected && report.stable && report.buildable && report.collisions.is_empty();
        if !sound || load > MAX_LOAD {
            continue;
        }
        let (mut bricks, mut colors) = (BTreeMap::new(), BTreeMap::new());
        for line in &info.bom {
            *bricks.entry(line.part.clone()).or_default() += line.count;
            *colors.entry(line.color_name.clone()).or_default() += line.count;
        }
        let overhang = growth.overhang();
        let summary =
            RandomSummary { index, style: growth.style, parts: info.parts, size_mm, overhang, load, bricks, colors };
        return Ok(RandomModel { model, summary });
    }
    Err(Error::Failed(format!(
        "no model of the wanted size that stands was found in {ATTEMPTS} attempts; ask for another number of bricks or \
         a wider profile"
    )))
}
