//! What is built when: submodels, their steps, and what each step adds.

use std::collections::{BTreeMap, HashMap};
use std::fmt::Write as _;

use mb_bricks::{BuildSite, ColorCode, FileId, FileKind, MissingBrick, Model, StepView};

use crate::automatic::{Unit, automatic_steps};

/// The author's steps with more pieces than this are divided: nobody finds thirty pieces in one picture.
const MAX_AUTHOR_PIECES: usize = 12;

/// What is built when. The sum over sections of copies times pieces is the model's parts list, exactly.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The submodels that are built, each once however often it is used; the model itself is the last one.
    pub sections: Vec<Section>,
    /// The steps in the order of the booklet: section and step. A submodel comes right before the step that first
    /// needs it.
    pub order: Vec<(usize, usize)>,
    /// Bricks whose parts are nowhere, and how many of each, sorted: no step adds them, parts lists name them.
    pub missing: Vec<(MissingBrick, usize)>,
    /// What the reader should know.
    pub warnings: Vec<String>,
}

/// A submodel, or the model itself.
#[derive(Debug, Clone, PartialEq)]
pub struct Section {
    /// The file it stands in.
    pub file: FileId,
    /// The use of it that is drawn: index into [`Model::occurrences`].
    pub occurrence: usize,
    /// How often it is built.
    pub copies: usize,
    /// Its steps.
    pub steps: Vec<Step>,
    /// Whether the steps are ours; the author's otherwise.
    pub automatic: bool,
}

/// A step: what is added, in order.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// At least one.
    pub pieces: Vec<Piece>,
    /// How the author turns the model for this step (`ROTSTEP`), where that differs from the default.
    pub view: Option<StepView>,
}

/// What is added as a whole.
#[derive(Debug, Clone, PartialEq)]
pub struct Piece {
    /// What it is.
    pub kind: PieceKind,
    /// Its bricks in the section's drawn use: indices into [`Model::instances`].
    pub bricks: Vec<usize>,
}

/// A brick or a submodel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum PieceKind {
    /// A brick.
    Part(FileId, ColorCode),
    /// A submodel that was built before: index into [`Plan::sections`].
    Submodel(usize),
}

impl Plan {
    /// Plans the building of a model. Parts that are missing from every library are left out of the steps, with a warning.
    pub fn of(model: &Model) -> Self {
        let mut planner = Planner::new(model);
        let root = planner.tree.resolved(0);
        if !planner.tree.bricks[root].is_empty() {
            planner.section(root);
        }
        let mut warnings = planner.warnings;
        for missing in model.missing() {
            warnings.push(format!(
                "{} ({} line {}) is missing: no step adds it, the parts lists name it",
                missing.name, missing.file, missing.line
            ));
        }
        let mut missing = BTreeMap::new();
        for brick in model.missing_bricks() {
            *missing.entry(brick.clone()).or_default() += 1;
        }
        let missing = missing.into_iter().collect();
        let mut plan = Self { sections: planner.sections, order: planner.order, missing, warnings };
        plan.count_copies();
        plan
    }

    /// A section is built as often as the pieces that need it say.
    fn count_copies(&mut self) {
        if let Some(last) = self.sections.last_mut() {
            last.copies = 1;
        }
        // Every section comes after those that it needs.
        for index in (0..self.sections.len()).rev() {
            let copies = self.sections[index].copies;
            let needed: Vec<usize> = self.sections[index]
                .steps
                .iter()
                .flat_map(|step| &step.pieces)
                .filter_map(|piece| if let PieceKind::Submodel(section) = piece.kind { Some(section) } else { None })
                .collect();
            needed.into_iter().for_each(|section| self.sections[section].copies += copies);
        }
    }

    /// The model itself; `None` for a model without bricks.
    pub fn main(&self) -> Option<&Section> {
        self.sections.last()
    }

    /// The bricks that the steps add, all copies together, by part and colour, sorted.
    pub fn totals(&self) -> Vec<((FileId, ColorCode), usize)> {
        let mut counts = BTreeMap::new();
        for section in &self.sections {
            for piece in section.steps.iter().flat_map(|step| &step.pieces) {
                if let PieceKind::Part(part, color) = piece.kind {
                    *counts.entry((part, color)).or_default() += section.copies;
                }
            }
        }
        counts.into_iter().collect()
    }

