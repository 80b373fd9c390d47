//! (story to be written by the crate)

mod pairing;
mod perceptual;
mod views;

pub use perceptual::PerceptualMetric;
pub use views::{
    ColorImage, SequenceViews, Similarity, VIEWS_PROTOCOL, ViewScore, ViewsOptions, ViewsScores, ViewsTable,
    evaluate_views, evaluate_views_method, psnr_of_mse, similarity,
};

mod depth;

pub use depth::{
    ByConfidence, ByRegion, DEPTH_PROTOCOL, DepthImageScore, DepthMetrics, DepthOptions, DepthScores, MetricDepth,
    evaluate_depth, score_depth,
};

mod poses;

pub use poses::{ObjectPair, POSES_PROTOCOL, PoseErrors, PosePair, PosesScores, evaluate_poses, score_poses};
