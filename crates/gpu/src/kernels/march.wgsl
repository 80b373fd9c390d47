// Samples of rays, wherever the occupancy grid has matter: through contracted space, or inside the unit ball or the cube
// around it. Twins: `Nerf::march`, `Neus::march` and `Dvgo::march`.
// `count` runs first; the host adds up the counts and gives each ray its place; `place` writes the samples.
// A workgroup for each ray: one thread walks 64 steps, all look whether they are worth a sample (scan.wgsl).

// Inside the ball or its cube steps have one length.
override inside_ball: bool;
// Samples lie in a box of voxels; contracted space has steps that are equally long there.
override voxels: bool;

struct Sizes {
    rays: u32,
    // Cells a side of the occupancy grid.
    resolution: u32,
    far: f32,
    step: f32,
    cone: f32,
    // The box of voxels, in the unit cube.
    low_x: f32,
    low_y: f32,
    low_z: f32,
    high_x: f32,
    high_y: f32,
    high_z: f32,
}

var<immediate> sizes: Sizes;
// [rays, 20]: origin, direction, jitter, wanted colour, background, where contracted space begins, where the ball begins and
// ends, the mask (negative: none), the colour that was photographed.
@group(0) @binding(1) var<storage, read> rays: array<f32>;
// [cells / 32]: a bit for each cell that may hold something, x fastest.
@group(0) @binding(2) var<storage, read> occupied: array<u32>;
// `count` writes [rays]: samples of each ray. `place` reads [rays + 1]: where they begin.
@group(0) @binding(3) var<storage, read_write> starts: array<u32>;
// [samples, 3]: position in the unit cube; of voxels, in their box.
@group(0) @binding(4) var<storage, read_write> positions: array<f32>;
// [samples]: distance and length of the step.
@group(0) @binding(5) var<storage, read_write> steps: array<vec2<f32>>;
// [samples]: its ray.
@group(0) @binding(6) var<storage, read_write> ray_of: array<u32>;

fn contract(p: vec3<f32>) -> vec3<f32> {
    let norm = max(abs(p.x), max(abs(p.y), abs(p.z)));
    let scale = select((2.0 - 1.0 / norm) / norm, 1.0, norm <= 1.0);
    return 0.25 * scale * p + 0.5;
}

fn is_occupied(u: vec3<f32>) -> bool {
    let r = sizes.resolution;
    let c = min(vec3<u32>(max(u * f32(r), vec3(0.0))), vec3(r - 1u));
    let cell = (c.z * r + c.y) * r + c.x;
    return (occupied[cell / 32u] >> (cell % 32u) & 1u) == 1u;
}

// A point of a ray in the unit cube.
fn unit(p: vec3<f32>) -> vec3<f32> {
    if inside_ball {
        return 0.5 * p + 0.5;
    }
    return contract(p);
}

// Distance and length of 64 steps, where the next one begins, and how many samples there are before each.
var<workgroup> walked: array<vec2<f32>, 64>;
var<workgroup> ahead: f32;

// Walks one ray. With `write`, fills the places up to `last` and returns the first free one.
fn walk(ray: u32, thread: u32, write: bool, first: u32, last: u32) -> u32 {
    let at = ray * 20u;
    let origin = vec3(rays[at], rays[at + 1u], rays[at + 2u]);
    let direction = vec3(rays[at + 3u], rays[at + 4u], rays[at + 5u]);
    let start = select(rays[at + 13u], rays[at + 14u], inside_ball);
    let end = select(sizes.far, rays[at + 15u], inside_ball);
    let cone = select(sizes.cone, 0.0, inside_ball);
    var t = start + rays[at + 6u] * max(start * cone, sizes.step);
    var next = first;
    while t < end && next < last {
        if thread == 0u {
            for (var k = 0u; k < 64u; k += 1u) {
                var dt = max(t * cone, sizes.step);
                if voxels && !inside_ball {
                    // Contraction shrinks radial steps by the square of the distance.
                    let p = abs(origin + t * direction);
                    let reach = max(1.0, max(p.x, max(p.y, p.z)));
                    dt = min(sizes.step * reach * reach, 0.5 * reach);
                }
                walked[k] = vec2(t, dt);
                t += dt;
            }
            ahead = t;
        }
        workgroupBarrier();
        let step = walked[thread];
        t = ahead;
        let u = unit(origin + step.x * direction);
        var place = u;
        if voxels {
            let low = vec3(sizes.low_x, sizes.low_y, sizes.low_z);
            place = (u - low) / (vec3(sizes.high_x, sizes.high_y, sizes.high_z) - low);
        }
        var has_sample = step.x < end && is_occupied(u);
        if voxels && (any(place < vec3(0.0)) || any(place > vec3(1.0))) {
            has_sample = false;
        }
        let rank = sums(thread, vec2(select(0.0, 1.0, has_sample), 0.0));
        let to = next + u32(rank.before.x);
        if write && has_sample && to < last {
            positions[3u * to] = place.x;
            positions[3u * to + 1u] = place.y;
            positions[3u * to + 2u] = place.z;
            steps[to] = step;
            ray_of[to] = ray;
        }
        next = min(next + u32(rank.all.x), last);
    }
    return next;
}

@compute @workgroup_size(64)
fn count(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let ray = group.y * groups.x + group.x;
    if ray >= sizes.rays {
        return;
    }
    let found = walk(ray, thread, false, 0u, 0xffffffffu);
    if thread == 0u {
        starts[ray] = found;
    }
}

@compute @workgroup_size(64)
fn place(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let ray = group.y * groups.x + group.x;
    if ray >= sizes.rays {
        return;
    }
    let last = starts[ray + 1u];
    // A compiler may round the two walks differently; a place that stays free gets a sample without distance
    // and length, which asks nothing of its ray.
    let free = walk(ray, thread, true, starts[ray], last);
    for (var i = free + thread; i < last; i += 64u) {
        positions[3u * i] = 0.5;
        positions[3u * i + 1u] = 0.5;
        positions[3u * i + 2u] = 0.5;
        steps[i] = vec2(0.0, 0.0);
        ray_of[i] = ray;
    }
}
