//! What random models look like: one recipe for each style.

use super::masonry::{Mask, Rect};
use super::profile::Style;
use super::site::{BRICK, Site};

impl Site<'_, '_> {
    /// Builds a model of that style.
    pub fn build_style(&mut self, style: Style) {
        match style {
            Style::Tower => self.tower(),
            Style::Wall => self.wall(),
            Style::Gate => self.gate(),
            Style::Arcade => self.arcade(),
            Style::Bridge => self.bridge(),
            Style::House => self.house(),
            Style::Castle => self.castle(),
            Style::Temple => self.temple(),
            Style::Pyramid => self.pyramid(),
            Style::Rotunda => self.rotunda(),
            Style::Tree => self.tree(),
            Style::Lattice => self.lattice(),
            Style::Figure => self.figure(),
            Style::Sculpture => self.sculpture(),
        }
    }

    /// What a square tower carries at its top.
    fn crown(&mut self, rect: Rect, y: i32) {
        let (roof, trim, detail) = (self.colors.roof, self.colors.trim, self.colors.detail);
        match self.between(0, 3) {
            0 => {
                // A platform that stands out, with teeth.
                let room = self.build.room;
                let grown = rect.grown(1);
                let inside = grown.x >= 0 && grown.z >= 0 && grown.x + grown.width <= room[0];
                let platform = if inside && grown.z + grown.depth <= room[2] { grown } else { rect };
                let y = self.lid(platform, y, trim);
                self.battlements(platform, y, roof);
            }
            1 => self.gable(rect, y),
            2 => {
                // Steps, and a spire on them.
                let mut y = self.lid(rect, y, trim);
                let mut rect = rect;
                while rect.width > 3 && rect.depth > 3 {
                    rect = rect.grown(-1);
                    self.build.course(&Mask::rectangle(self.build.room, rect), y, BRICK, &|_, _, _| roof, self.rng);
                    y += BRICK;
                }
                let courses = self.between(1, 3);
                let (x, z) = (rect.x + (rect.width - 2) / 2, rect.z + (rect.depth - 2) / 2);
                let y = self.column(x, z, 2, y, courses, roof);
                self.column(x, z, 1, y, 1, detail);
            }
            _ => {
                let y = self.lid(rect, y, trim);
                self.battlements(rect, y, roof);
            }
        }
    }

    fn tower(&mut self) {
        // Widths that plates can span.
        let widths = [3, 4, 4, 6, 6, 8];
        let (width, depth) = (widths[self.scaled(0, 5) as usize], widths[self.scaled(0, 5) as usize]);
        let courses = self.scaled(7, 19);
        let rect = self.middle(width, depth);
        let y = if self.chance(0.4) { self.foundation(rect.grown(1), 2) } else { 0 };
        let taper = if self.chance(0.35) && width > 4 && depth > 4 { self.between(3, courses - 3) } else { courses };
        let every = self.between(4, 6);
        let inner = rect.grown(-1);
        let top = self.raise(y, courses, |[x, z], course| {
            let body = if course <= taper { rect } else { inner };
            let lid = course == taper;
            let rim = body.grown(-1);
            let window = course % every == every - 2 && (x == rect.x + width / 2 || z == rect.z + depth / 2);
            body.holds([x, z]) && (lid || !rim.holds([x, z])) && !window
        });
        self.crown(if taper < courses { inner } else { rect }, top);
    }

