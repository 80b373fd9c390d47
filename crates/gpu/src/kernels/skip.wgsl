// The network's input behind a skip layer's own, and its derivative. Twins: `Mlp::forward` and `Mlp::backward`. One thread for
// each row and input.

struct Sizes {
    rows: u32,
    inputs: u32,
    in_stride: u32,
    // Columns before the network's input in the layer's rows, and their length.
    own: u32,
    stride: u32,
    scale: f32,
}

var<immediate> sizes: Sizes;
// [rows, in_stride]: the input; `add` adds to its derivative.
@group(0) @binding(1) var<storage, read_write> input: array<f32>;
// [rows, stride]: what the layer sees, or its derivative, which has its scale already.
@group(0) @binding(2) var<storage, read_write> seen: array<f32>;

@compute @workgroup_size(64)
fn append(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    if thread < sizes.rows * sizes.inputs {
        let row = thread / sizes.inputs;
        let column = thread % sizes.inputs;
        seen[row * sizes.stride + sizes.own + column] = sizes.scale * input[row * sizes.in_stride + column];
    }
}

@compute @workgroup_size(64)
fn add(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    if thread < sizes.rows * sizes.inputs {
        let row = thread / sizes.inputs;
        let column = thread % sizes.inputs;
        input[row * sizes.in_stride + column] += seen[row * sizes.stride + sizes.own + column];
    }
}
