//! The sources of the kernels, in WGSL.

/// Each shader by the name of its file. WGSL has no include: what several files use stands before them.
pub const SOURCES: [(&str, &str); 16] = [
    ("adam", include_str!("kernels/adam.wgsl")),
    ("composite", concat!(include_str!("kernels/scan.wgsl"), include_str!("kernels/composite.wgsl"))),
    ("dense", include_str!("kernels/dense.wgsl")),
    ("encode", include_str!("kernels/encode.wgsl")),
    ("field", include_str!("kernels/field.wgsl")),
    ("frequencies", include_str!("kernels/frequencies.wgsl")),
    ("gains", include_str!("kernels/gains.wgsl")),
    ("importance", include_str!("kernels/importance.wgsl")),
    ("keep", include_str!("kernels/keep.wgsl")),
    ("march", concat!(include_str!("kernels/scan.wgsl"), include_str!("kernels/march.wgsl"))),
    ("ray_gradient", include_str!("kernels/ray_gradient.wgsl")),
    ("sections", include_str!("kernels/sections.wgsl")),
    ("skip", include_str!("kernels/skip.wgsl")),
    ("surface", include_str!("kernels/surface.wgsl")),
    ("tangent", include_str!("kernels/tangent.wgsl")),
    ("voxels", include_str!("kernels/voxels.wgsl")),
];