    fn wall(&mut self) {
        let (length, thick) = (self.scaled(10, 24), self.between(2, 3));
        let highest = self.scaled(4, 12);
        // Straight, or round a corner.
        let leg = if self.chance(0.5) { self.scaled(4, 12) } else { 0 };
        let rect = self.middle(length, thick.max(leg));
        let front = Rect::new(rect.x, rect.z, length, thick);
        let side = Rect::new(rect.x, rect.z, thick, leg);
        // The skyline: steps to one side, a valley, a hill, ragged, or towers at regular distances.
        let kind = self.between(0, 4);
        let pitch = self.between(5, 8);
        let mut height = highest;
        let mut heights = vec![];
        for at in 0..length + leg {
            let share = f64::from(at) / f64::from(length + leg - 1);
            height = match kind {
                0 => (f64::from(highest) * (1.0 - 0.8 * share)).ceil() as i32,
                1 => (f64::from(highest) * (0.35 + 0.65 * (2.0 * share - 1.0).abs())).ceil() as i32,
                2 => (f64::from(highest) * (1.0 - 0.7 * (2.0 * share - 1.0).abs())).ceil() as i32,
                3 if at % 3 == 0 => (height + self.between(-2, 2)).clamp(2, highest),
                3 => height,
                _ if at % pitch < 3 => highest,
                _ => (highest / 2).max(2),
            };
            heights.push(height);
        }
        let gap = self.between(1, 3);
        let (sill, head) = (self.between(0, 2), self.between(2, 4));
        let y = if self.chance(0.5) { self.foundation(front.grown(1), 2) } else { 0 };
        let y = self.raise(y, highest, |square, course| {
            // How far along the wall, counted from the end of the side.
            let along = if front.holds(square) {
                leg + square[0] - rect.x
            } else if side.holds(square) {
                leg - 1 - (square[1] - rect.z)
            } else {
                return false;
            };
            let open = along % pitch >= 3 && along % pitch < 3 + gap && along + 2 < length + leg;
            course < heights[along as usize] && !(open && (sill..head).contains(&course))
        });
        if kind > 2 {
            let color = self.colors.roof;
            self.battlements(front, y, color);
        }
        let small = self.between(2, 8) as usize;
        self.adorn(small);
    }

    /// A passage with something above it.
    fn gate(&mut self) {
        let (pier, gap, depth) = (self.scaled(2, 4), self.between(2, 6), self.scaled(2, 5));
        let (passage, above) = (self.scaled(3, 8), self.scaled(2, 5));
        let width = 2 * pier + gap;
        let rect = self.middle(width, depth);
        let opening = Rect::new(rect.x + pier, rect.z, gap, depth);
        // The piers may go on as towers.
        let towers = if self.chance(0.5) { self.between(2, 5) } else { 0 };
        let y = if self.chance(0.4) { self.foundation(rect.grown(1), 2) } else { 0 };
        let top = self.raise(y, passage + above + towers, |square, course| {
            let open = opening.holds(square);
            rect.holds(square) && (!open || (passage..passage + above).contains(&course))
        });
        if towers == 0 {
            self.crown(rect, top);
            return;
        }
        self.battlements(opening, y + BRICK * (passage + above), self.colors.trim);
        for x in [rect.x, rect.x + pier + gap] {
            let turret = Rect::new(x, rect.z, pier, depth);
            let roof = self.colors.roof;
            if self.chance(0.5) {
                self.battlements(turret, top, roof);
            } else {
                self.gable(turret, top);
            }
        }
    }

    /// Rows of arches, one above the other, as in an aqueduct.
    fn arcade(&mut self) {
        let (pier, gap, depth) = (self.between(2, 3), self.between(2, 5), self.between(2, 4));
        let arches = self.scaled(1, 4).max(1);
        let tiers = self.scaled(1, 3).max(1);
        let heights: Vec<i32> = (0..tiers).map(|_| self.between(2, 4)).collect();
        let width = (arches * (pier + gap) + pier).min(self.build.room[0]);
        let rect = self.middle(width, depth);
        let mut y = 0;
        let mut margin = 0;
        for height in heights {
            let body = Rect::new(rect.x + margin, rect.z, width - 2 * margin, depth);
            y = self.raise(y, height + 1, |[x, z], course| {
                let open = (x - rect.x) % (pier + gap) >= pier;
                body.holds([x, z]) && (!open || course == height)
            });
            // Upper tiers may be shorter.
            if body.width > 2 * (pier + gap) + pier && self.chance(0.4) {
                margin += pier + gap;
            }
        }
        let top = Rect::new(rect.x + margin, rect.z, width - 2 * margin, depth);
        let y = self.lid(top, y, self.colors.trim);
        if self.chance(0.6) {
            let color = self.colors.roof;
            self.battlements(top, y, color);
        }
    }

