//! JSON of other programs: what is there, with errors that name the key.

use std::path::Path;

use mb_job::{InputError, Result};
use nalgebra::{DMatrix, Matrix4};
use serde_json::Value;

/// Reads a JSON file; errors name line and column.
pub(super) fn read(path: &Path) -> Result<Value> {
    crate::sequence::read_json(path)
}

/// A number, where the key is there.
pub(super) fn number(value: &Value, key: &str) -> Option<f64> {
    value.get(key).and_then(Value::as_f64)
}

/// An array of exactly `count` numbers.
pub(super) fn numbers(value: &Value, key: &str, count: usize, path: &Path) -> Result<Vec<f64>> {
    let bad = |found: String| InputError::new(path, found).at(format!("key '{key}'"));
    let list = value.get(key).and_then(Value::as_array).ok_or_else(|| bad("missing, or no array".to_owned()))?;
    let found: Option<Vec<f64>> = list.iter().map(Value::as_f64).collect();
    match found {
        Some(found) if found.len() == count => Ok(found),
        Some(found) => Err(bad(format!("{} numbers, expected {count}", found.len())).into()),
        None => Err(bad("holds something that is no number".to_owned()).into()),
    }
}

/// A 4x4 (or 3x4) matrix as an array of rows.
pub(super) fn matrix4(value: &Value) -> Option<Matrix4<f64>> {
    let rows: Option<Vec<Vec<f64>>> = value
        .as_array()?
        .iter()
        .map(|row| row.as_array().and_then(|row| row.iter().map(Value::as_f64).collect()))
        .collect();
    let mut rows = rows?;
    if rows.len() == 3 {
        rows.push(vec![0.0, 0.0, 0.0, 1.0]);
    }
    if rows.len() != 4 || rows.iter().any(|row| row.len() != 4) {
        return None;
    }
    let flat: Vec<f64> = rows.concat();
    Some(DMatrix::from_row_slice(4, 4, &flat).fixed_view::<4, 4>(0, 0).into())
}
