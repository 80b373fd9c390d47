// Drops samples. `count`, here or in voxels.wgsl, judges them; the host adds up the counts; `compact` moves what stays.
// This `count` drops what no light reaches. Twin: `RaySamples::drop_dark` with `Neus::shade`, which judges by the drop of the
// logistic function between neighbours.

struct Sizes {
    rays: u32,
    sharpness: f32,
    dark: f32,
    // Row length of the geometry network's output.
    stride: u32,
}

var<immediate> sizes: Sizes;
// [rays + 1]: where each ray's samples begin.
@group(0) @binding(1) var<storage, read> starts: array<u32>;
// [samples, stride]: the distance comes first.
@group(0) @binding(2) var<storage, read> geometry: array<f32>;
// `count` writes [rays]: how many stay. `compact` reads [rays + 1]: where they begin.
@group(0) @binding(3) var<storage, read_write> kept: array<u32>;
// [samples, 3] and [samples], before and after.
@group(0) @binding(4) var<storage, read> positions: array<f32>;
@group(0) @binding(5) var<storage, read> steps: array<vec2<f32>>;
@group(0) @binding(6) var<storage, read_write> kept_positions: array<f32>;
@group(0) @binding(7) var<storage, read_write> kept_steps: array<vec2<f32>>;
@group(0) @binding(8) var<storage, read_write> ray_of: array<u32>;
// [samples]: 1 where the sample stays, as `count` judged it.
@group(0) @binding(9) var<storage, read_write> stays: array<u32>;

fn logistic(i: u32) -> f32 {
    return 1.0 / (1.0 + exp(-clamp(sizes.sharpness * geometry[sizes.stride * i], -80.0, 80.0)));
}

@compute @workgroup_size(64)
fn count(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    let last = starts[ray + 1u];
    var i = starts[ray];
    var light = 1.0;
    while i < last && light >= sizes.dark {
        if i + 1u < last {
            light *= min((logistic(i + 1u) + 1e-5) / (logistic(i) + 1e-5), 1.0);
        }
        i += 1u;
    }
    kept[ray] = i - starts[ray];
    for (var k = starts[ray]; k < last; k += 1u) {
        stays[k] = select(0u, 1u, k < i);
    }
}

@compute @workgroup_size(64)
fn compact(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    var to = kept[ray];
    for (var i = starts[ray]; i < starts[ray + 1u]; i += 1u) {
        if stays[i] == 1u {
            for (var d = 0u; d < 3u; d += 1u) {
                kept_positions[3u * to + d] = positions[3u * i + d];
            }
            kept_steps[to] = steps[i];
            ray_of[to] = ray;
            to += 1u;
        }
    }
}