    fn bridge(&mut self) {
        let (pier, gap, depth) = (self.between(2, 3), self.between(4, 7), self.scaled(3, 6));
        let spans = self.scaled(1, 3).max(1);
        let height = self.scaled(2, 6);
        let ramp = self.between(0, height.min(4));
        let body = (spans * (pier + gap) + pier).min(self.build.room[0] - 2 * ramp);
        let rect = self.middle(body + 2 * ramp, depth);
        let start = rect.x + ramp;
        let towers = self.chance(0.4);
        let y = self.raise(0, height + 1, |[x, z], course| {
            let at = x - start;
            if !rect.holds([x, z]) {
                return false;
            }
            if at < 0 || at >= body {
                // Stairs at both ends.
                let out = if at < 0 { -at } else { at - body + 1 };
                return course < (height + 1) * (ramp + 1 - out) / (ramp + 1);
            }
            at % (pier + gap) < pier || course == height
        });
        let deck = Rect::new(start, rect.z, body, depth);
        let y = self.lid(deck, y, self.colors.trim);
        let (roof, detail) = (self.colors.roof, self.colors.detail);
        if towers && depth >= 4 {
            let rise = self.scaled(3, 7);
            let inner = Rect::new(start, rect.z + 1, body, depth - 2);
            let towers = self.raise(y, rise + 1, |[x, z], course| {
                let at = (x - start) % (pier + gap);
                deck.holds([x, z]) && at < pier.min(2) && (!inner.holds([x, z]) || course == rise)
            });
            for index in 0..=spans {
                let portal = Rect::new(start + index * (pier + gap), rect.z, pier.min(2), depth);
                self.battlements(portal, towers, roof);
            }
            return;
        }
        for z in [rect.z, rect.z + depth - 1] {
            let side = Rect::new(start, z, body, 1);
            self.battlements(side, y, roof);
            for index in 0..=spans {
                let x = start + index * (pier + gap);
                let courses = self.between(1, 2);
                if self.build.contains([x + 1, z]) {
                    self.column(x + 1, z, 1, y, courses, detail);
                }
            }
        }
    }

    fn house(&mut self) {
        let (width, depth) = (2 * self.scaled(3, 7), 2 * self.scaled(2, 4));
        let courses = self.scaled(3, 6);
        let rect = self.middle(width, depth);
        let garden = Rect::new(rect.x - 1, rect.z - 2, width + 2, depth + 3);
        let y = if self.chance(0.7) { self.foundation(garden, 2) } else { 0 };
        let door = rect.x + self.between(2, width - 4);
        let inner = rect.grown(-1);
        let y = self.raise(y, courses, |[x, z], course| {
            let door = z == rect.z && (door..door + 2).contains(&x) && course < 2;
            let sides = (x - rect.x) % 4 == 2 && (z == rect.z + depth - 1 || (z == rect.z && x >= rect.x + 2));
            let window = sides && course >= 1 && course % 3 == 1;
            rect.holds([x, z]) && !inner.holds([x, z]) && !door && !window
        });
        let floor = self.lid(rect, y, self.colors.trim);
        self.gable(rect, floor);
        let small = self.between(2, 8) as usize;
        self.adorn(small);
    }

