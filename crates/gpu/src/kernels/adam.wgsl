// Adam. Twin: `Parameters::step`.

struct Sizes {
    parameters: u32,
    beta1: f32,
    beta2: f32,
    // lr / (1 - beta1^t).
    rate: f32,
    // 1 / sqrt(1 - beta2^t).
    correction: f32,
    epsilon: f32,
    // Tables: one unit of the sums.
    unit: f32,
    // `scaled`: numbers of an entry, which have one factor.
    width: u32,
}

var<immediate> sizes: Sizes;
@group(0) @binding(1) var<storage, read_write> values: array<f32>;
@group(0) @binding(2) var<storage, read_write> m: array<f32>;
@group(0) @binding(3) var<storage, read_write> v: array<f32>;
// Gradient as whole numbers of 64 bits, low word first; cleared.
@group(0) @binding(4) var<storage, read_write> sums: array<vec2<u32>>;
// [parameters]: gradient of a network.
@group(0) @binding(5) var<storage, read> gradient: array<f32>;
// [entries]: factors of the rate.
@group(0) @binding(6) var<storage, read> scales: array<f32>;

fn update(i: u32, g: f32, rate: f32) {
    let m_new = sizes.beta1 * m[i] + (1.0 - sizes.beta1) * g;
    let v_new = sizes.beta2 * v[i] + (1.0 - sizes.beta2) * g * g;
    m[i] = m_new;
    v[i] = v_new;
    values[i] -= rate * m_new / (sqrt(v_new) * sizes.correction + sizes.epsilon);
}

// The number of 64 bits, by its size and sign, so that nothing cancels.
fn real(sum: vec2<u32>) -> f32 {
    if sum.y < 0x80000000u {
        return f32(sum.y) * 4294967296.0 + f32(sum.x);
    }
    let low = ~sum.x + 1u;
    let high = ~sum.y + select(0u, 1u, low == 0u);
    return -(f32(high) * 4294967296.0 + f32(low));
}

// Of each run of sixteen parameters of a workgroup's: whether a sample touched it.
var<workgroup> touched: array<atomic<u32>, 4>;

// Takes a parameter's derivative, which is cleared, to a step with this rate, where its run was touched: the others keep their
// values and moments.
fn update_of_run(i: u32, thread: u32, rate: f32) {
    if thread < 4u {
        atomicStore(&touched[thread], 0u);
    }
    workgroupBarrier();
    var sum = vec2(0u);
    if i < sizes.parameters {
        sum = sums[i];
    }
    let found = any(sum != vec2(0u));
    if found {
        atomicStore(&touched[thread / 16u], 1u);
        sums[i] = vec2(0u);
    }
    workgroupBarrier();
    if i < sizes.parameters && atomicLoad(&touched[thread / 16u]) == 1u {
        update(i, real(sum) * sizes.unit, rate);
    }
}

// One thread for each parameter.
@compute @workgroup_size(64)
fn table(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    update_of_run((group.y * groups.x + group.x) * 64u + thread, thread, sizes.rate);
}

// The same where each entry has a factor.
@compute @workgroup_size(64)
fn scaled(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = (group.y * groups.x + group.x) * 64u + thread;
    update_of_run(i, thread, sizes.rate * scales[min(i, sizes.parameters - 1u) / sizes.width]);
}

// One thread for each parameter.
@compute @workgroup_size(64)
fn network(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i < sizes.parameters {
        update(i, gradient[i], sizes.rate);
    }
}
