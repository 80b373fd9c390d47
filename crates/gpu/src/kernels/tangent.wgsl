// What the double backward pass of a softplus network does between its products. Twins: `Mlp::gradient`, `Mlp::tangent`;
// `mlp.rs` has the formulas. With h = act(z), act'(z) = 1 - exp(-beta h) = s and act''(z) = beta s (1 - s).

struct Sizes {
    rows: u32,
    width: u32,
    beta: f32,
    // `first`: where the last layer's weights begin, and their row length.
    weights: u32,
    weight_stride: u32,
    // Columns that the layer gives; those that the next one has, which a skip layer has more of; the scale of both.
    own: u32,
    inputs: u32,
    scale: f32,
}

var<immediate> sizes: Sizes;
@group(0) @binding(1) var<storage, read> parameters: array<f32>;
// [rows, width], all.
@group(0) @binding(2) var<storage, read> h: array<f32>;
@group(0) @binding(3) var<storage, read_write> r: array<f32>;
@group(0) @binding(4) var<storage, read_write> u: array<f32>;
@group(0) @binding(5) var<storage, read_write> joins: array<f32>;
@group(0) @binding(6) var<storage, read_write> dz: array<f32>;

fn slope(i: u32) -> f32 {
    return 1.0 - exp(-sizes.beta * h[i] / sizes.scale);
}

// r of the last hidden layer: the derivative of output 0.
@compute @workgroup_size(64)
fn first(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i < sizes.rows * sizes.width {
        let column = i % sizes.width;
        let w = select(0.0, parameters[sizes.weights + column * sizes.weight_stride], column < sizes.inputs);
        r[i] = sizes.scale * w * select(1.0, slope(i), column < sizes.own);
    }
}

// From u = q W: the term u p act'' that joins dz, with r = p s, and the next q = u s, which replaces u. Both p and q have the
// scale of a skip layer that follows.
@compute @workgroup_size(64)
fn turn(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i < sizes.rows * sizes.width {
        let s = slope(i);
        let inside = i % sizes.width < sizes.own;
        joins[i] = select(0.0, u[i] * r[i] * sizes.beta * (1.0 - s), inside);
        u[i] *= s * sizes.scale;
    }
}

@compute @workgroup_size(64)
fn join(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i < sizes.rows * sizes.width {
        dz[i] += joins[i];
    }
}
