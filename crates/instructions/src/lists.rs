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
}

/// What the lists cannot say for certain.
pub fn list_notes(model: &Model, plan: &Plan) -> ListNotes {
    let mut notes = ListNotes::default();
    for ((part, color), _) in plan.totals() {
        let name = &model.file(part).name;
        if color_id(color).is_none() {
            notes.unmapped_colors.push(format!("{color} {}", model.colors().look(color).name));
        }
        if !item_id(name).1 {
            notes.uncertain_parts.push(name.clone());
        }
    }
    for list in [&mut notes.unmapped_colors, &mut notes.uncertain_parts] {
        list.sort();
        list.dedup();
    }
    notes
}

/// `quantity,part,description,ldraw_color,color,bricklink_item,bricklink_color,note`: a line for each part and colour.
pub fn shopping_list(model: &Model, plan: &Plan) -> String {
    let mut csv = "quantity,part,description,ldraw_color,color,bricklink_item,bricklink_color,note\r\n".to_owned();
    for ((part, color), count) in plan.totals() {
        let file = model.file(part);
        let (item, sure) = item_id(&file.name);
        let id = color_id(color).map(|id| id.to_string()).unwrap_or_default();
        let fields = [
            count.to_string(),
            file.name.clone(),
            file.description.split_whitespace().collect::<Vec<_>>().join(" "),
            color.to_string(),
            model.colors().look(color).name,
            if sure { item } else { String::new() },
            id,
            note(sure, color),
        ];
        let _ = write!(csv, "{}\r\n", fields.map(|field| quoted(&field)).join(","));
    }
    csv
}

/// The XML that BrickLink's page for uploading wanted lists takes. It allows no XML declaration.
pub fn wanted_list(model: &Model, plan: &Plan) -> String {
    let mut xml = "<INVENTORY>\n".to_owned();
    for ((part, color), count) in plan.totals() {
        let (item, sure) = item_id(&model.file(part).name);
        xml.push_str("  <ITEM>\n    <ITEMTYPE>P</ITEMTYPE>\n");
        let _ = writeln!(xml, "    <ITEMID>{}</ITEMID>", escaped(&item));
        if let Some(id) = color_id(color) {
            let _ = writeln!(xml, "    <COLOR>{id}</COLOR>");
        }
        let _ = writeln!(xml, "    <MINQTY>{count}</MINQTY>");
        let mut remark = note(sure, color);
        if color_id(color).is_none() {
            let _ = write!(remark, " ({})", model.colors().look(color).name);
        }
        if !remark.is_empty() {
            let _ = writeln!(xml, "    <REMARKS>{}</REMARKS>", escaped(remark.trim()));
        }
        xml.push_str("  </ITEM>\n");
    }
    xml.push_str("</INVENTORY>\n");
    xml
}

fn note(sure: bool, color: ColorCode) -> String {
    let mut notes = vec![];
    if !sure {
        notes.push("LDraw's part number: look it up".to_owned());
    }
    if color_id(color).is_none() {
        notes.push(format!("LDraw colour {color}: choose one"));
    }
    notes.join("; ")
}

/// A CSV field (RFC 4180), harmless in spreadsheets.
fn quoted(field: &str) -> String {
    let field = field.replace(['\r', '\n'], " ");
    // Spreadsheets take these for formulas.
    let field = if field.starts_with(['=', '+', '-', '@']) { format!("'{field}") } else { field };
    if field.contains([',', '"', '\'']) { format!("\"{}\"", field.replace('"', "\"\"")) } else { field }
}
