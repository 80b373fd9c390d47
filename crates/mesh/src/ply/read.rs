//! Reading PLY files.

use std::path::Path;

use mb_job::{InputError, Result};
use nalgebra::Point3;

use super::header::{self, Element, Encoding, Header, Property};
use super::values::{Bad, Values};
use crate::TriangleMesh;
use crate::files::{Builder, Dropped};

/// Reads the mesh in the bytes of a PLY file.
pub(crate) fn parse(path: &Path, bytes: &[u8]) -> Result<(TriangleMesh, Dropped)> {
    let header = header::parse(path, bytes)?;
    let mut values = Values::new(&bytes[header.length..], header.encoding);
    let reader = Reader { path, header: &header };
    let mut builder = Builder::new(path);
    for element in &header.elements {
        let needed = (element.least_size(header.encoding) as u64).saturating_mul(element.count);
        // A text file's last value needs no blank after it.
        if needed > values.remaining() as u64 + 1 {
            return Err(InputError::new(path, format!(
                "the header declares {} items, at least {needed} bytes, but {} bytes are left; the file is truncated or its header is wrong",
                element.count, values.remaining()
            ))
            .at(format!("element {}", element.name))
            .help("Export or copy the file again")
            .into());
        }
        // Never more items than bytes, whatever the header says.
        let items = element.count.min(values.remaining() as u64) as usize;
        match element.name.as_str() {
            "vertex" => builder.reserve(items, 0),
            "face" => builder.reserve(0, items),
            _ => {}
        }
        match element.name.as_str() {
            "vertex" => reader.vertices(element, &mut values, &mut builder)?,
            "face" => reader.faces(element, &mut values, &mut builder)?,
            _ => reader.skip(element, &mut values)?,
        }
    }
    builder.finish()
}

struct Reader<'a> {
    path: &'a Path,
    header: &'a Header,
}

/// Where a vertex's or face's colour stands, and the factor from the file's numbers to 0..=255.
struct ColorColumns {
    columns: [usize; 3],
    scale: f64,
}

impl ColorColumns {
    fn find(element: &Element) -> Option<Self> {
        const NAMES: [[&str; 3]; 3] =
            [["red", "r", "diffuse_red"], ["green", "g", "diffuse_green"], ["blue", "b", "diffuse_blue"]];
        let mut columns = [0; 3];
        for (column, names) in columns.iter_mut().zip(&NAMES) {
            *column = element.property(names)?;
        }
        let property = &element.properties[columns[0]];
        let scale = match property.value.size() {
            _ if property.value.is_float() => 255.0,
            1 => 1.0,
            _ => 1.0 / 257.0,
        };
        element
            .properties
            .iter()
            .all(|p| p.count.is_none() || !NAMES.as_flattened().contains(&p.name.as_str()))
            .then_some(Self { columns, scale })
    }

    fn color(&self, row: &[f64]) -> [u8; 3] {
        self.columns.map(|c| (row[c] * self.scale).round().clamp(0.0, 255.0) as u8)
    }
}

impl Reader<'_> {
    fn vertices(&self, element: &Element, values: &mut Values, builder: &mut Builder) -> Result<()> {
        let axis = |name: &str| {
            let column = element.property(&[name]).filter(|&c| element.properties[c].count.is_none());
            column.ok_or_else(|| {
                InputError::new(self.path, format!("the vertices have no property {name}")).at("element vertex")
            })
        };
        let position = [axis("x")?, axis("y")?, axis("z")?];
        let colors = ColorColumns::find(element);
        let mut row = vec![0.0; element.properties.len()];
        for index in 0..element.count {
            for (property, value) in element.properties.iter().zip(&mut row) {
                *value = self
                    .value(property, values)
                    .map_err(|bad| self.bad(element, index, &property.name, &bad, values))?;
            }
            builder.vertex(Point3::from(position.map(|c| row[c])), colors.as_ref().map(|c| c.color(&row)));
        }
        Ok(())
    }

    fn faces(&self, element: &Element, values: &mut Values, builder: &mut Builder) -> Result<()> {
        let Some(corners_at) = element.property(&["vertex_indices", "vertex_index"]) else {
            let found = "the faces have no property vertex_indices";
            return Err(InputError::new(self.path, found).at("element face").into());
        };
        let Some(count_type) = element.properties[corners_at].count else {
            return Err(InputError::new(self.path, "vertex_indices is not a list").at("element face").into());
        };
        let colors = ColorColumns::find(element);
        let part_at = element.property(&["part"]).filter(|&c| element.properties[c].count.is_none());
        let mut row = vec![0.0; element.properties.len()];
        let mut corners: Vec<f64> = Vec::new();
        for index in 0..element.count {
            for (column, property) in element.properties.iter().enumerate() {
                let read = if column == corners_at {
                    self.list(count_type, property, values, &mut corners)
                } else {
                    self.value(property, values).map(|value| row[column] = value)
                };
                read.map_err(|bad| self.bad(element, index, &property.name, &bad, values))?;
            }
            let part = part_at.map(|c| row[c] as u32);
            builder
                .face(&corners, colors.as_ref().map(|c| c.color(&row)), part)
                .map_err(|found| InputError::new(self.path, found).at(self.place(element, index, values)))?;
        }
        Ok(())
    }

    fn skip(&self, element: &Element, values: &mut Values) -> Result<()> {
        for index in 0..element.count {
            for property in &element.properties {
                self.value(property, values).map_err(|bad| self.bad(element, index, &property.name, &bad, values))?;
            }
            // Items without properties take no bytes: nothing is left to read, however many are declared.
            if element.properties.is_empty() {
                break;
            }
        }
        Ok(())
    }

    /// A single value; a list is passed over and counts as 0.
    fn value(&self, property: &Property, values: &mut Values) -> Result<f64, Bad> {
        match property.count {
            None => values.number(property.value),
            Some(count_type) => {
                let count = length(values.number(count_type)?)?;
                values.skip(property.value, count)?;
                Ok(0.0)
            }
        }
    }

    fn list(
        &self,
        count_type: header::Scalar,
        property: &Property,
        values: &mut Values,
        list: &mut Vec<f64>,
    ) -> Result<(), Bad> {
        list.clear();
        let count = length(values.number(count_type)?)?;
        for _ in 0..count {
            list.push(values.number(property.value)?);
        }
        Ok(())
    }

    fn place(&self, element: &Element, index: u64, values: &Values) -> String {
        let item = format!("{} {index}", element.name);
        match self.header.encoding {
            Encoding::Ascii => format!("line {}, {item}", self.header.lines + values.line() + 1),
            _ => item,
        }
    }

    fn bad(&self, element: &Element, index: u64, property: &str, bad: &Bad, values: &Values) -> InputError {
        let found = match bad {
            Bad::End => format!("the file ends before its property {property}; {} items are declared", element.count),
            Bad::Word(word) => format!("property {property} is {word:?}"),
        };
        InputError::new(self.path, found).at(self.place(element, index, values))
    }
}

fn length(count: f64) -> Result<usize, Bad> {
    if count >= 0.0 { Ok(count as usize) } else { Err(Bad::Word(format!("a list of {count} items"))) }
}