    /// The plan in words, a line a piece: for logs and tests.
    pub fn outline(&self, model: &Model) -> String {
        let mut text = String::new();
        for (index, step) in &self.order {
            let section = &self.sections[*index];
            if *step == 0 {
                let how = if section.automatic { "our steps" } else { "the author's steps" };
                let _ = writeln!(text, "{} x {} ({how})", section.copies, section_title(model, section));
            }
            let _ = writeln!(text, "  step {}", step + 1);
            for (kind, count) in section.steps[*step].counts() {
                let what = match kind {
                    PieceKind::Part(part, color) => {
                        format!("{} {}", model.colors().look(color).name, model.file(part).description)
                    }
                    PieceKind::Submodel(sub) => format!("[{}]", section_title(model, &self.sections[sub])),
                };
                let _ = writeln!(text, "    {count} x {what}");
            }
        }
        text
    }
}

impl Step {
    /// What is added and how often, in order of first use.
    pub fn counts(&self) -> Vec<(PieceKind, usize)> {
        let mut counts: Vec<(PieceKind, usize)> = vec![];
        for piece in &self.pieces {
            match counts.iter_mut().find(|(kind, _)| *kind == piece.kind) {
                Some((_, count)) => *count += 1,
                None => counts.push((piece.kind, 1)),
            }
        }
        counts
    }

    /// All bricks that are added.
    pub fn bricks(&self) -> impl Iterator<Item = usize> {
        self.pieces.iter().flat_map(|piece| piece.bricks.iter().copied())
    }
}

/// What a section is called: its file's description, else its name.
pub fn section_title(model: &Model, section: &Section) -> String {
    let file = model.file(section.file);
    let stem = |name: &str| {
        let name = name.rsplit('/').next().unwrap_or(name);
        name.rsplit_once('.').map_or(name, |(stem, _)| stem).to_owned()
    };
    let description = file.description.trim();
    if description.is_empty() { stem(&file.name) } else { stem(description) }
}

/// The tree of submodels, with what lies under each use.
struct Tree<'a> {
    model: &'a Model,
    /// Of each occurrence: its bricks and submodels in the order of their lines.
    children: Vec<Vec<(usize, Child)>>,
    /// Of each occurrence: every brick under it.
    bricks: Vec<Vec<usize>>,
}

#[derive(Clone, Copy)]
enum Child {
    Brick(usize),
    Submodel(usize),
}

impl<'a> Tree<'a> {
    fn new(model: &'a Model) -> Self {
        let count = model.occurrences().len();
        let (mut children, mut bricks) = (vec![vec![]; count], vec![vec![]; count]);
        for (index, brick) in model.instances().iter().enumerate() {
            children[brick.occurrence].push((brick.reference, Child::Brick(index)));
            let mut above = Some(brick.occurrence);
            while let Some(occurrence) = above {
                bricks[occurrence].push(index);
                above = model.occurrences()[occurrence].parent.map(|(parent, _)| parent);
            }
        }
        for (index, occurrence) in model.occurrences().iter().enumerate() {
            if let Some((parent, reference)) = occurrence.parent {
                children[parent].push((reference, Child::Submodel(index)));
            }
        }
        for of_one in &mut children {
            of_one.retain(|(_, child)| {
                matches!(child, Child::Brick(_)) || matches!(child, Child::Submodel(sub) if !bricks[*sub].is_empty())
            });
            of_one.sort_by_key(|(reference, _)| *reference);
        }
        Self { model, children, bricks }
    }

    /// The first submodel on the way down that holds more than one thing.
    fn resolved(&self, mut occurrence: usize) -> usize {
        while let [(_, Child::Submodel(only))] = self.children[occurrence][..] {
            occurrence = only;
        }
        occurrence
    }

    /// What makes two uses of submodels the same thing to build: the file, and the bricks with their colours.
    fn signature(&self, occurrence: usize) -> (FileId, Vec<(FileId, ColorCode)>) {
        let bricks = self.bricks[occurrence].iter().map(|&brick| {
            let brick = &self.model.instances()[brick];
            (brick.part, brick.color)
        });
        (self.model.occurrences()[occurrence].file, bricks.collect())
    }
}

struct Planner<'a> {
    model: &'a Model,
    tree: Tree<'a>,
    site: BuildSite,
    section_of: HashMap<(FileId, Vec<(FileId, ColorCode)>), usize>,
    sections: Vec<Section>,
    order: Vec<(usize, usize)>,
    warnings: Vec<String>,
}

impl<'a> Planner<'a> {
    fn new(model: &'a Model) -> Self {
        Self {
            model,
            tree: Tree::new(model),
            site: model.build_site(),
            section_of: HashMap::new(),
            sections: vec![],
            order: vec![],
            warnings: vec![],
        }
    }

