// Samples of rays, wherever the occupancy grid has matter: through contracted space, or inside the unit ball or the cube
// around it. Twins: `Nerf::march`, `Neus::march` and `Dvgo::march`.
// `count` runs first; the host adds up the counts and gives each ray its place; `place` writes the samples.

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
// [cells]: not zero where the cell may hold something, x fastest.
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
    return occupied[(c.z * r + c.y) * r + c.x] != 0u;
}

// Walks one ray. With `write`, fills the places up to `last` and returns the first free one.
fn walk(ray: u32, write: bool, first: u32, last: u32) -> u32 {
    let at = ray * 20u;
    let origin = vec3(rays[at], rays[at + 1u], rays[at + 2u]);
    let direction = vec3(rays[at + 3u], rays[at + 4u], rays[at + 5u]);
    let start = select(rays[at + 13u], rays[at + 14u], inside_ball);
    let end = select(sizes.far, rays[at + 15u], inside_ball);
    let cone = select(sizes.cone, 0.0, inside_ball);
    var t = start + rays[at + 6u] * max(start * cone, sizes.step);
    var next = first;
    while t < end && next < last {
        var dt = max(t * cone, sizes.step);
        let p = origin + t * direction;
        var u = 0.5 * p + 0.5;
        if !inside_ball {
            u = contract(p);
        }
        var place = u;
        if voxels {
            if !inside_ball {
                // Contraction shrinks radial steps by the square of the distance.
                let reach = max(1.0, max(abs(p.x), max(abs(p.y), abs(p.z))));
                dt = min(sizes.step * reach * reach, 0.5 * reach);
            }
            let low = vec3(sizes.low_x, sizes.low_y, sizes.low_z);
            place = (u - low) / (vec3(sizes.high_x, sizes.high_y, sizes.high_z) - low);
        }
        if is_occupied(u) && (!voxels || (all(place >= vec3(0.0)) && all(place <= vec3(1.0)))) {
            if write {
                positions[3u * next] = place.x;
                positions[3u * next + 1u] = place.y;
                positions[3u * next + 2u] = place.z;
                steps[next] = vec2(t, dt);
                ray_of[next] = ray;
            }
            next += 1u;
        }
        t += dt;
    }
    return next;
}

@compute @workgroup_size(64)
fn count(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray < sizes.rays {
        starts[ray] = walk(ray, false, 0u, 0xffffffffu);
    }
}

@compute @workgroup_size(64)
fn place(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    let last = starts[ray + 1u];
    // A compiler may round the two walks differently; a place that stays free gets a sample without length.
    for (var free = walk(ray, true, starts[ray], last); free < last; free += 1u) {
        positions[3u * free] = 0.5;
        positions[3u * free + 1u] = 0.5;
        positions[3u * free + 2u] = 0.5;
        steps[free] = vec2(sizes.far, 0.0);
        ray_of[free] = ray;
    }
}
