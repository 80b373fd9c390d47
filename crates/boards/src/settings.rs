//! Files of keys and values: JSON, and the flat YAML that OpenCV writes.

use std::path::Path;

use mb_job::{InputError, Result};
use serde_json::{Map, Value};

/// Larger files are no board and no dictionary.
const MAX_BYTES: u64 = 16 << 20;

/// Reads a JSON object, or YAML of the form `key: value` a line (numbers, true and false, "texts", `[1, 2]`). OpenCV's
/// first line `%YAML:1.0`, comments and `---` are passed over.
pub(crate) fn read(path: &Path) -> Result<Map<String, Value>> {
    let unreadable = |e: std::io::Error| InputError::unreadable(path, &e);
    if std::fs::metadata(path).map_err(unreadable)?.len() > MAX_BYTES {
        return Err(InputError::new(path, "larger than 16 MiB, which no board needs").into());
    }
    let text = std::fs::read_to_string(path).map_err(unreadable)?;
    if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) {
        return Ok(serde_json::from_str(&text).map_err(|e| InputError::new(path, e.to_string()))?);
    }
    let mut map = Map::new();
    for (i, line) in text.lines().enumerate() {
        let line = line.trim_end();
        if line.is_empty() || line.starts_with(['%', '#']) || line == "---" || line == "..." {
            continue;
        }
        let pair = line.split_once(':').map(|(key, value)| (key.trim_matches('"'), value.trim()));
        let Some((key, value)) = pair.filter(|(key, _)| !key.starts_with([' ', '-', '\t']) && !key.is_empty()) else {
            let found = format!("'{}' is not 'key: value'", line.trim());
            return Err(InputError::new(path, found)
                .at_line(i + 1)
                .help("A board or dictionary in YAML has one key and value a line, nothing nested")
                .into());
        };
        let value = serde_json::from_str(value).unwrap_or_else(|_| Value::String(value.trim_matches('\'').to_owned()));
        map.insert(key.to_owned(), value);
    }
    Ok(map)
}
