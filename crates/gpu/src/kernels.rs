//! The compiled kernels.

use crate::context::{Context, Kernel};

/// Sources, by file name.
pub const SOURCES: [(&str, &str); 9] = [
    ("adam", include_str!("kernels/adam.wgsl")),
    ("composite", include_str!("kernels/composite.wgsl")),
    ("dense", include_str!("kernels/dense.wgsl")),
    ("encode", include_str!("kernels/encode.wgsl")),
    ("field", include_str!("kernels/field.wgsl")),
    ("keep", include_str!("kernels/keep.wgsl")),
    ("march", include_str!("kernels/march.wgsl")),
    ("surface", include_str!("kernels/surface.wgsl")),
    ("tangent", include_str!("kernels/tangent.wgsl")),
];

/// All entry points. Each has the name that its file gives it, or of what it computes.
#[allow(missing_docs, reason = "the kernels' own files describe them")]
pub struct Kernels {
    pub adam_table: Kernel,
    pub adam_network: Kernel,
    pub losses: Kernel,
    pub layer: Kernel,
    pub input_gradient: Kernel,
    pub weight_gradient: Kernel,
    pub encode: Kernel,
    pub normals: Kernel,
    pub encode_tangent: Kernel,
    pub scatter: Kernel,
    pub scatter_both: Kernel,
    pub density: Kernel,
    pub note: Kernel,
    pub split: Kernel,
    pub join: Kernel,
    pub split_sdf: Kernel,
    pub join_sdf: Kernel,
    pub count_kept: Kernel,
    pub compact: Kernel,
    pub count: Kernel,
    pub place: Kernel,
    pub count_inside: Kernel,
    pub place_inside: Kernel,
    pub surface_losses: Kernel,
    pub free_points: Kernel,
    pub first_gradient: Kernel,
    pub turn: Kernel,
    pub join_tangent: Kernel,
}

impl Kernels {
    /// Compiles them.
    pub fn new(context: &Context) -> Self {
        let [adam, composite, dense, encode, field, keep, march, surface, tangent] = SOURCES.map(|(_, source)| source);
        let kernel = |source, entry| context.kernel(source, entry, &[]);
        let product = |number| context.kernel(dense, "multiply", &[("product", number)]);
        let walk = |entry, inside| context.kernel(march, entry, &[("inside_ball", inside)]);
        Self {
            adam_table: kernel(adam, "table"),
            adam_network: kernel(adam, "network"),
            losses: kernel(composite, "losses_of_rays"),
            layer: product(0.0),
            input_gradient: product(1.0),
            weight_gradient: product(2.0),
            encode: kernel(encode, "forward"),
            normals: kernel(encode, "normals_of"),
            encode_tangent: kernel(encode, "tangent"),
            scatter: kernel(encode, "scatter"),
            scatter_both: kernel(encode, "scatter_both"),
            density: kernel(field, "density"),
            note: kernel(field, "note"),
            split: kernel(field, "split"),
            join: kernel(field, "join"),
            split_sdf: kernel(field, "split_sdf"),
            join_sdf: kernel(field, "join_sdf"),
            count_kept: kernel(keep, "count"),
            compact: kernel(keep, "compact"),
            count: walk("count", 0.0),
            place: walk("place", 0.0),
            count_inside: walk("count", 1.0),
            place_inside: walk("place", 1.0),
            surface_losses: kernel(surface, "losses_of_rays"),
            free_points: kernel(surface, "free_points"),
            first_gradient: kernel(tangent, "first"),
            turn: kernel(tangent, "turn"),
            join_tangent: kernel(tangent, "join"),
        }
    }
}
