//! What random models are like, one by one and together.

use std::collections::BTreeMap;

use serde::Serialize;

use super::RandomModel;
use super::build::Build;
use super::profile::Style;
use crate::model::Model;

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
    /// Height above the ground, studs included, millimetres.
    pub height_mm: f64,
    /// Share of its columns of studs that stand on nothing.
    pub overhang: f64,
    /// How far it can be tilted before it falls over, degrees.
    pub tilt_deg: f64,
    /// Largest share of the clutch force that a stud bears.
    pub load: f64,
    /// How many bricks of each part.
    pub bricks: BTreeMap<String, usize>,
    /// How many bricks of each colour.
    pub colors: BTreeMap<String, usize>,
}

impl RandomSummary {
    pub(super) fn new(index: usize, style: Style, build: &Build, model: &Model, load: f64) -> Self {
        let info = model.info();
        let size_mm = info.bbox_mm.map_or([0.0; 3], |b| std::array::from_fn(|i| b.max[i] - b.min[i]));
        let (mut bricks, mut colors) = (BTreeMap::new(), BTreeMap::new());
        for line in &info.bom {
            *bricks.entry(line.part.clone()).or_default() += line.count;
            *colors.entry(line.color_name.clone()).or_default() += line.count;
        }
        let (overhang, tilt_deg) = (build.overhang(), build.tilt_deg());
        let (parts, height_mm) = (info.parts, size_mm[1]);
        Self { index, style, parts, size_mm, height_mm, overhang, tilt_deg, load, bricks, colors }
    }
}

/// Smallest, middle and largest value.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Smallest.
    pub min: f64,
    /// Half of the values are not larger.
    pub median: f64,
    /// Largest.
    pub max: f64,
}

impl Spread {
    fn of(values: impl Iterator<Item = f64>) -> Self {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        let at = |index: usize| values.get(index).copied().unwrap_or(0.0);
        Self { min: at(0), median: at(values.len() / 2), max: at(values.len().saturating_sub(1)) }
    }
}

/// The two models of a batch that are most like each other.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MostAlike {
    /// Index of one.
    pub a: usize,
    /// Index of the other.
    pub b: usize,
    /// Filled cells that both have, as a share of those that either has, in the best of four orientations.
    pub shared: f64,
}

/// What a batch of random models is like.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BatchSummary {
    /// How many models.
    pub models: usize,
    /// Bricks of a model.
    pub parts: Spread,
    /// The longer horizontal edge of a model's box, millimetres.
    pub length_mm: Spread,
    /// The shorter one.
    pub width_mm: Spread,
    /// Height above the ground, millimetres.
    pub height_mm: Spread,
    /// Share of the columns of studs that stand on nothing.
    pub overhang: Spread,
    /// Largest share of the clutch force that a stud bears.
    pub load: Spread,
    /// How many models of each shape.
    pub styles: BTreeMap<Style, usize>,
    /// How many bricks of each part.
    pub bricks: BTreeMap<String, usize>,
    /// How many bricks of each colour.
    pub colors: BTreeMap<String, usize>,
    /// The two that are most like each other; `null` for fewer than two.
    pub most_alike: Option<MostAlike>,
}

impl BatchSummary {
    /// The figures of a batch.
    pub fn of(models: &[RandomModel]) -> Self {
        let all = || models.iter().map(|model| &model.summary);
        let (mut styles, mut bricks, mut colors) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        for summary in all() {
            *styles.entry(summary.style).or_default() += 1;
            summary.bricks.iter().for_each(|(part, count)| *bricks.entry(part.clone()).or_default() += count);
            summary.colors.iter().for_each(|(color, count)| *colors.entry(color.clone()).or_default() += count);
        }
        Self {
            models: models.len(),
            parts: Spread::of(all().map(|s| s.parts as f64)),
            length_mm: Spread::of(all().map(|s| s.size_mm[0].max(s.size_mm[2]))),
            width_mm: Spread::of(all().map(|s| s.size_mm[0].min(s.size_mm[2]))),
            height_mm: Spread::of(all().map(|s| s.height_mm)),
            overhang: Spread::of(all().map(|s| s.overhang)),
            load: Spread::of(all().map(|s| s.load)),
            styles,
            bricks,
            colors,
            most_alike: most_alike(models),
        }
    }
}

fn most_alike(models: &[RandomModel]) -> Option<MostAlike> {
    let mut best: Option<MostAlike> = None;
    for (b, second) in models.iter().enumerate() {
        let turned: Vec<Vec<[i32; 3]>> = (0..4).map(|turns| turned_cells(second, turns)).collect();
        for (a, first) in models[..b].iter().enumerate() {
            let (small, large) = (first.cells.len().min(second.cells.len()), first.cells.len().max(second.cells.len()));
            if best.is_some_and(|best| small as f64 <= best.shared * large as f64) {
                continue;
            }
            let common = |cells: &Vec<[i32; 3]>| cells.iter().filter(|cell| first.cells.contains(*cell)).count();
            let both = turned.iter().map(common).max().unwrap_or(0);
            let shared = both as f64 / (small + large - both).max(1) as f64;
            if best.is_none_or(|best| shared > best.shared) {
                best = Some(MostAlike { a: models[a].summary.index, b: models[b].summary.index, shared });
            }
        }
    }
    best
}

/// The cells of a model after quarter turns, from its low corner.
fn turned_cells(model: &RandomModel, turns: usize) -> Vec<[i32; 3]> {
    let (mut width, mut depth) = (0, 0);
    for [x, _, z] in &model.cells {
        (width, depth) = (width.max(*x), depth.max(*z));
    }
    let turned = model.cells.iter().map(|&[x, y, z]| match turns {
        0 => [x, y, z],
        1 => [z, y, width - x],
        2 => [width - x, y, depth - z],
        _ => [depth - z, y, x],
    });
    turned.collect()
}
