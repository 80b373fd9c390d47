// Compositing, the loss of each ray and the derivatives. Twin: `composite`, `distortion` and `composite_backward`, which
// explain the formulas. A workgroup for each ray, whose threads take its samples 64 at a time (scan.wgsl).

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

// The light behind the samples that count, and where they end.
var<workgroup> left: f32;
var<workgroup> end: atomic<u32>;

@compute @workgroup_size(64)
fn losses_of_rays(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let ray = group.y * groups.x + group.x;
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
    var total_and_moment = vec2(0.0);
    var until = last;
    if thread == 0u {
        atomicStore(&end, last);
    }
    for (var chunk = first; chunk < until; chunk += 64u) {
        let i = chunk + thread;
        var alpha = 0.0;
        if i < last {
            alpha = opacity(i);
        }
        let passed = products(thread, 1.0 - alpha);
        let reach = light * passed.before.x;
        // The first that too little light reaches is the end.
        if i < last && reach < sizes.dark {
            atomicMin(&end, i);
        }
        workgroupBarrier();
        until = atomicLoad(&end);
        if i == until {
            left = reach;
        }
        workgroupBarrier();
        if i < until {
            let w = reach * alpha;
            weights[i] = w;
            // What reaches the sample is kept here until it is overwritten.
            d_color[8u * i] = reach;
            sum += w * rgb_of(i);
            total_and_moment += w * vec2(1.0, steps[i].x / (1.0 + steps[i].x));
        }
        light = light * passed.all.x;
        if until < chunk + 64u && until < last {
            light = left;
        }
    }
    let red_and_green = sums(thread, sum.xy).all;
    let blue = sums(thread, vec2(sum.z, 0.0)).all.x;
    let all = sums(thread, total_and_moment).all;
    let error = vec3(red_and_green, blue) + light * background - wanted;

    // The distortion of a sample's weight against all others.
    var before = vec2(0.0);
    var value = 0.0;
    for (var chunk = first; chunk < until; chunk += 64u) {
        let i = chunk + thread;
        var w = 0.0;
        var place = vec2(0.0);
        if i < until {
            w = weights[i];
            place = steps[i];
        }
        let stretch = 1.0 + place.x;
        let s = place.x / stretch;
        let length = place.y / (stretch * stretch);
        let scan = sums(thread, w * vec2(1.0, s));
        let here = before + scan.before;
        let pairs = s * here.x - here.y + (all.y - here.y - w * s) - s * (all.x - here.x - w);
        value += w * pairs + w * w * length / 3.0;
        if i < until {
            d_density[i] = 6.0 * sizes.scale * sizes.distortion * (pairs + w * length / 3.0);
        }
        before += scan.all;
    }
    value = sums(thread, vec2(value, 0.0)).all.x;
    if thread == 0u {
        losses[ray] = vec2(dot(error, error), value);
    }

    // Back to front: what all samples behind this one add to the loss, the farthest first.
    let d = 2.0 * sizes.scale * error;
    var behind = light * dot(d, background);
    let chunks = (until - first + 63u) / 64u;
    for (var c = chunks; c > 0u; c -= 1u) {
        let chunk = first + 64u * (c - 1u);
        // Each thread keeps the samples that it wrote, and counts itself from the back.
        let i = chunk + thread;
        var share = 0.0;
        if i < until {
            share = weights[i] * (dot(d, rgb_of(i)) + d_density[i]);
        }
        let scan = sums(63u - thread, vec2(share, 0.0));
        if i < until {
            let rgb = rgb_of(i);
            let q = dot(d, rgb) + d_density[i];
            let alpha = opacity(i);
            // d alpha / d sigma = dt (1 - alpha).
            d_density[i] =
                (d_color[8u * i] * (1.0 - alpha) * q - behind - scan.before.x) * steps[i].y * slope(sigma[i]);
            let d_rgb = d * weights[i] * rgb * (1.0 - rgb);
            d_color[8u * i] = d_rgb.x;
            d_color[8u * i + 1u] = d_rgb.y;
            d_color[8u * i + 2u] = d_rgb.z;
        }
        behind += scan.all.x;
    }
    for (var i = until + thread; i < last; i += 64u) {
        d_density[i] = 0.0;
        d_color[8u * i] = 0.0;
        d_color[8u * i + 1u] = 0.0;
        d_color[8u * i + 2u] = 0.0;
    }
    // The padding of a row stays zero.
    for (var i = first + thread; i < last; i += 64u) {
        for (var k = 3u; k < 8u; k += 1u) {
            d_color[8u * i + k] = 0.0;
        }
    }
}
