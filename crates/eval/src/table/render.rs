//! Tables as text.

use super::{Comparison, Table, TableFormat};
use crate::surface::quoted;

impl Table {
    /// The table in a format; missing cells are empty.
    pub fn render(&self, format: TableFormat) -> String {
        match format {
            TableFormat::Text => self.text(),
            TableFormat::Csv => self.csv(),
            TableFormat::Markdown => self.markdown(),
            TableFormat::Latex => self.latex(),
            TableFormat::Html => self.html(),
        }
    }

    fn headings(&self) -> Vec<&str> {
        ["method", "input", "from"].into_iter().chain(self.columns.iter().map(|c| c.name.as_str())).collect()
    }

    /// Rows of cells, the best of each column marked by `mark`; words pass through `escape`.
    fn cells(&self, escape: fn(&str) -> String, mark: fn(&str) -> String) -> Vec<Vec<String>> {
        let mut rows: Vec<Vec<String>> =
            self.rows.iter().map(|r| vec![escape(&r.method), escape(&r.input), escape(&r.origin)]).collect();
        for (at, column) in self.columns.iter().enumerate() {
            let best = self.best(at);
            for (index, row) in self.rows.iter().enumerate() {
                let cell = row.values[at].map(|v| format!("{v:.*}", column.digits)).unwrap_or_default();
                rows[index].push(if best.contains(&index) { mark(&cell) } else { cell });
            }
        }
        rows
    }

    fn text(&self) -> String {
        let mut rows = vec![self.headings().into_iter().map(str::to_owned).collect::<Vec<_>>()];
        rows.extend(self.cells(str::to_owned, |cell| format!("{cell}*")));
        let width = |at: usize| rows.iter().map(|r| r[at].trim_end_matches('*').chars().count()).max().unwrap_or(0);
        let widths: Vec<usize> = (0..rows[0].len()).map(width).collect();
        let mut text = format!("{} (* best)\n", self.title);
        for row in &rows {
            for (at, (cell, width)) in row.iter().zip(&widths).enumerate() {
                // Words to the left; numbers to the right, with a place for the mark.
                let (cell, marked) = match cell.strip_suffix('*') {
                    Some(number) => (number, "*"),
                    None => (cell.as_str(), " "),
                };
                text += &if at < 3 { format!("{cell:width$}  ") } else { format!("{cell:>width$}{marked} ") };
            }
            text.truncate(text.trim_end().len());
            text.push('\n');
        }
        text
    }

    fn csv(&self) -> String {
        let line = |cells: Vec<String>| cells.iter().map(|c| quoted(c)).collect::<Vec<_>>().join(",") + "\n";
        // What scaling to per cent adds behind the tenth digit is no part of the number.
        let number = |v: f64| ((v * 1e10).round() / 1e10).to_string();
        let mut csv = line(self.headings().into_iter().map(str::to_owned).collect());
        for row in &self.rows {
            let numbers = row.values.iter().map(|v| v.map(number).unwrap_or_default());
            let words = [&row.method, &row.input, &row.origin].into_iter().cloned();
            csv += &line(words.chain(numbers).collect());
        }
        csv
    }

    fn markdown(&self) -> String {
        let escape: fn(&str) -> String = |text| text.replace('|', "\\|");
        let mut text =
            format!("| {} |\n|---|---|---|{}\n", self.headings().join(" | "), "---:|".repeat(self.columns.len()));
        for row in self.cells(escape, |cell| format!("**{cell}**")) {
            text += &format!("| {} |\n", row.join(" | "));
        }
        text
    }

    fn latex(&self) -> String {
        let headings: Vec<String> = self.headings().into_iter().map(escape_latex).collect();
        let mut text = format!("\\begin{{tabular}}{{lll{}}}\n\\toprule\n", "r".repeat(self.columns.len()));
        text += &format!("{} \\\\\n\\midrule\n", headings.join(" & "));
        for row in self.cells(escape_latex, |cell| format!("\\textbf{{{cell}}}")) {
            text += &format!("{} \\\\\n", row.join(" & "));
        }
        text + "\\bottomrule\n\\end{tabular}\n"
    }

