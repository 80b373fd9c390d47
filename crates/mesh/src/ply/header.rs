//! PLY headers.

use std::path::Path;

use mb_job::InputError;

/// How the elements after the header are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// A number type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Bytes in a binary file.
    pub(super) fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    pub(super) fn is_float(self) -> bool {
        matches!(self, Self::F32 | Self::F64)
    }
}

/// One value, or a list of them, of every item of an element.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Property {
    pub(super) name: String,
    /// Type of a list's length, where it is a list.
    pub(super) count: Option<Scalar>,
    pub(super) value: Scalar,
}

/// A table of the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) count: u64,
    pub(super) properties: Vec<Property>,
}

impl Element {
    pub(super) fn property(&self, names: &[&str]) -> Option<usize> {
        self.properties.iter().position(|p| names.contains(&p.name.as_str()))
    }

    /// Fewest bytes that one item takes: what bounds the memory that a header may ask for.
    pub(super) fn least_size(&self, encoding: Encoding) -> usize {
        match encoding {
            // A digit and a blank or line end.
            Encoding::Ascii => (2 * self.properties.len()).max(1),
            _ => self.properties.iter().map(|p| p.count.unwrap_or(p.value).size()).sum(),
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Header {
    pub(super) encoding: Encoding,
    pub(super) elements: Vec<Element>,
    /// Bytes up to and with the line end after `end_header`.
    pub(super) length: usize,
    /// Lines of the header.
    pub(super) lines: usize,
}

/// Longer headers are refused: nobody writes them.
const MAX_LENGTH: usize = 1 << 20;

pub(super) fn parse(path: &Path, bytes: &[u8]) -> Result<Header, InputError> {
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    let mut length = 0;
    let mut number = 0;
    loop {
        number += 1;
        let bad = |found: String| InputError::new(path, found).at_line(number);
        let rest = &bytes[length..bytes.len().min(MAX_LENGTH)];
        let Some(end) = rest.iter().position(|&b| b == b'\n') else {
            return Err(bad("the header has no end_header line; the file is truncated or no PLY file".to_owned()));
        };
        let line = String::from_utf8_lossy(&rest[..end]);
        length += end + 1;
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words.as_slice() {
            ["ply"] if number == 1 => {}
            _ if number == 1 => return Err(bad("the first line is not \"ply\"".to_owned())),
            [] | ["comment" | "obj_info", ..] => {}
            ["format", name, _version] => {
                encoding = Some(match *name {
                    "ascii" => Encoding::Ascii,
                    "binary_little_endian" => Encoding::LittleEndian,
                    "binary_big_endian" => Encoding::BigEndian,
                    other => return Err(bad(format!("unknown format {other:?}"))),
                });
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| bad(format!("the number of {name} elements is {count:?}")))?;
                elements.push(Element { name: (*name).to_owned(), count, properties: Vec::new() });
            }
            ["property", types @ .., name] => {
                let scalar =
                    |word: &str| Scalar::parse(word).ok_or_else(|| bad(format!("unknown property type {word:?}")));
                let (count, value) = match types {
                    [value] => (None, scalar(value)?),
                    ["list", count, value] => (Some(scalar(count)?), scalar(value)?),
                    _ => return Err(bad(format!("{line:?} is no property"))),
                };
                if count.is_some_and(Scalar::is_float) {
                    return Err(bad(format!("the length of list {name} is not an integer type")));
                }
                let Some(element) = elements.last_mut() else {
                    return Err(bad("a property before any element".to_owned()));
                };
                element.properties.push(Property { name: (*name).to_owned(), count, value });
            }
            ["end_header"] => break,
            _ => return Err(bad(format!("{:?} is no line of a PLY header", line.trim_end()))),
        }
    }
    let Some(encoding) = encoding else {
        return Err(InputError::new(path, "the header has no format line"));
    };
    Ok(Header { encoding, elements, length, lines: number })
}
