//! Connections, collisions and statics with known answers.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use mb_bricks::{CheckOptions, CheckReport, MeshOptions, Model, demo_model};

/// Lines of `part x top z quarter-turns` on the grid of studs and plates.
fn model(lines: &[(&str, f64, i32, f64)]) -> Model {
    let mut text = String::from("0 test\n");
    for (part, x, top, z) in lines {
        text += &format!("1 4 {} {} {} 1 0 0 0 1 0 0 0 1 {part}.dat\n", x * 20.0, -8 * top, z * 20.0);
    }
    Model::from_text(&text, "test.ldr", None).unwrap()
}

fn check(lines: &[(&str, f64, i32, f64)]) -> CheckReport {
    model(lines).check(&CheckOptions::default()).unwrap()
}

#[test]
fn bricks_on_studs_are_connected() {
    // Full overlap, overlap by one stud row, by a quarter, side by side, one gap.
    for (x, z, studs) in [(2.0, 1.0, 8), (5.0, 1.0, 2), (5.0, 2.0, 1), (2.0, 2.0, 4), (6.0, 1.0, 0), (7.0, 1.0, 0)] {
        let found = model(&[("3001", 2.0, 3, 1.0), ("3001", x, 6, z)]).connections();
        assert_eq!(found.studs.len(), studs, "at {x} {z}");
        assert!(found.studs.iter().all(|c| (c.stud_brick, c.grip_brick) == (0, 1)));
    }
    // A plate too high holds nothing, by 0.1 units and by more.
    assert_eq!(model(&[("3001", 2.0, 3, 1.0), ("3001", 2.0, 7, 1.0)]).connections().studs.len(), 0);
}

#[test]
fn every_drawn_part_with_room_below_grips_the_studs_of_a_plate() {
    for (number, title) in mb_bricks::drawable_parts() {
        let alone = model(&[(number, 0.0, 0, 0.0)]);
        let bounds = alone.info().bbox_ldu.unwrap();
        let bottom = bounds.max[1];
        // Put the part on the studs of a large plate, its box on the grid.
        let text = format!(
            "1 4 0 {bottom} 0 1 0 0 0 1 0 0 0 1 41539.dat\n1 4 {} 0 {} 1 0 0 0 1 0 0 0 1 {number}.dat\n",
            -bounds.min[0] - 80.0 + 20.0,
            -bounds.min[2] - 80.0 + if number == "87087" { 16.0 } else { 20.0 },
        );
        let found = Model::from_text(&text, "m.ldr", None).unwrap().connections().studs;
        assert!(found.iter().any(|c| (c.stud_brick, c.grip_brick) == (0, 1)), "{title} ({number}) grips nothing");
    }
}

#[test]
fn jumpers_and_side_studs_are_found() {
    let half = model(&[("87580", 1.0, 1, 1.0), ("3005", 1.0, 4, 1.0)]).connections();
    assert_eq!(half.studs.len(), 1);
    let tube = model(&[("87580", 1.0, 1, 1.0), ("3003", 1.0, 4, 1.0)]).connections();
    assert_eq!(tube.studs.len(), 1, "a stud in a tube");
    // A plate on its side, on the side stud.
    let side = "1 4 0 0 0 1 0 0 0 1 0 0 0 1 87087.dat\n1 4 0 10 -18 1 0 0 0 0 -1 0 1 0 3024.dat\n";
    assert_eq!(Model::from_text(side, "m.ldr", None).unwrap().connections().studs.len(), 1);
}

#[test]
fn bricks_in_the_same_place_collide_and_neighbours_do_not() {
    let apart = [("3001", 6.0, 3, 1.0), ("3001", 2.0, 6, 1.0), ("3001", 2.0, 3, 3.0), ("3003", 1.0, 4, 1.0)];
    for (index, expected) in [(0, None), (1, None), (2, None), (3, Some(2.0..10.0))] {
        let report = check(&[("3001", 2.0, 3, 1.0), apart[index]]);
        match (&report.collisions[..], expected) {
            ([], None) => {}
            ([only], Some(range)) => assert!(range.contains(&only.depth_mm), "{}", only.depth_mm),
            (found, _) => panic!("{index}: {found:?}"),
        }
    }
    let twice = check(&[("3001", 2.0, 3, 1.0), ("3001", 2.0, 3, 1.0)]);
    assert_eq!(twice.collisions.len(), 1);
    let one_stud = check(&[("3001", 2.0, 3, 1.0), ("3001", 5.0, 3, 1.0)]);
    assert!((one_stud.collisions[0].depth_mm - 8.0).abs() < 0.3, "{:?}", one_stud.collisions);
}

