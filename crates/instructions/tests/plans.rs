//! Laws of plans: complete, exact, and for our own steps buildable.

use std::collections::{BTreeMap, BTreeSet};

use mb_bricks::{Model, PartLibrary, RandomOptions, random_model};
use mb_instructions::{PieceKind, Plan, Section};
use proptest::prelude::*;

/// What the steps add, as the parts list states it.
fn totals(model: &Model, plan: &Plan) -> BTreeMap<(String, String), usize> {
    let name = |((part, color), count): ((mb_bricks::FileId, mb_bricks::ColorCode), usize)| {
        ((model.file(part).name.clone(), color.to_string()), count)
    };
    plan.totals().into_iter().map(name).collect()
}

fn bom(model: &Model) -> BTreeMap<(String, String), usize> {
    model.bom().into_iter().map(|line| ((line.part, line.color), line.count)).collect()
}

/// Every section's steps place each of its bricks once, and every step is in the order once, submodels first.
fn assert_complete(model: &Model, plan: &Plan) {
    assert_eq!(totals(model, plan), bom(model));
    let steps: usize = plan.sections.iter().map(|section| section.steps.len()).sum();
    let ordered: BTreeSet<_> = plan.order.iter().collect();
    assert_eq!((plan.order.len(), ordered.len()), (steps, steps));
    let mut finished = vec![0; plan.sections.len()];
    for (section, step) in &plan.order {
        assert_eq!(finished[*section], *step, "steps of a section come in order");
        finished[*section] += 1;
        for piece in &plan.sections[*section].steps[*step].pieces {
            if let PieceKind::Submodel(inner) = piece.kind {
                assert_eq!(finished[inner], plan.sections[inner].steps.len(), "built before it is needed");
            }
        }
    }
    for section in &plan.sections {
        let bricks: Vec<usize> = section.steps.iter().flat_map(|step| step.bricks()).collect();
        let once: BTreeSet<_> = bricks.iter().collect();
        assert_eq!(bricks.len(), once.len(), "no brick twice");
        assert!(section.copies > 0 && section.steps.iter().all(|step| !step.pieces.is_empty()));
    }
}

/// How many steps add a piece that holds to nothing that is there, after the first.
fn unconnected_steps(model: &Model, section: &Section) -> usize {
    let site = model.build_site();
    let mut holds: Vec<Vec<usize>> = vec![vec![]; site.boxes.len()];
    for c in &site.connections.studs {
        holds[c.stud_brick].push(c.grip_brick);
        holds[c.grip_brick].push(c.stud_brick);
    }
    let mut there: BTreeSet<usize> = BTreeSet::new();
    let mut loose = 0;
    for (index, step) in section.steps.iter().enumerate() {
        let mut held = true;
        for piece in &step.pieces {
            held &= piece.bricks.iter().any(|&brick| holds[brick].iter().any(|other| there.contains(other)));
            there.extend(&piece.bricks);
        }
        loose += usize::from(index > 0 && !held);
    }
    loose
}

#[test]
fn the_steps_of_every_official_model_add_up_to_its_parts_list() {
    let Some(folder) = mb_testdata::find("ldraw/models") else { return };
    let Some(parts) = mb_testdata::find("ldraw/parts.zip") else { return };
    let library = PartLibrary::open(parts).unwrap();
    let mut paths: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.retain(|path| path.extension().is_some_and(|e| e == "mpd"));
    paths.sort();
    for path in paths {
        let model = Model::read(&path, Some(&library)).unwrap();
        let plan = Plan::of(&model);
        assert_complete(&model, &plan);
        for section in plan.sections.iter().filter(|section| section.automatic) {
            let sizes = section.steps.iter().map(|step| step.pieces.len());
            assert!(sizes.into_iter().all(|n| (1..=6).contains(&n)), "{}", path.display());
        }
        let pieces = plan.sections.iter().flat_map(|s| &s.steps).map(|step| step.pieces.len());
        assert!(pieces.max() <= Some(12), "{}: nobody finds more in one picture", path.display());
    }
}

