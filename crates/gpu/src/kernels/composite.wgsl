// Compositing, the loss of each ray and the derivatives. Twin: `composite`, `distortion` and `composite_backward`, which
// explain the formulas. One thread for each ray.

struct Sizes {
    rays: u32,
    // 1 / (3 rays).
    scale: f32,
    // Weight of the distortion loss.
    distortion: f32,
    // Light below which the rest of a ray is dropped.
    dark: f32,
    // How the density network's output 0, o, gives density: 0 exp(o), 1 max(o, 0), 2 ln(1 + exp(o)).
    activation: u32,
}

var<immediate> sizes: Sizes;
// [rays, 20], see march.wgsl.
@group(0) @binding(1) var<storage, read> rays: array<f32>;
// [rays + 1]
@group(0) @binding(2) var<storage, read> starts: array<u32>;
// [samples]: distance and length.
@group(0) @binding(3) var<storage, read> steps: array<vec2<f32>>;
// [samples]
@group(0) @binding(4) var<storage, read> sigma: array<f32>;
// [samples, 8]: what the colour network gives, before the sigmoid.
@group(0) @binding(5) var<storage, read> color: array<f32>;
// [samples]: work space.
@group(0) @binding(6) var<storage, read_write> weights: array<f32>;
// [samples]: derivative of the density network's output 0.
@group(0) @binding(7) var<storage, read_write> d_density: array<f32>;
// [samples, 8]: derivative of `color`.
@group(0) @binding(8) var<storage, read_write> d_color: array<f32>;
// [rays]: squared error, summed over the channels, and distortion.
@group(0) @binding(9) var<storage, read_write> losses: array<vec2<f32>>;

// 1 - exp(-sigma dt), without cancellation where it is small.
fn opacity(i: u32) -> f32 {
    let x = sigma[i] * steps[i].y;
    return select(1.0 - exp(-x), x * (1.0 - x * (0.5 - x / 6.0)), x < 0.01);
}

// d sigma / d o.
fn slope(sigma: f32) -> f32 {
    if sizes.activation == 1u {
        return select(0.0, 1.0, sigma > 0.0);
    }
    if sizes.activation == 2u {
        return select(1.0 - exp(-sigma), sigma * (1.0 - 0.5 * sigma), sigma < 1e-3);
    }
    return sigma;
}

fn rgb_of(i: u32) -> vec3<f32> {
    return 1.0 / (1.0 + exp(-vec3(color[8u * i], color[8u * i + 1u], color[8u * i + 2u])));
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
    let first = starts[ray];
    let last = starts[ray + 1u];

    // Front to back. Distances count in units that shrink like disparity, s = t / (1 + t).
    var light = 1.0;
    var sum = vec3(0.0);
    var total = 0.0;
    var moment = 0.0;
    var end = first;
    while end < last && light >= sizes.dark {
        let alpha = opacity(end);
        let w = light * alpha;
        weights[end] = w;
        // What reaches the sample is kept here until it is overwritten.
        d_color[8u * end] = light;
        sum += w * rgb_of(end);
        total += w;
        moment += w * steps[end].x / (1.0 + steps[end].x);
        light *= 1.0 - alpha;
        end += 1u;
    }
    let error = sum + light * background - wanted;

    var before = 0.0;
    var moment_before = 0.0;
    var value = 0.0;
    for (var i = first; i < end; i += 1u) {
        let w = weights[i];
        let stretch = 1.0 + steps[i].x;
        let s = steps[i].x / stretch;
        let length = steps[i].y / (stretch * stretch);
        let pairs = s * before - moment_before + (moment - moment_before - w * s) - s * (total - before - w);
        value += w * pairs + w * w * length / 3.0;
        d_density[i] = 6.0 * sizes.scale * sizes.distortion * (pairs + w * length / 3.0);
        before += w;
        moment_before += w * s;
    }
    losses[ray] = vec2(dot(error, error), value);

    // Back to front.
    let d = 2.0 * sizes.scale * error;
    var behind = dot(d, background);
    for (var i = end; i > first; i -= 1u) {
        let k = i - 1u;
        let alpha = opacity(k);
        let rgb = rgb_of(k);
        let q = dot(d, rgb) + d_density[k];
        let d_alpha = d_color[8u * k] * (q - behind);
        behind = alpha * q + (1.0 - alpha) * behind;
        // d alpha / d sigma = dt (1 - alpha).
        d_density[k] = d_alpha * steps[k].y * (1.0 - alpha) * slope(sigma[k]);
        let d_rgb = d * weights[k] * rgb * (1.0 - rgb);
        d_color[8u * k] = d_rgb.x;
        d_color[8u * k + 1u] = d_rgb.y;
        d_color[8u * k + 2u] = d_rgb.z;
    }
    for (var i = end; i < last; i += 1u) {
        d_density[i] = 0.0;
        d_color[8u * i] = 0.0;
        d_color[8u * i + 1u] = 0.0;
        d_color[8u * i + 2u] = 0.0;
    }
    // The padding of a row stays zero.
    for (var i = first; i < last; i += 1u) {
        for (var k = 3u; k < 8u; k += 1u) {
            d_color[8u * i + k] = 0.0;
        }
    }
}