#[test]
fn a_cantilever_tips_where_its_centre_of_mass_leaves_the_foot() {
    // A 1 x 1 foot under one end of a row: the ground cannot pull, so the longest beam that stands is short.
    let on_foot = |part: &str, x: f64| check(&[("3003", 1.0, 3, 1.0), (part, x, 4, 1.0)]);
    // Beam centre at 1.0: balanced; the centre of mass of both moves out with the beam.
    assert_eq!(on_foot("3034", 1.0).stable, Some(true));
    assert_eq!(on_foot("3832", 5.0).stable, Some(false));
    // A counterweight brings it back.
    let balanced =
        check(&[("3003", 1.0, 3, 1.0), ("3832", 1.0, 4, 1.0), ("3003", 5.0, 7, 1.0), ("3003", -3.0, 7, 1.0)]);
    assert_eq!(balanced.stable, Some(true), "{:?}", balanced.notes);
    let one_sided =
        check(&[("3003", 1.0, 3, 1.0), ("3832", 1.0, 4, 1.0), ("3001", 4.0, 7, 1.0), ("3001", 4.0, 10, 1.0)]);
    assert_eq!(one_sided.stable, Some(false));
}

#[test]
fn the_tipping_point_is_where_statics_puts_it() {
    // Two equal plates 1 x 12 (60479) on each other, the lower one on the ground: the upper one may stick out until
    // the common centre of mass passes the lower one's end, had the clutch no limit.
    let options = CheckOptions { clutch_n: 1e3, ..CheckOptions::default() };
    for out in 1..12 {
        let overhang = f64::from(out);
        let lines = [("60479", 6.0, 1, 0.5), ("60479", 6.0 + overhang, 2, 0.5)];
        let report = model(&lines).check(&options).unwrap();
        // Centre of both: 6 + overhang / 2 from the lower one's free end, which stands up to 12.
        assert_eq!(report.stable, Some(6.0 + overhang / 2.0 <= 12.0), "{overhang}: {:?}", report.notes);
    }
    for extra in 0..4 {
        let far = 11.0 + f64::from(extra);
        let lines = [("60479", 6.0, 1, 0.5), ("60479", 17.0, 2, 0.5), ("3005", far + 10.5, 5, 0.5)];
        let report = model(&lines).check(&options).unwrap();
        // The third brick adds its weight outside: over the edge.
        assert_eq!(report.stable, Some(false), "{far}");
    }
}

#[test]
fn loads_grow_with_the_lever_and_pull_bricks_apart() {
    let hanging = |bricks: i32| {
        // A 2 x 4 foot weighed down, a long arm held by two studs only, and bricks on its end.
        let mut lines = vec![("41539", 4.0, 1, 4.0), ("3001", 2.0, 4, 4.0), ("3006", 8.0, 7, 4.0)];
        for level in 0..bricks {
            lines.push(("3001", 11.0, 10 + 3 * level, 4.0));
        }
        check(&lines)
    };
    let load = |report: &CheckReport| report.weakest.as_ref().map(|w| w.load).unwrap_or(f64::INFINITY);
    let (light, heavy) = (hanging(1), hanging(4));
    assert!(load(&light) > 0.0 && load(&heavy) > load(&light), "{} {}", load(&light), load(&heavy));
}

#[test]
fn loose_bricks_are_told() {
    let report = check(&[("3001", 2.0, 3, 1.0), ("3001", 2.0, 9, 1.0)]);
    assert_eq!((report.connected, report.stable), (false, Some(false)));
    assert_eq!(report.loose_parts, [1]);
    let side_by_side = check(&[("3001", 2.0, 3, 1.0), ("3001", 6.0, 3, 1.0)]);
    assert_eq!((side_by_side.connected, side_by_side.stable), (false, Some(true)));
}

