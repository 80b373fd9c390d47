// Opacity from signed distance, compositing with the background's samples, the losses of each ray and the derivatives. Twins:
// `Section`, `RayComposites`, `Neus::losses` and `Neus::send_back`, which explain the formulas.

struct Sizes {
    rays: u32,
    // 1 / rays.
    scale: f32,
    // Sharpness of the logistic function, and how far rays must face the surface.
    sharpness: f32,
    anneal: f32,
    // Weight of the mask loss.
    mask: f32,
    // Weight of the eikonal loss of one sample; of one free point.
    eikonal: f32,
    eikonal_free: f32,
    // Light below which the rest of a ray is dropped.
    dark: f32,
    // Row length of the geometry network's output, whose first number is the distance.
    stride: u32,
    // 1 where there are samples behind the ball.
    with_background: u32,
    // Free points, behind the samples.
    samples: u32,
    free: u32,
    // `losses_of_sections`: square of the eikonal loss's reach around the centre.
    reach: f32,
}

var<immediate> sizes: Sizes;
// [rays, 20], see march.wgsl.
@group(0) @binding(1) var<storage, read> rays: array<f32>;
// [rays + 1], inside the ball.
@group(0) @binding(2) var<storage, read> starts: array<u32>;
// [samples]: distance along the ray, and length.
@group(0) @binding(3) var<storage, read> steps: array<vec2<f32>>;
// [samples, stride]
@group(0) @binding(4) var<storage, read> geometry: array<f32>;
// [samples + free, 3]: normals, replaced by their derivatives.
@group(0) @binding(5) var<storage, read_write> normals: array<f32>;
// [samples, 8]: what the colour network gives, before the sigmoid.
@group(0) @binding(6) var<storage, read> color: array<f32>;
// [samples]: derivative of the distance. [samples, 8]: derivative of `color`.
@group(0) @binding(7) var<storage, read_write> d_sdf: array<f32>;
@group(0) @binding(8) var<storage, read_write> d_color: array<f32>;
// [rays]: squared error summed over the channels, the other losses, derivative of the sharpness. Behind them, [rays, 2]: what
// the cosines ask of the ray's origin, nothing, and of its direction.
@group(0) @binding(9) var<storage, read_write> losses: array<vec4<f32>>;
// Behind the ball, as in composite.wgsl.
@group(0) @binding(10) var<storage, read> outer_starts: array<u32>;
@group(0) @binding(11) var<storage, read> outer_steps: array<vec2<f32>>;
@group(0) @binding(12) var<storage, read> sigma: array<f32>;
@group(0) @binding(13) var<storage, read> outer_color: array<f32>;
@group(0) @binding(14) var<storage, read_write> d_density: array<f32>;
@group(0) @binding(15) var<storage, read_write> d_outer_color: array<f32>;

const EPSILON = 1e-5;

fn logistic(x: f32) -> f32 {
    return 1.0 / (1.0 + exp(-clamp(x, -80.0, 80.0)));
}

struct Section {
    alpha: f32,
    // Derivatives of alpha by distance, cosine and sharpness.
    by: vec3<f32>,
}

fn section(sdf: f32, cosine: f32, dt: f32) -> Section {
    let r = sizes.anneal;
    let held = -(max(0.5 - 0.5 * cosine, 0.0) * (1.0 - r) + max(-cosine, 0.0) * r);
    let half = 0.5 * held * dt;
    let before = sdf - half;
    let after = sdf + half;
    let p = logistic(sizes.sharpness * before);
    let q = logistic(sizes.sharpness * after);
    let raw = (p - q + EPSILON) / (p + EPSILON);
    if raw < 0.0 || raw > 1.0 {
        return Section(clamp(raw, 0.0, 1.0), vec3(0.0));
    }
    let d_p = q / ((p + EPSILON) * (p + EPSILON)) * p * (1.0 - p);
    let d_q = -q * (1.0 - q) / (p + EPSILON);
    let d_half = sizes.sharpness * (d_q - d_p);
    let slope = select(0.0, 0.5 * (1.0 - r), cosine < 1.0) + select(0.0, r, cosine < 0.0);
    return Section(raw, vec3(sizes.sharpness * (d_p + d_q), d_half * 0.5 * dt * slope, d_p * before + d_q * after));
}