    fn html(&self) -> String {
        let mut text = format!("<table>\n<caption>{}</caption>\n<thead><tr>", escape_html(&self.title));
        for heading in self.headings() {
            text += &format!("<th>{}</th>", escape_html(heading));
        }
        text += "</tr></thead>\n<tbody>\n";
        for row in self.cells(escape_html, |cell| format!("<strong>{cell}</strong>")) {
            text += "<tr>";
            for (at, cell) in row.iter().enumerate() {
                text += if at < 3 { "<td>" } else { "<td style=\"text-align:right\">" };
                text += &format!("{cell}</td>");
            }
            text += "</tr>\n";
        }
        text + "</tbody>\n</table>\n"
    }
}

fn escape_latex(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => out.extend(['\\', c]),
            '\\' => out += "\\textbackslash{}",
            '^' => out += "\\^{}",
            '~' => out += "\\~{}",
            _ => out.push(c),
        }
    }
    out
}

fn escape_html(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

impl Comparison {
    /// The table with what should be known about it: below it for people, as comments in LaTeX. CSV holds the table
    /// alone.
    pub fn render(&self, format: TableFormat) -> String {
        let table = self.rows.render(format);
        let sentences = self.sentences();
        let lines = |before: &str, after: &str, escape: fn(&str) -> String| {
            sentences.iter().map(|s| format!("{before}{}{after}\n", escape(s))).collect::<String>()
        };
        match format {
            TableFormat::Csv => table,
            TableFormat::Text => table + &lines("  ", "", str::to_owned),
            TableFormat::Markdown => format!("### {}\n\n{table}\n{}", self.rows.title, lines("- ", "", str::to_owned)),
            TableFormat::Latex => format!("% {}\n{table}{}", self.rows.title, lines("% ", "", str::to_owned)),
            TableFormat::Html => format!("{table}<ul>\n{}</ul>\n", lines("<li>", "</li>", escape_html)),
        }
    }

    /// What should be known about the table, one sentence each.
    pub fn sentences(&self) -> Vec<String> {
        let impossible =
            self.impossible.iter().map(|i| format!("impossible: {}, {}: {}", i.method, i.column, i.reason));
        let differences = self.differences.iter().map(super::Difference::sentence);
        let source = self.source.map(|source| format!("published rows: {source}"));
        impossible.chain(self.notes.iter().cloned()).chain(differences).chain(source).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Better, Column, Row};

    fn table() -> Table {
        let column = |name: &str, better| Column { name: name.to_owned(), better, digits: 1 };
        let row = |method: &str, values: [Option<f64>; 2]| Row {
            method: method.to_owned(),
            input: String::new(),
            origin: "us, here".to_owned(),
            values: values.to_vec(),
        };
        Table {
            title: "T".to_owned(),
            columns: vec![column("up %", Better::Higher), column("down", Better::Lower)],
            rows: vec![
                row("a_b", [Some(1.04), Some(2.0)]),
                row("c<d", [Some(1.01), None]),
                row("e", [None, Some(12.5)]),
            ],
        }
    }

    #[test]
    fn the_best_is_marked_and_the_missing_is_empty() {
        let table = table();
        // Equal as printed: both are best.
        assert_eq!(table.best(0), [0, 1]);
        assert_eq!(table.best(1), [0]);
        let markdown = table.render(TableFormat::Markdown);
        assert!(markdown.contains("| a_b |  | us, here | **1.0** | **2.0** |"), "{markdown}");
        assert!(markdown.contains("| c<d |  | us, here | **1.0** |  |"), "{markdown}");
        assert_eq!(table.render(TableFormat::Csv).lines().nth(2), Some("c<d,,\"us, here\",1.01,"));
        let mut scaled = table.clone();
        scaled.rows[0].values[0] = Some(99.77250000000001);
        assert_eq!(scaled.render(TableFormat::Csv).lines().nth(1), Some("a_b,,\"us, here\",99.7725,2"));
        assert!(table.render(TableFormat::Latex).contains("a\\_b &  & us, here & \\textbf{1.0} & \\textbf{2.0} \\\\"));
        assert!(table.render(TableFormat::Latex).contains("up \\%"));
        assert!(table.render(TableFormat::Html).contains("<td>c&lt;d</td>"));
        let text = table.render(TableFormat::Text);
        assert_eq!(text.lines().nth(2), Some("a_b            us, here   1.0*  2.0*"), "{text}");
        assert_eq!(text.lines().nth(4), Some("e              us, here        12.5"), "{text}");
    }
}
