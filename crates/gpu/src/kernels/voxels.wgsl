// Opacity from raw density on voxels, which samples are worth a colour, compositing, the loss of each ray and the derivatives.
// Twins: `VoxelField::alphas`, `Dvgo::shade` and `Dvgo::losses`, which explain the formulas. One thread for each ray.

struct Sizes {
    rays: u32,
    // Length of a step in base voxels, and what is added to a raw density.
    step: f32,
    shift: f32,
    // Samples with a smaller opacity or weight are dropped.
    dim: f32,
    // 1 / rays.
    scale: f32,
    // Weights of the entropy of the light that passes, and of the loss of each sample's colour.
    entropy: f32,
    point_color: f32,
}

var<immediate> sizes: Sizes;
// [rays, 20], see march.wgsl.
@group(0) @binding(1) var<storage, read> rays: array<f32>;
// [rays + 1]
@group(0) @binding(2) var<storage, read> starts: array<u32>;
// [samples]: distance and length.
@group(0) @binding(3) var<storage, read> steps: array<vec2<f32>>;
// [samples]: raw density.
@group(0) @binding(4) var<storage, read> raw: array<f32>;
// `count` writes [rays]: how many stay, and [samples]: 1 for those.
@group(0) @binding(5) var<storage, read_write> kept: array<u32>;
@group(0) @binding(6) var<storage, read_write> stays: array<u32>;
// [samples, 8]: colour before the sigmoid.
@group(0) @binding(7) var<storage, read> color: array<f32>;
// [samples] and [samples, 8]: derivatives of `raw` and `color`.
@group(0) @binding(8) var<storage, read_write> d_raw: array<f32>;
@group(0) @binding(9) var<storage, read_write> d_color: array<f32>;
// [rays]: squared error summed over the channels, and the whole loss.
@group(0) @binding(10) var<storage, read_write> losses: array<vec2<f32>>;

// 1 - exp(-step ln(1 + exp(raw + shift))), without cancellation where it is small.
fn opacity(i: u32) -> f32 {
    let x = raw[i] + sizes.shift;
    let e = exp(-abs(x));
    let softplus = max(x, 0.0) + select(log(1.0 + e), e * (1.0 - e * (0.5 - e / 3.0)), e < 0.01);
    let y = sizes.step * softplus;
    return select(1.0 - exp(-y), y * (1.0 - y * (0.5 - y / 6.0)), y < 0.01);
}

fn rgb_of(i: u32) -> vec3<f32> {
    return 1.0 / (1.0 + exp(-vec3(color[8u * i], color[8u * i + 1u], color[8u * i + 2u])));
}

@compute @workgroup_size(64)
fn count(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    var light = 1.0;
    var sum = 0u;
    for (var i = starts[ray]; i < starts[ray + 1u]; i += 1u) {
        let alpha = opacity(i);
        // march.wgsl has samples without length.
        let bright = alpha > sizes.dim && light * alpha > sizes.dim && steps[i].y > 0.0;
        stays[i] = select(0u, 1u, bright);
        sum += stays[i];
        light *= select(1.0, 1.0 - alpha, bright);
    }
    kept[ray] = sum;
}

@compute @workgroup_size(64)
fn losses_of_rays(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    let at = ray * 20u;
    let wanted = vec3(rays[at + 7u], rays[at + 8u], rays[at + 9u]);
    let background = vec3(rays[at + 10u], rays[at + 11u], rays[at + 12u]);
    let photographed = vec3(rays[at + 17u], rays[at + 18u], rays[at + 19u]);
    let first = starts[ray];
    let last = starts[ray + 1u];

    // Front to back. What reaches a sample is kept in its derivative until that is known.
    var light = 1.0;
    var sum = vec3(0.0);
    var points = 0.0;
    for (var i = first; i < last; i += 1u) {
        let alpha = opacity(i);
        let rgb = rgb_of(i);
        d_color[8u * i] = light;
        sum += light * alpha * rgb;
        points += light * alpha * dot(rgb - photographed, rgb - photographed);
        light *= 1.0 - alpha;
    }
    let error = sum + light * background - wanted;
    let passed = clamp(light, 1e-6, 1.0 - 1e-6);
    let entropy = -(passed * log(passed) + (1.0 - passed) * log(1.0 - passed));
    let square = dot(error, error);
    losses[ray] = vec2(square, square / 3.0 + sizes.entropy * entropy + sizes.point_color * points);

    // Back to front.
    let d = 2.0 / 3.0 * sizes.scale * error;
    var behind = dot(d, background) - sizes.scale * sizes.entropy * (log(passed) - log(1.0 - passed));
    for (var i = last; i > first; i -= 1u) {
        let k = i - 1u;
        let alpha = opacity(k);
        let rgb = rgb_of(k);
        let reach = d_color[8u * k];
        let q = dot(d, rgb);
        // d alpha / d raw = step (1 - alpha) sigmoid(raw + shift).
        let slope = sizes.step * (1.0 - alpha) / (1.0 + exp(-(raw[k] + sizes.shift)));
        d_raw[k] = reach * (q - behind) * slope;
        behind = alpha * q + (1.0 - alpha) * behind;
        let d_rgb = reach * alpha * (d + 2.0 * sizes.scale * sizes.point_color * (rgb - photographed)) * rgb * (1.0 - rgb);
        for (var c = 0u; c < 8u; c += 1u) {
            d_color[8u * k + c] = 0.0;
        }
        d_color[8u * k] = d_rgb.x;
        d_color[8u * k + 1u] = d_rgb.y;
        d_color[8u * k + 2u] = d_rgb.z;
    }
}
