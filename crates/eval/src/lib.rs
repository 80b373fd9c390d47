//! Scores: files or meshes in, numbers with units out.
//!
//! - **Surfaces**: [`evaluate_surface`] compares one prediction with a sequence's ground truth, by the published protocol
//!   or by exact distances; [`evaluate_surface_method`] does it for a method over a list of sequences.
//! - **Views**: [`evaluate_views`] compares rendered with photographed images (PSNR, SSIM and a [`PerceptualMetric`]).
//! - **Depth**: [`evaluate_depth`] compares depth maps.
//! - **Poses**: [`evaluate_poses`] compares camera poses, pairwise, in the object's frame, and after alignment.
//! - **Tables**: [`PaperTable`] holds the published numbers, [`Table`] sets rows of one's own beside them, [`lint`] finds
//!   rows that cannot be true.
//!
//! Every protocol has a name and a definition in `docs/metrics.md`; a change that moves a score makes a new name. Scores
//! are the same for any number of threads. What cannot be scored is an error or is named as missing, never a zero.
//! Nothing here knows how predictions are made: the project's own baselines are scored like anyone's.

mod depth;
mod pairing;
mod perceptual;
mod poses;
mod surface;
mod table;
mod views;

pub use depth::{
    ByConfidence, ByRegion, DEPTH_PROTOCOL, DepthImageScore, DepthMetrics, DepthOptions, DepthScores, MetricDepth,
    evaluate_depth, score_depth,
};
pub use perceptual::PerceptualMetric;
pub use poses::{ObjectPair, POSES_PROTOCOL, PoseErrors, PosePair, PosesScores, evaluate_poses, score_poses};
pub use surface::{
    Aligned, AlignedMean, AlignmentEffect, Breakdown, Chamfer, Confidence95, Coverage, Curve, CurvePoint, DtuScores,
    ExactScores, F1Change, FileHash, Floaters, Group, GroupThreshold, Icp, Interval, MissingScore, Normals, OfAngle,
    OfPart, OfRegion, OfViews, PUBLISHED_TEST_SEQUENCES, Provenance, Region, SurfaceMean, SurfaceOptions,
    SurfaceProtocol, SurfaceScores, SurfaceTable, SurfaceTruth, ThresholdIntervals, ThresholdScore,
    distances_to_surface_m, evaluate_surface, evaluate_surface_method, read_sequence_list, score_surface,
    vertex_distances_mm,
};
pub use table::{
    Better, Column, Comparison, Difference, ImpossibleRow, MethodScores, PairedDifference, PaperTable, Row, SOURCE,
    SequenceValues, Table, TableFormat, compare, lint, paired_bootstrap,
};
pub use views::{
    ColorImage, SequenceViews, Similarity, VIEWS_PROTOCOL, ViewScore, ViewsOptions, ViewsScores, ViewsTable,
    evaluate_views, evaluate_views_method, psnr_of_mse, similarity, similarity_of_pixels,
};
