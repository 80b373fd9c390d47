//! Building instructions: from a brick model to a booklet from which a person can build.
//!
//! [`Plan::of`] decides what is built when: the author's steps, or our own where there are none; submodels once, however
//! often they are used. What its steps add, copies of submodels counted, is exactly the model's parts list.
//! [`write_booklet`] draws the plan as a PDF or as one HTML page; [`shopping_list`] and [`wanted_list`] are for buying the
//! parts.
//!
//! ```
//! let text = "0 A tower\n1 4 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n1 15 0 -24 0 1 0 0 0 1 0 0 0 1 3001.dat\n";
//! let model = mb_bricks::Model::from_text(text, "tower.ldr", None)?;
//! let plan = mb_instructions::Plan::of(&model);
//! assert_eq!(plan.main().map(|main| main.steps.len()), Some(2));
//! # Ok::<(), mb_job::Error>(())
//! ```
//!
//! Limits: whether a brick can be put in is judged by boxes and studs; hinges, clips and pins hold to what they touch. The
//! drawings show no arrows. Polygons that stand in a model file outside any part are not drawn.

mod automatic;
mod booklet;
mod bricklink;
mod call_out;
mod colors;
mod geometry;
mod html;
mod layout;
mod lists;
mod page;
mod pdf;
mod plan;
mod sheet;
mod signs;
mod text;
mod views;

pub use booklet::{BookletSummary, Form, booklet, write_booklet};
pub use lists::{ListNotes, list_notes, shopping_list, wanted_list};
pub use plan::{Piece, PieceKind, Plan, Section, Step, section_title};