    /// Plans a submodel and, before the steps that need them, those inside it. Its depth was bounded at loading.
    fn section(&mut self, occurrence: usize) -> usize {
        let signature = self.tree.signature(occurrence);
        if let Some(&known) = self.section_of.get(&signature) {
            return known;
        }
        let file_id = self.model.occurrences()[occurrence].file;
        let file = self.model.file(file_id);
        // Pieces by the author's step; what they are is known once their sections are.
        let children = self.tree.children[occurrence].clone();
        let mut groups: Vec<(u32, Vec<Child>)> = vec![];
        for (reference, child) in children {
            let step = file.references.get(reference).map_or(0, |r| r.step);
            match groups.last_mut() {
                Some((last, group)) if *last == step => group.push(child),
                _ => groups.push((step, vec![child])),
            }
        }
        let stated = file.kind == FileKind::Model && !file.steps.is_empty();
        let pieces: usize = groups.iter().map(|(_, group)| group.len()).sum();
        let automatic = pieces > 1 && !(stated && (groups.len() > 1 || pieces <= 6));

        let mut order: Vec<(usize, usize)> = vec![];
        let mut steps: Vec<Step> = vec![];
        let mut placed: Vec<usize> = vec![];
        let mut divided = 0;
        for (number, group) in groups {
            let view = author_view(&file.steps, number as usize);
            // In the author's order, so that submodels come where they are needed first.
            let of_group = if automatic || group.len() > MAX_AUTHOR_PIECES {
                divided += usize::from(!automatic);
                let units: Vec<Unit> = group.iter().map(|&child| self.unit(child)).collect();
                automatic_steps(&self.site, &units, &placed)
                    .into_iter()
                    .map(|step| step.into_iter().map(|unit| group[unit]).collect())
                    .collect()
            } else {
                vec![group]
            };
            for group in of_group {
                let inner = self.order.len();
                let pieces: Vec<Piece> = group.into_iter().map(|child| self.piece(child)).collect();
                // The steps of submodels that this step is the first to need.
                order.extend(self.order.drain(inner..));
                placed.extend(pieces.iter().flat_map(|piece| piece.bricks.iter().copied()));
                order.push((usize::MAX, steps.len()));
                steps.push(Step { pieces, view });
            }
        }
        if divided > 0 {
            self.warnings.push(format!(
                "{}: {divided} of the author's steps add more than {MAX_AUTHOR_PIECES} pieces; they are divided",
                file.name
            ));
        }
        let index = self.sections.len();
        self.order.extend(order.into_iter().map(|(section, step)| (section.min(index), step)));
        self.sections.push(Section { file: file_id, occurrence, copies: 0, steps, automatic });
        self.section_of.insert(signature, index);
        index
    }

    fn unit(&self, child: Child) -> Unit {
        match child {
            Child::Brick(brick) => {
                let instance = &self.model.instances()[brick];
                Unit { bricks: vec![brick], kind: Some((instance.part, instance.color)) }
            }
            Child::Submodel(occurrence) => {
                let bricks = self.tree.bricks[occurrence].clone();
                let kind = match bricks[..] {
                    [only] => Some((self.model.instances()[only].part, self.model.instances()[only].color)),
                    _ => None,
                };
                Unit { bricks, kind }
            }
        }
    }

    fn piece(&mut self, child: Child) -> Piece {
        let part = |brick: usize| {
            let instance = &self.model.instances()[brick];
            Piece { kind: PieceKind::Part(instance.part, instance.color), bricks: vec![brick] }
        };
        match child {
            Child::Brick(brick) => part(brick),
            Child::Submodel(occurrence) => {
                let bricks = self.tree.bricks[occurrence].clone();
                if let [only] = bricks[..] {
                    // A submodel of one brick is that brick.
                    return part(only);
                }
                let resolved = self.tree.resolved(occurrence);
                Piece { kind: PieceKind::Submodel(self.section(resolved)), bricks }
            }
        }
    }
}

/// The view of step `number` (counted from 0): what the step line that ends it says, on top of the earlier ones.
fn author_view(steps: &[mb_bricks::StepLine], number: usize) -> Option<StepView> {
    let mut view = None;
    for line in steps.iter().take(number + 1) {
        // A plain STEP keeps the view of the last ROTSTEP.
        match line.view {
            None => {}
            Some(StepView::Default) => view = None,
            Some(StepView::Additive(added)) => {
                view = Some(match view {
                    Some(StepView::Relative(last)) => StepView::Relative(std::array::from_fn(|i| last[i] + added[i])),
                    Some(StepView::Absolute(last)) => StepView::Absolute(std::array::from_fn(|i| last[i] + added[i])),
                    _ => StepView::Relative(added),
                });
            }
            set => view = set,
        }
    }
    view
}
