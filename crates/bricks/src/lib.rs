//! Brick models: LDraw and Studio files in, parts lists and exact meshes out.
//!
//! [`Model::read`] takes an LDraw model (.ldr, .mpd, .dat) or a Studio archive (.io) and, where there is one, a
//! [`PartLibrary`] (the official library as a folder or its zip). Without a library, common bricks are drawn by
//! ourselves. What comes out:
//!
//! - [`Model::info`]: the figures and the parts list;
//! - [`Model::mesh`]: every triangle in the object frame (metres, y up), coloured, with the index of its brick;
//! - [`Model::instances`], [`Model::occurrences`], [`Model::files`]: bricks, submodels, steps, for instructions;
//! - [`Model::write_self_contained`]: a copy that needs no library;
//! - [`Model::connections`] and [`Model::check`]: which brick holds which, collisions, equilibrium, a building order;
//! - [`Model::build_site`]: what a planner of building steps has to know;
//! - [`random_models`]: seeded models that can be built and stand; [`demo_model`]: the built-in castle.
//!
//! ```
//! let text = "0 A tower\n1 4 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n0 STEP\n1 15 0 -24 0 1 0 0 0 1 0 0 0 1 3001.dat\n";
//! let model = mb_bricks::Model::from_text(text, "tower.ldr", None)?;
//! assert_eq!(model.info().parts, 2);
//! let mesh = model.mesh(&mb_bricks::MeshOptions::default());
//! assert!((mesh.bounds().extent().x - 0.032).abs() < 1e-9);
//! # Ok::<(), mb_job::Error>(())
//! ```
//!
//! Limits: only this crate knows LDraw units and axes. Textures are not drawn (their fallback geometry is).
//! Conditional lines are ignored. Meshes of library parts are not closed; those that we draw ourselves are.

mod bodies;
mod build_order;
mod check;
mod clearance;
mod collisions;
mod connections;
mod contact;
mod convex_hull;
mod demo;
mod flat;
mod info;
mod joints;
mod ldraw;
mod links;
mod model;
mod neighbors;
mod parametric;
mod random;
mod sketch;
mod statics;
mod write;

pub use build_order::BuildSite;
pub use check::{CheckOptions, CheckReport, JointCounts, UncoveredPart, WeakestConnection};
pub use collisions::Collision;
pub use connections::{Connection, Connections};
pub use demo::demo_model;
pub use flat::{METRES_PER_LDU, MeshOptions, NO_PART, object_from_ldraw};
pub use info::{BomLine, BoxInfo, ModelInfo};
pub use ldraw::colors::{Color, ColorCode, ColorTable};
pub use ldraw::file::{
    Affine, EdgeLine, Face, FileId, FileKind, LdrawFile, Reference, StepLine, StepView, StudSite, normalized_name,
};
pub use ldraw::library::PartLibrary;
pub use ldraw::load::MissingPart;
pub use ldraw::shape::PartShape;
pub use model::{MissingBrick, Model, Occurrence, PartInstance, ReadOptions};
pub use parametric::drawable_parts;
pub use random::{
    BatchSummary, MostAlike, RandomModel, RandomOptions, RandomProfile, RandomSummary, Spread, Style, random_model,
    random_models,
};