fn direction_of(ray: u32) -> vec3<f32> {
    let at = ray * 20u + 3u;
    return vec3(rays[at], rays[at + 1u], rays[at + 2u]);
}

fn normal_of(i: u32) -> vec3<f32> {
    return vec3(normals[3u * i], normals[3u * i + 1u], normals[3u * i + 2u]);
}

fn set_normal(i: u32, n: vec3<f32>) {
    normals[3u * i] = n.x;
    normals[3u * i + 1u] = n.y;
    normals[3u * i + 2u] = n.z;
}

fn rgb_of(i: u32) -> vec3<f32> {
    return 1.0 / (1.0 + exp(-vec3(color[8u * i], color[8u * i + 1u], color[8u * i + 2u])));
}

fn outer_rgb_of(i: u32) -> vec3<f32> {
    return 1.0 / (1.0 + exp(-vec3(outer_color[8u * i], outer_color[8u * i + 1u], outer_color[8u * i + 2u])));
}

// 1 - exp(-sigma dt), without cancellation where it is small.
fn opacity(i: u32) -> f32 {
    let x = sigma[i] * outer_steps[i].y;
    return select(1.0 - exp(-x), x * (1.0 - x * (0.5 - x / 6.0)), x < 0.01);
}

fn section_of(i: u32, direction: vec3<f32>) -> Section {
    return section(geometry[sizes.stride * i], dot(normal_of(i), direction), steps[i].y);
}

// weight (|n| - 1)^2 and its derivative.
fn eikonal(n: vec3<f32>, weight: f32) -> vec4<f32> {
    let norm = max(length(n), 1e-6);
    return vec4(2.0 * weight * (norm - 1.0) / norm * n, weight * (norm - 1.0) * (norm - 1.0));
}

fn report(ray: u32, found: vec3<f32>, d_direction: vec3<f32>) {
    losses[ray] = vec4(found, 0.0);
    losses[sizes.rays + 2u * ray] = vec4(0.0);
    losses[sizes.rays + 2u * ray + 1u] = vec4(d_direction, 0.0);
}

