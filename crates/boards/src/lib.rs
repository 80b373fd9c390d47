//! Calibration boards: what is printed on them, where they are in a photograph, and what that says of the camera.
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
//! [`BoardDetector`] finds a board in a photograph, [`estimate_board_pose`] tells where the camera was, and [`calibrate`] what
//! camera took several photographs.
//!
//! The predefined dictionaries come from the crate `calib-targets-aruco`; nothing else of it is used.

mod calibrate;
mod camera;
mod corner;
mod decode;
mod detect;
mod dictionary;
mod draw;
mod homography;
mod lattice;
mod pose;
mod print;
mod quads;
mod regions;
mod sample;
mod settings;
mod spec;

pub use calibrate::{CalibratedView, Calibration, CalibrationError, LensModel, calibrate};
pub use camera::LensCamera;
pub use detect::{BoardDetector, Detection, DictionaryFit, SeenCorner, SeenMarker, fitting_dictionaries};
pub use dictionary::Dictionary;
pub use draw::Rectangle;
pub use pose::{BoardPose, estimate_board_pose};
pub use print::Paper;
pub use sample::luma;
pub use spec::{BoardPattern, BoardSpec, Marker};