#[test]
fn a_plan_reads_as_a_person_would_build() {
    let wheel = "1 0 0 0 0 1 0 0 0 1 0 0 0 1 3005.dat\n1 71 0 -24 0 1 0 0 0 1 0 0 0 1 3005.dat\n";
    let text = format!(
        "0 FILE main.ldr\n0 A cart\n1 4 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n0 STEP\n\
         1 16 -40 -24 0 1 0 0 0 1 0 0 0 1 wheel.ldr\n1 16 40 -24 0 1 0 0 0 1 0 0 0 1 wheel.ldr\n\
         1 15 0 -24 0 1 0 0 0 1 0 0 0 1 3003.dat\n0 STEP\n\
         0 FILE wheel.ldr\n0 Wheel\n{wheel}"
    );
    let model = Model::from_text(&text, "main.ldr", None).unwrap();
    let plan = Plan::of(&model);
    assert_complete(&model, &plan);
    insta::assert_snapshot!(plan.outline(&model), @r"
    1 x A cart (the author's steps)
      step 1
        1 x Red Brick 2 x 4
    2 x Wheel (our steps)
      step 1
        1 x Black Brick 1 x 1
      step 2
        1 x Light Bluish Grey Brick 1 x 1
      step 2
        2 x [Wheel]
        1 x White Brick 2 x 2
    ");
}

#[test]
fn a_submodel_in_two_colours_is_two_things_to_build() {
    let text = "0 FILE main.ldr\n1 4 0 0 0 1 0 0 0 1 0 0 0 1 post.ldr\n1 1 40 0 0 1 0 0 0 1 0 0 0 1 post.ldr\n\
                1 4 80 0 0 1 0 0 0 1 0 0 0 1 post.ldr\n0 FILE post.ldr\n\
                1 16 0 0 0 1 0 0 0 1 0 0 0 1 3005.dat\n1 16 0 -24 0 1 0 0 0 1 0 0 0 1 3005.dat\n";
    let model = Model::from_text(text, "main.ldr", None).unwrap();
    let plan = Plan::of(&model);
    assert_complete(&model, &plan);
    let copies: Vec<usize> = plan.sections.iter().map(|section| section.copies).collect();
    assert_eq!(copies, [2, 1, 1], "two red posts, a blue one, the whole");
}

#[test]
fn models_without_parts_have_empty_plans() {
    for text in
        ["3 4 0 0 0 20 0 0 0 0 20\n", "0 FILE a.ldr\n1 4 0 0 0 1 0 0 0 1 0 0 0 1 b.ldr\n0 FILE b.ldr\n0 nothing\n"]
    {
        let plan = Plan::of(&Model::from_text(text, "a.ldr", None).unwrap());
        assert!(plan.sections.is_empty() && plan.order.is_empty() && plan.totals().is_empty());
    }
}

#[test]
fn missing_parts_are_named_and_the_rest_is_built() {
    let text = "1 4 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n1 4 0 -24 0 1 0 0 0 1 0 0 0 1 nosuchpart.dat\n";
    let model = Model::from_text(text, "a.ldr", None).unwrap();
    let plan = Plan::of(&model);
    assert_complete(&model, &plan);
    assert!(plan.warnings.iter().any(|w| w.contains("nosuchpart.dat")), "{:?}", plan.warnings);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 6, ..ProptestConfig::default() })]

    /// A connected model whose steps are taken away gets steps of our own, in which everything holds at once.
    #[test]
    fn our_own_steps_can_be_built(seed in 0u64..1000, bricks in 25usize..60) {
        let random = random_model(&RandomOptions { bricks, seed, ..RandomOptions::default() }, 0).unwrap();
        let text: String = random
            .model
            .file(random.model.root())
            .text
            .lines()
            .filter(|line| !line.starts_with("0 STEP"))
            .map(|line| format!("{line}\n"))
            .collect();
        let model = Model::from_text(&text, "random.ldr", None).unwrap();
        let plan = Plan::of(&model);
        assert_complete(&model, &plan);
        let main = plan.main().unwrap();
        prop_assert!(main.automatic);
        prop_assert!(main.steps.iter().all(|step| (1..=6).contains(&step.pieces.len())));
        prop_assert_eq!(unconnected_steps(&model, main), 0, "each piece holds to what is there");
    }
}