@compute @workgroup_size(64)
fn losses_of_rays(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    let at = ray * 20u;
    let direction = direction_of(ray);
    let wanted = vec3(rays[at + 7u], rays[at + 8u], rays[at + 9u]);
    let background = vec3(rays[at + 10u], rays[at + 11u], rays[at + 12u]);
    let mask = rays[at + 16u];
    let first = starts[ray];
    let last = starts[ray + 1u];
    var outer_first = 0u;
    var outer_last = 0u;
    if sizes.with_background == 1u {
        outer_first = outer_starts[ray];
        outer_last = outer_starts[ray + 1u];
    }

    // Front to back. What reaches a sample is kept in its derivative until that is known.
    var light = 1.0;
    var sum = vec3(0.0);
    for (var i = first; i < last; i += 1u) {
        let alpha = section_of(i, direction).alpha;
        d_color[8u * i] = light;
        sum += light * alpha * rgb_of(i);
        light *= 1.0 - alpha;
    }
    for (var i = outer_first; i < outer_last; i += 1u) {
        let alpha = opacity(i);
        d_outer_color[8u * i] = light;
        sum += light * alpha * outer_rgb_of(i);
        light *= 1.0 - alpha;
    }
    let error = sum + light * background - wanted;
    var loss = (abs(error.x) + abs(error.y) + abs(error.z)) / 3.0;
    var d_light = 0.0;
    if mask >= 0.0 {
        let cover = clamp(1.0 - light, 1e-3, 1.0 - 1e-3);
        loss -= sizes.mask * (mask * log(cover) + (1.0 - mask) * log(1.0 - cover));
        d_light = sizes.mask * sizes.scale * (mask / cover - (1.0 - mask) / (1.0 - cover));
    }

    // Back to front.
    let d = select(vec3(-1.0), vec3(1.0), error >= vec3(0.0)) * sizes.scale / 3.0;
    var behind = dot(d, background) + d_light;
    for (var i = outer_last; i > outer_first; i -= 1u) {
        let k = i - 1u;
        let alpha = opacity(k);
        let rgb = outer_rgb_of(k);
        let reach = d_outer_color[8u * k];
        let q = dot(d, rgb);
        d_density[k] = reach * (q - behind) * outer_steps[k].y * (1.0 - alpha) * sigma[k];
        behind = alpha * q + (1.0 - alpha) * behind;
        let d_rgb = d * reach * alpha * rgb * (1.0 - rgb);
        for (var c = 0u; c < 8u; c += 1u) {
            d_outer_color[8u * k + c] = 0.0;
        }
        d_outer_color[8u * k] = d_rgb.x;
        d_outer_color[8u * k + 1u] = d_rgb.y;
        d_outer_color[8u * k + 2u] = d_rgb.z;
    }
    var d_sharpness = 0.0;
    var d_direction = vec3(0.0);
    for (var i = last; i > first; i -= 1u) {
        let k = i - 1u;
        let s = section_of(k, direction);
        let rgb = rgb_of(k);
        let reach = d_color[8u * k];
        let q = dot(d, rgb);
        let d_alpha = reach * (q - behind);
        behind = s.alpha * q + (1.0 - s.alpha) * behind;
        d_sdf[k] = d_alpha * s.by.x;
        d_sharpness += d_alpha * s.by.z;
        let n = normal_of(k);
        let pull = eikonal(n, sizes.eikonal);
        loss += pull.w * f32(sizes.rays);
        d_direction += d_alpha * s.by.y * n;
        set_normal(k, d_alpha * s.by.y * direction + pull.xyz);
        let d_rgb = d * reach * s.alpha * rgb * (1.0 - rgb);
        for (var c = 0u; c < 8u; c += 1u) {
            d_color[8u * k + c] = 0.0;
        }
        d_color[8u * k] = d_rgb.x;
        d_color[8u * k + 1u] = d_rgb.y;
        d_color[8u * k + 2u] = d_rgb.z;
    }
    report(ray, vec3(dot(error, error), loss, d_sharpness), d_direction);
}

// The eikonal loss at the free points.
@compute @workgroup_size(64)
fn free_points(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i < sizes.free {
        let k = sizes.samples + i;
        set_normal(k, eikonal(normal_of(k), sizes.eikonal_free).xyz);
    }
}

fn slope_of_softplus(sigma: f32) -> f32 {
    return select(1.0 - exp(-sigma), sigma * (1.0 - 0.5 * sigma), sigma < 1e-3);
}

