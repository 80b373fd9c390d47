//! Random models that can really be built.
//!
//! A style (tower, gate, bridge, house and so on) says which squares each course of bricks fills; the course is then
//! laid in bond from the bricks of the profile, gaps below it are spanned, edges that stand out are held. Roofs,
//! battlements and small things follow, and free growth where a certain number of bricks is asked for. Every brick
//! comes from above (or, in free growth, hangs from another), so bricks never overlap and the way in is free. What
//! comes apart, leans or has the wrong size is thrown away at once; the rest is judged like any other model by
//! [`Model::check`](crate::Model::check), and kept where it is sound.

mod build;
mod grid_part;
mod masonry;
mod profile;
mod site;
mod styles;
mod summary;

use std::collections::BTreeSet;

use mb_job::{Error, Progress, Result, Rng, Steps, rng};
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::check::{CheckOptions, CheckReport};
use crate::model::Model;
use build::Build;
use grid_part::PartSet;
use site::Site;

pub use profile::{RandomProfile, Style};
pub use summary::{BatchSummary, MostAlike, RandomSummary, Spread};

/// How often a model is built anew before giving up.
const ATTEMPTS: u64 = 200;
/// Attempts at one style before another is drawn: styles that often fail would be rare otherwise. Styles that failed so
/// often are drawn again only when all have: few bricks are enough for few styles.
const PATIENCE: u64 = 20;
/// How often an attempt is built larger or smaller to come near the wanted number of bricks.
const FITTINGS: usize = 6;
/// An attempt of which less than this share holds together is not what its style says.
const WHOLE: f64 = 0.8;
/// No stud of a random model bears more than this share of its clutch force: real bricks vary.
const MAX_LOAD: f64 = 0.8;
/// A random model can be tilted so far before it falls over, degrees.
const MIN_TILT_DEG: f64 = 6.0;
/// Millimetres of a stud and of a plate.
const STUD_MM: f64 = 8.0;
const PLATE_MM: f64 = 3.2;
/// Bricks of a model whose number is left to chance.
const BRICKS: std::ops::RangeInclusive<usize> = 25..=150;

/// What to build.
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

/// A random model with its figures.
#[derive(Debug, Clone)]
pub struct RandomModel {
    /// The model; [`Model::write_ldraw`] writes it with steps.
    pub model: Model,
    /// Its figures.
    pub summary: RandomSummary,
    /// Filled cells from the low corner: studs, plates, studs.
    cells: BTreeSet<[i32; 3]>,
    /// What it looks like without its colours, whatever way it is turned.
    signature: Vec<(String, [i32; 6])>,
}

/// One random model: number `index` of the batch that `options` describe.
///
/// # Errors
/// `Error::Failed` where the options leave no room for a model that stands.
pub fn random_model(options: &RandomOptions, index: usize) -> Result<RandomModel> {
    let parts = prepare(options)?;
    build_until_sound(options, &parts, index, 0).map(|(model, _)| model)
}

/// A batch of `count` random models, no two alike: two never have the same bricks in the same places, whatever their
/// colours and whichever way they are turned.
///
/// # Errors
/// As for [`random_model`]; `Error::Stopped`.
pub fn random_models(options: &RandomOptions, count: usize, progress: &dyn Progress) -> Result<Vec<RandomModel>> {
    let parts = prepare(options)?;
    let steps = Steps::new(progress, "building models", count);
    let built: Vec<(RandomModel, u64)> = (0..count)
        .into_par_iter()
        .map(|index| {
            let model = build_until_sound(options, &parts, index, 0)?;
            steps.step()?;
            Ok(model)
        })
        .collect::<Result<_>>()?;
    let mut seen = BTreeSet::new();
    let mut models = Vec::with_capacity(count);
    for (mut model, mut attempt) in built {
        while !seen.insert(model.signature.clone()) {
            let index = model.summary.index;
            (model, attempt) = build_until_sound(options, &parts, index, attempt + 1)?;
        }
        models.push(model);
    }
    Ok(models)
}

/// The bricks of the profile.
fn prepare(options: &RandomOptions) -> Result<PartSet> {
    options.profile.validate().map_err(|found| Error::Failed(format!("the profile cannot be used: {found}")))?;
    if options.bricks == 1 || options.bricks > 2000 {
        return Err(Error::Failed("a random model has 2 to 2000 bricks (0 draws the number)".to_owned()));
    }
    let parts = PartSet::new(&options.profile.bricks);
    if parts.parts.iter().all(|(part, _)| part.studs.is_empty()) {
        return Err(Error::Failed("the profile has no brick with studs that fits the grid".to_owned()));
    }
    Ok(parts)
}