    /// Towers of different heights with walls between them.
    fn castle(&mut self) {
        let (width, depth) = (self.scaled(9, 20), self.scaled(8, 16));
        let rect = self.middle(width, depth);
        let ring = self.chance(0.6);
        let side = self.between(2, 4);
        let wall = self.scaled(2, 6);
        let gate = rect.x + width / 2 - 1;
        let gate_height = self.between(1, 2).min(wall - 1);
        let mut towers: Vec<(Rect, i32)> = vec![];
        let corners = [[rect.x, rect.z], [rect.x + width - side, rect.z]]
            .into_iter()
            .chain([[rect.x, rect.z + depth - side], [rect.x + width - side, rect.z + depth - side]]);
        for [x, z] in corners.take(if ring { 4 } else { 3 }) {
            let height = wall + self.scaled(1, 8);
            towers.push((Rect::new(x, z, side, side), height));
        }
        let tallest = towers.iter().map(|(_, height)| *height).max().unwrap_or(wall);
        let y = if ring { 0 } else { self.foundation(rect, 2) };
        let stood = towers.clone();
        self.raise(y, tallest, |[x, z], course| {
            let tower = stood.iter().any(|(tower, height)| tower.holds([x, z]) && course < *height);
            let front = z == rect.z + side / 2;
            let back = ring && z == rect.z + depth - 1 - side / 2;
            let left = x == rect.x + side / 2;
            let right = ring && x == rect.x + width - 1 - side / 2;
            let open = front && (gate..gate + 2).contains(&x) && course < gate_height;
            tower || (rect.holds([x, z]) && course < wall && (front || back || left || right) && !open)
        });
        for (tower, height) in towers {
            let top = y + BRICK * height;
            self.crown_small(tower, top);
        }
        let small = self.between(2, 6) as usize;
        self.adorn(small);
    }

    /// The top of a slender tower.
    fn crown_small(&mut self, rect: Rect, y: i32) {
        let (roof, detail) = (self.colors.roof, self.colors.detail);
        if rect.width >= 4 && self.chance(0.5) {
            self.gable(rect, y);
        } else if self.chance(0.5) {
            let y = self.lid(rect, y, roof);
            self.battlements(rect, y, roof);
        } else {
            let y = self.lid(rect, y, roof);
            let (x, z) = (rect.x + (rect.width - 2) / 2, rect.z + (rect.depth - 2) / 2);
            let y = self.column(x, z, 2, y, 1, roof);
            self.column(x, z, 1, y, 1, detail);
        }
    }

    /// Columns that carry a roof.
    fn temple(&mut self) {
        let side = self.between(1, 2);
        let pitch = side + self.between(1, 2);
        let (across, along) = (self.scaled(3, 6), self.scaled(2, 4));
        let (width, depth) = ((across - 1) * pitch + side, (along - 1) * pitch + side);
        let rect = self.middle(width, depth);
        let steps = self.between(1, 2);
        let mut y = 0;
        for step in 0..steps {
            y = self.plinth(rect.grown(steps - step), y);
        }
        let courses = self.scaled(3, 6);
        let (wall, trim) = (self.colors.wall, self.colors.trim);
        let mut top = y;
        for i in 0..across {
            for j in 0..along {
                if i == 0 || j == 0 || i == across - 1 || j == along - 1 {
                    top = self.column(rect.x + i * pitch, rect.z + j * pitch, side, y, courses, wall);
                }
            }
        }
        let top = self.lid(rect, top, trim);
        let top = self.lid(rect, top, trim);
        if self.chance(0.7) {
            self.gable(rect, top);
        } else {
            let rim = self.raise(top, 1, |square, _| rect.holds(square) && !rect.grown(-1).holds(square));
            self.battlements(rect, rim, trim);
        }
    }

    /// Two layers of plates.
    fn plinth(&mut self, rect: Rect, y: i32) -> i32 {
        let color = self.colors.base;
        let y = self.lid(rect, y, color);
        self.lid(rect, y, color)
    }

    /// Steps on all sides, or on some.
    fn pyramid(&mut self) {
        let (width, depth) = (self.scaled(8, 18), self.scaled(7, 16));
        let rect = self.middle(width, depth);
        let steps: [i32; 4] = std::array::from_fn(|_| self.between(0, 2));
        let steps = if steps.iter().sum::<i32>() < 3 { [1; 4] } else { steps };
        let courses = self.scaled(3, 9);
        let hollow = self.chance(0.5);
        let layer = move |course: i32| {
            let [a, b, c, d] = steps.map(|step| step * course);
            Rect::new(rect.x + a, rect.z + b, rect.width - a - c, rect.depth - b - d)
        };
        let courses = (1..=courses).take_while(|&k| layer(k - 1).width >= 2 && layer(k - 1).depth >= 2).count() as i32;
        let top = self.raise(0, courses, |square, course| {
            let room = course + 1 < courses && layer(course + 1).grown(-1).holds(square);
            layer(course).holds(square) && !(hollow && room && course % 2 == 0)
        });
        let last = layer(courses - 1);
        if last.width.min(last.depth) >= 2 {
            self.crown_small(Rect::new(last.x, last.z, last.width.min(4), last.depth.min(4)), top);
        }
        let small = self.between(4, 14) as usize;
        self.adorn(small);
    }

