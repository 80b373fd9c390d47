//! Triangle meshes seen by a pinhole camera: exact depth and triangle ids at pixel centres.
//!
//! In: a [`mb_mesh::TriangleMesh`] and a [`View`]. Out: a [`Raster`]. [`Scene`] is the fast way, a rasteriser in `f64`
//! over tiles, on all threads; [`ray_cast`] is its slow twin, which follows one ray a pixel, and which the tests hold it
//! to. Both faces of a triangle are seen, meshes need not be closed, and may cross the camera's plane.
//!
//! ```
//! use mb_geometry::{ImageSize, Intrinsics, Object, Rigid3};
//! use mb_mesh::TriangleMesh;
//! use mb_render::{Scene, View};
//! use nalgebra::{Point3, Vector3};
//! let corners = [[-1., -1., 0.], [3., -1., 0.], [-1., 3., 0.]].map(Point3::from);
//! let scene = Scene::new(&TriangleMesh::new(corners.to_vec(), vec![[0, 1, 2]]));
//! let view = View {
//!     intrinsics: Intrinsics { fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5 },
//!     size: ImageSize::new(32, 24),
//!     cam_from_frame: Rigid3::<_, Object>::from_translation(Vector3::new(0.0, 0.0, 0.5)),
//! };
//! assert_eq!(scene.depth(&view)[(16, 12)], 0.5);
//! ```

mod cluster;
mod compose;
mod drawing;
mod outside;
mod overlay;
mod raster;
mod ray_cast;
mod scene;
mod setup;
mod shade;
mod strip;
mod view;

pub use drawing::{Drawing, DrawingOptions, LineArt, Look, SharpEdge};
pub use outside::{OutsideSummary, outside_only};
pub use overlay::overlay_edges;
pub use raster::{NO_TRIANGLE, Raster};
pub use ray_cast::ray_cast;
pub use scene::Scene;
pub use shade::{RgbaImage, ShadeOptions, heat_colors, over, shade, three_quarter_view};
pub use view::{View, Window};