/// The first sound model from attempt number `first` on, and the number of its attempt.
fn build_until_sound(options: &RandomOptions, parts: &PartSet, index: usize, first: u64) -> Result<(RandomModel, u64)> {
    let mut style = Style::Sculpture;
    let mut untried = Vec::new();
    for attempt in first..ATTEMPTS {
        // One stream for each attempt at each model.
        let mut rng = rng(options.seed, index as u64 * ATTEMPTS + attempt);
        if attempt == first || attempt % PATIENCE == 0 {
            if untried.is_empty() {
                let styles = options.profile.styles.iter().filter(|(_, weight)| **weight > 0.0);
                untried.extend(styles.map(|(style, weight)| (*style, *weight)));
            }
            let drawn = draw(&mut rng, untried.iter().enumerate().map(|(at, (_, weight))| (at, *weight)));
            style = untried.swap_remove(drawn).0;
        }
        let Some(build) = build_one(options, parts, style, &mut rng) else { continue };
        let description = format!("Random model {index} (seed {})", options.seed);
        let as_placed: Vec<usize> = (0..build.placed.len()).collect();
        let model = Model::from_text(&build.sketch(&description, &as_placed), "random.ldr", None)?;
        let report = model.check(&CheckOptions::default())?;
        let load = report.weakest.as_ref().map_or(0.0, |weakest| weakest.load);
        if !is_sound(&report) || load > MAX_LOAD {
            continue;
        }
        let model = Model::from_text(&build.sketch(&description, &report.build_order), "random.ldr", None)?;
        let summary = RandomSummary::new(index, style, &build, &model, load);
        let signature = build.signature().into_iter().map(|(number, place)| (number.to_owned(), place)).collect();
        return Ok((RandomModel { model, summary, cells: build.cells(), signature }, attempt));
    }
    Err(Error::Failed(format!(
        "no model of the wanted size that stands was found in {ATTEMPTS} attempts; ask for another number of bricks or \
         a wider profile"
    )))
}

fn is_sound(report: &CheckReport) -> bool {
    report.connected && report.stable == Some(true) && report.buildable == Some(true) && report.collisions.is_empty()
}

/// One attempt: colours, and a size that comes near the wanted number of bricks; `None` where it has not the size that
/// is asked for, leans or does not hold together.
fn build_one<'a>(options: &RandomOptions, parts: &'a PartSet, style: Style, rng: &mut Rng) -> Option<Build<'a>> {
    let profile = &options.profile;
    let wanted = if options.bricks == 0 { rng.random_range(BRICKS) } else { options.bricks };
    let palette = palette(options, rng);
    let most = [(profile.max_size_mm / STUD_MM) as i32, (profile.max_size_mm / PLATE_MM) as i32 - 1];
    let room = [most[0].max(2), most[1].max(3), most[0].max(2)];
    let mut scale = (wanted as f64 / 150.0).sqrt();
    let mut site = None;
    for _ in 0..FITTINGS {
        let mut draft = Site::new(Build::new(parts, room), &palette, scale, rng);
        draft.build_style(style);
        let whole = draft.build.placed.len();
        let build = draft.build.largest_piece();
        if (build.placed.len() as f64) < WHOLE * whole as f64 {
            continue;
        }
        let share = build.placed.len() as f64 / wanted as f64;
        if (0.85..=1.0).contains(&share) {
            site = Some(build);
            break;
        }
        if share < 1.0 && site.as_ref().is_none_or(|known: &Build| known.placed.len() < build.placed.len()) {
            site = Some(build);
        }
        scale = (scale * (0.93 / share.max(0.05)).powf(0.6)).clamp(0.0, 2.0);
    }
    let mut site = Site::new(site?, &palette, scale, rng);
    if options.bricks > 0 {
        let lacking = wanted - site.build.placed.len();
        site.adorn(lacking);
        site.grow(wanted);
    }
    let build = site.build;
    let count = build.placed.len();
    let counted = if options.bricks == 0 { BRICKS.contains(&count) } else { count == wanted };
    let [x, y, z] = build.extent();
    let largest = (f64::from(x.max(z)) * STUD_MM).max(f64::from(y) * PLATE_MM);
    let sized = (profile.min_size_mm..=profile.max_size_mm).contains(&largest);
    (counted && sized && build.tilt_deg() >= MIN_TILT_DEG).then_some(build)
}

/// Different colours of the profile.
fn palette(options: &RandomOptions, rng: &mut Rng) -> Vec<u32> {
    let profile = &options.profile;
    let mut left: Vec<(u32, f64)> =
        profile.colors.iter().filter_map(|(code, &weight)| Some((code.parse().ok()?, weight))).collect();
    let mut palette = vec![];
    for _ in 0..rng.random_range(3.min(profile.max_colors)..=profile.max_colors) {
        if left.iter().all(|(_, weight)| *weight <= 0.0) {
            break;
        }
        let index = draw(rng, left.iter().enumerate().map(|(index, (_, weight))| (index, *weight)));
        palette.push(left.swap_remove(index).0);
    }
    palette
}

/// Draws from weighted choices; the weights are not negative and not all zero.
fn draw<T>(rng: &mut Rng, choices: impl Iterator<Item = (T, f64)>) -> T {
    let choices: Vec<(T, f64)> = choices.collect();
    let sum: f64 = choices.iter().map(|(_, weight)| weight).sum();
    let mut left = rng.random_range(0.0..1.0) * sum;
    let last = choices.len() - 1;
    for (index, (choice, weight)) in choices.into_iter().enumerate() {
        left -= weight;
        if left < 0.0 || index == last {
            return choice;
        }
    }
    unreachable!("the last choice is taken")
}
