//! Rows that cannot be true.

use serde::Serialize;

use super::Table;

/// A row whose numbers contradict each other.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ImpossibleRow {
    /// The method.
    pub method: String,
    /// The column.
    pub column: String,
    /// The printed value.
    pub value: f64,
    /// The most that it can be.
    pub bound: f64,
    /// Why, as a sentence.
    pub reason: String,
}

/// Finds impossible rows of a table with columns `acc T`, `rec T` and `F1 T` that hold means over sequences.
///
/// F1 = 2 a r / (a + r) is concave in (a, r), so by Jensen's inequality the mean of the sequences' F1 is at most the F1
/// of the mean accuracy and the mean recall. Printed numbers are rounded: half a unit of the last digit is granted to
/// each. A share above 100 % or below 0 is impossible too.
pub fn lint(table: &Table) -> Vec<ImpossibleRow> {
    let mut found = Vec::new();
    let of = |name: &str| table.columns.iter().position(|c| c.name == name);
    for (f1_at, column) in table.columns.iter().enumerate() {
        let Some(threshold) = column.name.strip_prefix("F1 ") else { continue };
        let (Some(accuracy_at), Some(recall_at)) = (of(&format!("acc {threshold}")), of(&format!("rec {threshold}")))
        else {
            continue;
        };
        let digits = column.digits;
        let half = 0.5 * 0.1f64.powi(digits as i32);
        for row in &table.rows {
            let (Some(accuracy), Some(recall), Some(value)) =
                (row.values[accuracy_at], row.values[recall_at], row.values[f1_at])
            else {
                continue;
            };
            let bound = 100.0 * crate::surface::f1((accuracy + half) / 100.0, (recall + half) / 100.0);
            if value - half > bound {
                found.push(ImpossibleRow {
                    method: row.method.clone(),
                    column: column.name.clone(),
                    value,
                    bound,
                    reason: format!(
                        "the mean of F1 over sequences cannot exceed the F1 of the means: {value:.digits$} > {bound:.2} \
                         for accuracy {accuracy:.digits$} and recall {recall:.digits$}"
                    ),
                });
            }
        }
    }
    for (at, column) in table.columns.iter().enumerate().filter(|(_, c)| c.name.ends_with('%')) {
        for row in &table.rows {
            if let Some(value) = row.values[at].filter(|v| !(0.0..=100.0).contains(v)) {
                found.push(ImpossibleRow {
                    method: row.method.clone(),
                    column: column.name.clone(),
                    value,
                    bound: 100.0,
                    reason: format!("a share of {value} % is none"),
                });
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::PaperTable;

    #[test]
    fn exactly_one_published_row_is_impossible() {
        let found: Vec<_> = PaperTable::ALL.iter().flat_map(|t| lint(&t.published())).collect();
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!((found[0].method.as_str(), found[0].value), ("BNV-Fusion", 33.27));
        assert!((found[0].bound - 32.02).abs() < 0.01, "{}", found[0].bound);
    }

    #[test]
    fn the_sentence_has_the_digits_of_the_table() {
        let mut table = PaperTable::Surfaces.published();
        table.rows.truncate(1);
        table.rows[0].values[..3].copy_from_slice(&[Some(100.0), Some(50.800999999999995), Some(95.0)]);
        let reason = &lint(&table)[0].reason;
        assert!(reason.ends_with("95.00 > 67.38 for accuracy 100.00 and recall 50.80"), "{reason}");
    }

    #[test]
    fn a_share_above_all_is_found() {
        let mut table = PaperTable::Poses.published();
        table.rows[0].values[2] = Some(901.0);
        assert_eq!(lint(&table)[0].reason, "a share of 901 % is none");
    }
}
