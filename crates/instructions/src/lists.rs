//! Lists for buying the parts: CSV for people, BrickLink's wanted list for its importer.

use std::fmt::Write as _;

use mb_bricks::{ColorCode, Model};
use serde::Serialize;

use crate::bricklink::{color_id, item_id};
use crate::html::escaped;
use crate::plan::Plan;

/// What of the lists somebody has to look at.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct ListNotes {
    /// LDraw colours without a BrickLink number that we know: code and name. Their items carry no colour in the wanted
    /// list.
    pub unmapped_colors: Vec<String>,
    /// Parts that BrickLink numbers differently (patterns, assemblies): their items carry LDraw's number and a remark.
    pub uncertain_parts: Vec<String>,
    /// Parts that are in no library: the lists name them, the steps do not add them.
    pub missing_parts: Vec<String>,
}

/// A line of the lists.
struct Item {
    count: usize,
    /// The part's file.
    part: String,
    /// What it is; empty where the part is missing.
    description: String,
    color: ColorCode,
    color_name: String,
    is_missing: bool,
}

/// What the steps add, then what is missing.
fn items(model: &Model, plan: &Plan) -> Vec<Item> {
    let item = |count, part: &str, description: &str, color, is_missing| Item {
        count,
        part: part.to_owned(),
        description: description.split_whitespace().collect::<Vec<_>>().join(" "),
        color,
        color_name: model.colors().look(color).name,
        is_missing,
    };
    let added = plan.totals().into_iter().map(|((part, color), count)| {
        let file = model.file(part);
        item(count, &file.name, &file.description, color, false)
    });
    let missing = plan.missing.iter().map(|(brick, count)| item(*count, &brick.name, "", brick.color, true));
    added.chain(missing).collect()
}

impl Item {
    /// What somebody has to look at; empty where all is sure.
    fn note(&self) -> String {
        let mut notes = vec![];
        if self.is_missing {
            notes.push("missing from the parts library: not in the steps".to_owned());
        }
        if !item_id(&self.part).1 {
            notes.push("LDraw's part number: look it up".to_owned());
        }
        if color_id(self.color).is_none() {
            notes.push(format!("LDraw colour {}: choose one", self.color));
        }
        notes.join("; ")
    }
}

/// What the lists cannot say for certain.
pub fn list_notes(model: &Model, plan: &Plan) -> ListNotes {
    let mut notes = ListNotes::default();
    for item in items(model, plan) {
        if color_id(item.color).is_none() {
            notes.unmapped_colors.push(format!("{} {}", item.color, item.color_name));
        }
        if item.is_missing {
            notes.missing_parts.push(item.part);
        } else if !item_id(&item.part).1 {
            notes.uncertain_parts.push(item.part);
        }
    }
    for list in [&mut notes.unmapped_colors, &mut notes.uncertain_parts, &mut notes.missing_parts] {
        list.sort();
        list.dedup();
    }
    notes
}

/// `quantity,part,description,ldraw_color,color,bricklink_item,bricklink_color,note`: a line for each part and colour.
pub fn shopping_list(model: &Model, plan: &Plan) -> String {
    let mut csv = "quantity,part,description,ldraw_color,color,bricklink_item,bricklink_color,note\r\n".to_owned();
    for item in items(model, plan) {
        let (id, sure) = item_id(&item.part);
        let fields = [
            item.count.to_string(),
            item.part.clone(),
            item.description.clone(),
            item.color.to_string(),
            item.color_name.clone(),
            if sure { id } else { String::new() },
            color_id(item.color).map(|id| id.to_string()).unwrap_or_default(),
            item.note(),
        ];
        let _ = write!(csv, "{}\r\n", fields.map(|field| quoted(&field)).join(","));
    }
    csv
}

/// The XML that BrickLink's page for uploading wanted lists takes. It allows no XML declaration.
pub fn wanted_list(model: &Model, plan: &Plan) -> String {
    let mut xml = "<INVENTORY>\n".to_owned();
    for item in items(model, plan) {
        xml.push_str("  <ITEM>\n    <ITEMTYPE>P</ITEMTYPE>\n");
        let _ = writeln!(xml, "    <ITEMID>{}</ITEMID>", escaped(&item_id(&item.part).0));
        if let Some(id) = color_id(item.color) {
            let _ = writeln!(xml, "    <COLOR>{id}</COLOR>");
        }
        let _ = writeln!(xml, "    <MINQTY>{}</MINQTY>", item.count);
        let mut remark = item.note();
        if color_id(item.color).is_none() {
            let _ = write!(remark, " ({})", item.color_name);
        }
        if !remark.is_empty() {
            let _ = writeln!(xml, "    <REMARKS>{}</REMARKS>", escaped(remark.trim()));
        }
        xml.push_str("  </ITEM>\n");
    }
    xml.push_str("</INVENTORY>\n");
    xml
}

/// A CSV field (RFC 4180), harmless in spreadsheets.
fn quoted(field: &str) -> String {
    let field = field.replace(['\r', '\n'], " ");
    // Spreadsheets take these for formulas.
    let field = if field.starts_with(['=', '+', '-', '@']) { format!("'{field}") } else { field };
    if field.contains([',', '"', '\'']) { format!("\"{}\"", field.replace('"', "\"\"")) } else { field }
}
