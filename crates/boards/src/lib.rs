//! Calibration boards: what is printed on them, and where.
//!
//! A [`BoardSpec`] is written as a short text such as `charuco:5x7:0.04:0.02:DICT_6X6_250` (docs/formats.md), and knows
//! its markers and corners in the board's frame: the origin at the top left of the print, x to the right, y down, z
//! into the board, metres. The same numbers draw it, as pixels or as a page to print.
//!
//! ```
//! use mb_boards::BoardSpec;
//! let board: BoardSpec = "charuco:5x7:0.04:0.02:DICT_6X6_250".parse()?;
//! assert_eq!(board.size_m(), [0.2, 0.28]);
//! assert_eq!(board.corners().len(), 4 * 6);
//! let texture = board.texture(96.0, 0.01); // 96 dots an inch, a white margin of 1 cm
//! assert_eq!(texture.size(), board.texture_size(96.0, 0.01));
//! # Ok::<(), mb_job::Error>(())
//! ```
//!
//! The predefined dictionaries come from the crate `calib-targets-aruco`; nothing else of it is used.

mod dictionary;
mod draw;
mod settings;
mod spec;

pub use dictionary::Dictionary;
pub use draw::Rectangle;
pub use spec::{BoardPattern, BoardSpec, Marker};