    /// A round wall with openings, in one or more tiers.
    fn rotunda(&mut self) {
        let width = self.scaled(8, 18);
        let rect = self.middle(width, width);
        let tiers = self.scaled(1, 4).max(1);
        let height = self.between(2, 3);
        let middle = [2 * rect.x + width, 2 * rect.z + width];
        let thickness = 2 * self.between(2, 3);
        let broken = self.chance(0.4);
        let sectors = f64::from(self.between(5, 9));
        let y = self.raise(0, tiers * (height + 1), |[x, z], course| {
            let (dx, dz) = (2 * x + 1 - middle[0], 2 * z + 1 - middle[1]);
            let out_sq = dx * dx + dz * dz;
            let in_wall = out_sq <= width * width && out_sq > (width - thickness) * (width - thickness);
            let angle = f64::from(dz).atan2(f64::from(dx)) / std::f64::consts::TAU + 0.5;
            let open = (angle * sectors).fract() < 0.42 && course % (height + 1) != height;
            // As old ones stand: the upper tiers on one side only.
            let fallen = broken && course / (height + 1) > ((1.0 - angle) * f64::from(tiers + 1)) as i32;
            in_wall && !open && !fallen
        });
        let y = self.lid_on_studs(y);
        if !broken {
            let color = self.colors.roof;
            let rim: Vec<[i32; 2]> =
                self.build.free_studs().iter().filter(|s| s[1] == y).map(|s| [s[0], s[2]]).collect();
            for [x, z] in rim.into_iter().step_by(3) {
                self.column(x, z, 1, y, 1, color);
            }
        }
    }

    /// Plates on all studs at height `y`, which tie together what stands there; returns the height on top of them.
    fn lid_on_studs(&mut self, y: i32) -> i32 {
        let mut mask = Mask::none(self.build.room);
        for [x, level, z] in self.build.free_studs() {
            if level == y {
                mask.add(Rect::new(x, z, 1, 1));
            }
        }
        let color = self.colors.trim;
        self.build.course(&mask, y, 1, &|_, _, _| color, self.rng);
        y + 1
    }

    /// A trunk that spreads out above.
    fn tree(&mut self) {
        let trunk = self.between(2, 3);
        let rise = self.scaled(3, 9);
        let spread = self.scaled(2, 5);
        let layers = self.scaled(3, 7);
        let rect = self.middle(trunk, trunk);
        let foot = self.between(1, 2);
        let y = self.foundation(rect.grown(foot + 1), 2);
        let bark = self.colors.wall;
        std::mem::swap(&mut self.colors.wall, &mut self.colors.base);
        let top = self.raise(y, rise, |square, course| {
            rect.holds(square) || (course < foot && rect.grown(foot - course).holds(square))
        });
        self.colors.wall = bark;
        let kind = self.between(0, 2);
        self.raise(top, layers, |square, course| {
            // A ball, an umbrella, or storeys with gaps.
            let out = match kind {
                0 => spread.min(course + 1).min(layers - course),
                1 => (course + 1).min(spread),
                _ => {
                    if course % 2 == 0 {
                        (spread - course / 2).max(1).min(course + 2)
                    } else {
                        0
                    }
                }
            };
            let crown = rect.grown(out);
            let corner = |v: i32, low: i32, length: i32| (low - v).max(v - low - length + 1).max(0);
            let far = corner(square[0], rect.x, trunk) + corner(square[1], rect.z, trunk);
            crown.holds(square) && far <= out + out / 2
        });
        let small = self.between(3, 10) as usize;
        self.adorn(small);
    }