// The same of the original NeuS. Twins: `NeusOriginal::losses` and `NeusOriginal::send_back`. Sections inside and outside the
// ball alternate by distance; those inside with a negative length are not shown. Densities are a softplus's. The ray's
// wanted colour and its error have the mask as their share, and its number 17 is the eikonal loss's weight.
@compute @workgroup_size(64)
fn losses_of_sections(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    let at = ray * 20u;
    let origin = vec3(rays[at], rays[at + 1u], rays[at + 2u]);
    let direction = direction_of(ray);
    let wanted = vec3(rays[at + 7u], rays[at + 8u], rays[at + 9u]);
    let mask = rays[at + 16u];
    let share = select(1.0, mask, mask >= 0.0);
    let first = starts[ray];
    let last = starts[ray + 1u];
    var outer_first = 0u;
    var outer_last = 0u;
    if sizes.with_background == 1u {
        outer_first = outer_starts[ray];
        outer_last = outer_starts[ray + 1u];
    }

    // Front to back. What reaches a sample is kept in its derivative until that is known.
    var light = 1.0;
    var sum = vec3(0.0);
    var i = first;
    var o = outer_first;
    while i < last || o < outer_last {
        if i < last && steps[i].y < 0.0 {
            i += 1u;
        } else if o == outer_last || (i < last && steps[i].x <= outer_steps[o].x) {
            let alpha = section_of(i, direction).alpha;
            d_color[8u * i] = light;
            sum += light * alpha * rgb_of(i);
            light *= 1.0 - alpha;
            i += 1u;
        } else {
            let alpha = opacity(o);
            d_outer_color[8u * o] = light;
            sum += light * alpha * outer_rgb_of(o);
            light *= 1.0 - alpha;
            o += 1u;
        }
    }
    let error = (sum - wanted) * share;
    var loss = abs(error.x) + abs(error.y) + abs(error.z);
    var behind = 0.0;
    if mask >= 0.0 {
        let cover = clamp(1.0 - light, 1e-3, 1.0 - 1e-3);
        loss -= sizes.mask * (mask * log(cover) + (1.0 - mask) * log(1.0 - cover));
        behind = sizes.mask * sizes.scale * (mask / cover - (1.0 - mask) / (1.0 - cover));
    }

    // Back to front.
    let d = sign(error) * sizes.scale * share;
    var d_sharpness = 0.0;
    var d_direction = vec3(0.0);
    while i > first || o > outer_first {
        let k = i - 1u;
        if i > first && (o == outer_first || steps[k].y < 0.0 || steps[k].x > outer_steps[o - 1u].x) {
            let n = normal_of(k);
            let p = origin + steps[k].x * direction;
            let pull = eikonal(n, select(0.0, rays[at + 17u], dot(p, p) < sizes.reach));
            loss += pull.w * f32(sizes.rays);
            var d_n = pull.xyz;
            var d_rgb = vec3(0.0);
            d_sdf[k] = 0.0;
            if steps[k].y >= 0.0 {
                let s = section_of(k, direction);
                let rgb = rgb_of(k);
                let reach = d_color[8u * k];
                let q = dot(d, rgb);
                let d_alpha = reach * (q - behind);
                behind = s.alpha * q + (1.0 - s.alpha) * behind;
                d_sdf[k] = d_alpha * s.by.x;
                d_sharpness += d_alpha * s.by.z;
                d_direction += d_alpha * s.by.y * n;
                d_n += d_alpha * s.by.y * direction;
                d_rgb = d * reach * s.alpha * rgb * (1.0 - rgb);
            }
            set_normal(k, d_n);
            for (var c = 0u; c < 8u; c += 1u) {
                d_color[8u * k + c] = 0.0;
            }
            d_color[8u * k] = d_rgb.x;
            d_color[8u * k + 1u] = d_rgb.y;
            d_color[8u * k + 2u] = d_rgb.z;
            i = k;
        } else {
            o -= 1u;
            let alpha = opacity(o);
            let rgb = outer_rgb_of(o);
            let reach = d_outer_color[8u * o];
            let q = dot(d, rgb);
            d_density[o] = reach * (q - behind) * outer_steps[o].y * (1.0 - alpha) * slope_of_softplus(sigma[o]);
            behind = alpha * q + (1.0 - alpha) * behind;
            let d_rgb = d * reach * alpha * rgb * (1.0 - rgb);
            for (var c = 0u; c < 8u; c += 1u) {
                d_outer_color[8u * o + c] = 0.0;
            }
            d_outer_color[8u * o] = d_rgb.x;
            d_outer_color[8u * o + 1u] = d_rgb.y;
            d_outer_color[8u * o + 2u] = d_rgb.z;
        }
    }
    report(ray, vec3(dot(error, error), loss, d_sharpness), d_direction);
}