#[test]
fn a_submodel_beside_the_rest_may_stand_on_another_ground() {
    // A tower, and a pair of bricks as a submodel at a place, `bottom` plates high.
    let beside = |x: i32, bottom: i32, extra: &str| {
        let text = format!(
            "0 FILE m.ldr\n1 4 0 -24 0 1 0 0 0 1 0 0 0 1 3001.dat\n1 4 0 -48 0 1 0 0 0 1 0 0 0 1 3001.dat\n\
             1 1 {} {} 0 1 0 0 0 1 0 0 0 1 sign.ldr\n{extra}0 FILE sign.ldr\n\
             1 16 0 -48 0 1 0 0 0 1 0 0 0 1 3001.dat\n1 16 0 -24 0 1 0 0 0 1 0 0 0 1 3001.dat\n",
            20 * x,
            -8 * bottom
        );
        let report = Model::from_text(&text, "m.mpd", None).unwrap().check(&CheckOptions::default()).unwrap();
        (report.stable, report.loose_parts.len(), report.undecided_parts.len())
    };
    assert_eq!(beside(8, 0, ""), (Some(true), 0, 0));
    assert_eq!(beside(8, 1, ""), (None, 0, 2));
    // Over another brick it falls, and so does a brick that is no submodel, unless it was placed by eye.
    assert_eq!(beside(0, 9, ""), (Some(false), 2, 0));
    for (height, stable) in [(3, None), (5, Some(false)), (24, Some(false))] {
        let brick = format!("1 4 0 {} 200 1 0 0 0 1 0 0 0 1 3001.dat\n", -24 - height);
        assert_eq!(beside(8, 0, &brick).0, stable, "{height}");
    }
}

#[test]
fn bricks_are_put_in_from_a_free_side() {
    // A roof over a tower with a brick inside: the brick must come before the roof.
    let report = check(&[("3001", 2.0, 9, 1.0), ("3003", 1.0, 6, 1.0), ("3001", 2.0, 3, 1.0)]);
    assert_eq!(report.build_order, [2, 1, 0]);
    assert_eq!(report.buildable, Some(true));
}

#[test]
fn the_castle_stands() {
    let report = demo_model().check(&CheckOptions::default()).unwrap();
    assert_eq!(report.collisions, []);
    assert!(report.connected, "{} groups, loose {:?}", report.groups, report.loose_parts);
    assert_eq!(report.stable, Some(true), "{:?}", report.notes);
    assert_eq!(report.buildable, Some(true));
    assert_eq!(report.covered_parts, report.parts);
    let mut order = report.build_order.clone();
    order.sort_unstable();
    assert_eq!(order, (0..report.parts).collect::<Vec<_>>());
}

/// Weight of a part, newtons, from the volume that its closed surface encloses.
fn weight_n(part: &str, options: &CheckOptions) -> f64 {
    let mesh = model(&[(part, 0.0, 0, 0.0)]).mesh(&MeshOptions::default());
    let volume_m3: f64 = (0..mesh.triangles.len())
        .map(|t| {
            let [a, b, c] = mesh.triangle(t);
            a.coords.dot(&b.coords.cross(&c.coords)) / 6.0
        })
        .sum();
    volume_m3 * options.density_kg_m3 * 9.80665
}

/// Lines for a beam on a pillar on a large plate: `studs` pillars of one stud, the beam's near end over the first.
fn cantilever(beam: &'static str, length: f64, studs: usize) -> Vec<(&'static str, f64, i32, f64)> {
    let mut lines = vec![("41539", 4.0, 1, 4.0)];
    lines.push(if studs == 1 { ("3005", 0.5, 4, 0.5) } else { ("3004", 1.0, 4, 0.5) });
    lines.push((beam, 0.5 * length, 5, 0.5));
    lines
}