    /// Beams laid crosswise on each other, turning or wandering as they rise.
    fn lattice(&mut self) {
        let (width, depth) = (self.scaled(5, 9), self.scaled(5, 9));
        let courses = self.scaled(8, 22);
        let beam = self.between(1, 2);
        let bars = self.between(2, 3);
        let rect = self.middle(width, depth);
        let mut at = [0, 0];
        let mut shifts = vec![];
        for course in 0..courses {
            if course % 2 == 0 && self.chance(0.6) {
                at[0] = (at[0] + self.between(-1, 1)).clamp(-2, 2);
                at[1] = (at[1] + self.between(-1, 1)).clamp(-2, 2);
            }
            shifts.push(at);
        }
        let top = self.raise(0, courses, |[x, z], course| {
            let [dx, dz] = shifts[course as usize];
            let (x, z) = (x - rect.x - dx, z - rect.z - dz);
            let inside = (0..width).contains(&x) && (0..depth).contains(&z);
            let (across, span) = if course % 2 == 0 { (z, depth) } else { (x, width) };
            let on_bar = (0..bars).any(|bar| {
                let start = (span - beam) * bar / (bars - 1);
                (start..start + beam).contains(&across)
            });
            inside && on_bar
        });
        let [dx, dz] = at;
        let color = self.colors.trim;
        self.lid(Rect::new(rect.x + dx, rect.z + dz, width, depth), top, color);
        let small = self.between(1, 5) as usize;
        self.adorn(small);
    }

    /// Legs, a body, arms that stand out, a head.
    fn figure(&mut self) {
        let leg = self.between(2, 3);
        let gap = self.between(1, 3);
        let (body, depth) = (2 * leg + gap, self.between(2, 3).max(leg - 1));
        let (legs, trunk) = (self.scaled(2, 6), self.scaled(3, 7));
        let arm = self.between(1, 3);
        let head = self.between(2, (body - 2).max(2));
        let rect = self.middle(body, depth);
        let feet = Rect::new(rect.x, rect.z - 1, body, depth + 2);
        let arms_at = legs + trunk - self.between(1, 2);
        let hands = self.chance(0.5);
        let y = self.raise(0, legs + trunk, |[x, z], course| {
            let between_legs = (rect.x + leg..rect.x + leg + gap).contains(&x);
            if course < legs {
                let body = if course == 0 { feet } else { rect };
                return body.holds([x, z]) && !between_legs;
            }
            let with_arms = Rect::new(rect.x - arm, rect.z, body + 2 * arm, depth);
            let raised = hands && course > arms_at && with_arms.holds([x, z]) && !rect.grown(arm - 1).holds([x, z]);
            rect.holds([x, z]) || (course == arms_at && with_arms.holds([x, z])) || raised
        });
        let (neck, trim) = (Rect::new(rect.x + (body - 2) / 2, rect.z + (depth - 2) / 2, 2, 2), self.colors.trim);
        let y = self.lid(neck, y, trim);
        let skull = Rect::new(rect.x + (body - head) / 2, rect.z, head, depth);
        std::mem::swap(&mut self.colors.wall, &mut self.colors.roof);
        let tall = self.between(1, 3);
        let y = self.raise(y, tall, |square, _| skull.holds(square));
        std::mem::swap(&mut self.colors.wall, &mut self.colors.roof);
        if self.chance(0.5) {
            let y = self.lid(skull.grown(1), y, trim);
            self.lid(skull, y, trim);
        }
        let small = self.between(1, 5) as usize;
        self.adorn(small);
    }

    /// Grown brick by brick from a few feet.
    fn sculpture(&mut self) {
        let (width, depth) = (self.scaled(5, 10), self.scaled(5, 10));
        let rect = self.middle(width, depth);
        let y = self.foundation(rect, 2);
        let posts = self.between(2, 4);
        for _ in 0..posts {
            let (x, z) = (rect.x + self.between(0, width - 2), rect.z + self.between(0, depth - 2));
            let courses = self.scaled(2, 10);
            let color = self.colors.wall;
            self.column(x, z, 2, y, courses, color);
        }
        let wanted = self.build.placed.len() + self.scaled(12, 90) as usize;
        self.grow(wanted);
    }
}
