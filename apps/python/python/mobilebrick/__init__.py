"""MobileBrick from Python: sequences, exact ground truth, reconstruction and scores.

Everything is metric (metres unless a name says otherwise); cameras are OpenCV's (x right, y down, z forward), pixel
centres lie at integer coordinates, depth is z with 0 for no value. Matrices are named ``target_from_source``.
"""

from ._native import (
    Alignment,
    Frame,
    InputError,
    Mesh,
    Model,
    Sequence,
    __version__,
    compare_depth,
    compare_images,
    evaluate_depth,
    evaluate_poses,
    evaluate_surface,
    evaluate_views,
    fuse_tsdf,
    load_model,
    render_depth,
)

__all__ = [
    "Alignment",
    "Frame",
    "InputError",
    "Mesh",
    "Model",
    "Sequence",
    "__version__",
    "compare_depth",
    "compare_images",
    "evaluate_depth",
    "evaluate_poses",
    "evaluate_surface",
    "evaluate_views",
    "fuse_tsdf",
    "load_model",
    "render_depth",
]