#[test]
fn a_beam_on_one_stud_pulls_as_the_lever_says() {
    // One stud of radius r holds a beam of weight W whose middle is d away: it presses with c on the near edge and
    // pulls with t on the far one. c - t = W and (c + t) r = W d, so t = W (d / r - 1) / 2.
    let options = CheckOptions::default();
    for (beam, length) in [("3023b", 2.0), ("3623", 3.0), ("3710", 4.0), ("3666", 6.0), ("3460", 8.0)] {
        let (d, r) = (20.0 * (0.5 * length - 0.5), 6.0);
        let expected = (weight_n(beam, &options) * (d / r - 1.0) / 2.0 / options.clutch_n).max(0.0);
        let lines = cantilever(beam, length, 1);
        let load = |options: &CheckOptions| model(&lines).check(options).unwrap();
        let found = load(&options).weakest.unwrap();
        assert!((found.load - expected).abs() < 0.01 * expected, "{beam}: {} for {expected}", found.load);
        assert_eq!((found.stud_brick, found.grip_brick, found.studs), (1, 2, 1));
        // On both sides of the tipping point.
        for (share, stands) in [(1.02, true), (0.98, false)] {
            let clutch_n = options.clutch_n * expected * share;
            assert_eq!(load(&CheckOptions { clutch_n, ..options }).stable, Some(stands), "{beam} at {share}");
        }
    }
}

#[test]
fn a_beam_on_two_studs_pulls_both_as_hard_as_their_levers_allow() {
    // Studs at 0 and 20, the beam's middle at d. It turns about the far edge of the second stud, 26 away; both studs
    // pull with their limit at their near edges, with levers of 32 and 12: load = W (d - 26) / (44 T).
    let options = CheckOptions::default();
    for (beam, length) in [("3666", 6.0), ("3460", 8.0), ("4477", 10.0), ("60479", 12.0)] {
        let d = 20.0 * (0.5 * length - 0.5);
        let expected = weight_n(beam, &options) * (d - 26.0) / 44.0 / options.clutch_n;
        let found = model(&cantilever(beam, length, 2)).check(&options).unwrap().weakest.unwrap();
        assert!((found.load - expected).abs() < 0.01 * expected, "{beam}: {} for {expected}", found.load);
        assert_eq!(found.studs, 2);
    }
}

#[test]
fn a_leaning_tower_falls_where_its_centre_of_mass_leaves_its_foot() {
    // Plates 2 x 4, each `shift` studs further than the one below. With clutch to spare, the pile tips as a whole:
    // its middle lies (n - 1) shift / 2 beyond that of its foot, which is 4 long.
    let strong = CheckOptions { clutch_n: 1e3, ..CheckOptions::default() };
    for count in [3, 4, 5, 6, 8] {
        let lines: Vec<_> = (0..count).map(|level| ("3020", 2.0 + f64::from(level), 1 + level, 1.0)).collect();
        let middle = f64::from(count - 1) / 2.0;
        // At exactly 2 it balances on an edge; that is nobody's tower.
        if (middle - 2.0).abs() > 0.1 {
            assert_eq!(model(&lines).check(&strong).unwrap().stable, Some(middle < 2.0), "{count}");
        }
    }
}

#[test]
fn bricks_that_lie_on_others_are_judged_by_their_weight() {
    // A tile carries without holding: a brick on it stays while its middle is over the tile.
    let lying = |x: f64| check(&[("3068b", 1.0, 1, 1.0), ("3001", x, 4, 1.0)]);
    for (x, stays) in [(1.0, true), (1.9, true), (2.1, false), (2.9, false)] {
        let report = lying(x);
        assert!(!report.connected);
        assert_eq!((report.stable, report.resting_parts == [1]), (Some(stays), true), "{x}: {:?}", report.notes);
    }
    // Its weight bears on what carries it: on the end of a beam it pulls the beam off its stud.
    let on_beam = |lines: &[(&'static str, f64, i32, f64)]| {
        let beam: Vec<_> = cantilever("3460", 8.0, 1).into_iter().chain(lines.iter().copied()).collect();
        check(&beam).weakest.unwrap().load
    };
    let (bare, tiled) = (on_beam(&[]), on_beam(&[("3069b", 7.0, 6, 0.5)]));
    assert!(on_beam(&[("3069b", 7.0, 6, 0.5), ("3004", 7.0, 9, 0.5)]) > tiled && tiled > bare);
}
