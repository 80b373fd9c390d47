//! The stack machine that runs a pickle's operations.

use std::collections::HashMap;

use super::{Array, Callable, Dtype, Id, StorageType, Tensor, Value};

/// The stack machine.
pub(super) struct Machine<'a> {
    bytes: &'a [u8],
    pub(super) at: usize,
    pub(super) values: Vec<Value>,
    stack: Vec<Id>,
    /// Heights of the stack at which a `MARK` was set.
    marks: Vec<usize>,
    memo: HashMap<u64, Id>,
}

type Step<T> = Result<T, String>;

impl<'a> Machine<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0, values: Vec::new(), stack: Vec::new(), marks: Vec::new(), memo: HashMap::new() }
    }

    /// One operation; the root at `STOP`.
    pub(super) fn step(&mut self) -> Step<Option<Id>> {
        match self.take(1)?[0] {
            // Framing carries no data.
            0x80 => _ = self.take(1)?,
            0x95 => _ = self.take(8)?,
            b'.' => return Ok(Some(self.pop()?)),

            b'(' => self.marks.push(self.stack.len()),
            b'0' => {
                if self.marks.last() == Some(&self.stack.len()) {
                    self.marks.pop();
                } else {
                    self.pop()?;
                }
            }
            b'1' => _ = self.pop_to_mark()?,
            b'2' => {
                let top = self.top()?;
                self.stack.push(top);
            }

            b'N' => self.push(Value::None),
            0x88 => self.push(Value::Bool(true)),
            0x89 => self.push(Value::Bool(false)),
            b'I' => {
                let value = match self.line()? {
                    "00" => Value::Bool(false),
                    "01" => Value::Bool(true),
                    digits => Value::Int(digits.parse().map_err(|_| format!("the integer {digits:?}"))?),
                };
                self.push(value);
            }
            b'J' => {
                let v = i32::from_le_bytes(self.array()?);
                self.push(Value::Int(v.into()));
            }
            b'K' => {
                let v = self.take(1)?[0];
                self.push(Value::Int(v.into()));
            }
            b'M' => {
                let v = u16::from_le_bytes(self.array()?);
                self.push(Value::Int(v.into()));
            }
            b'L' => {
                let line = self.line()?;
                let v = line.trim_end_matches('L').parse().map_err(|_| format!("the integer {line:?}"))?;
                self.push(Value::Int(v));
            }
            0x8a => {
                let length = self.length(1)?;
                self.long(length)?;
            }
            0x8b => {
                let length = self.length(4)?;
                self.long(length)?;
            }
            b'F' => {
                let line = self.line()?;
                let v = line.parse().map_err(|_| format!("the number {line:?}"))?;
                self.push(Value::Float(v));
            }
            b'G' => {
                let v = f64::from_be_bytes(self.array()?);
                self.push(Value::Float(v));
            }

            b'S' => {
                let line = self.line()?;
                let bytes = python2_string(line).ok_or("a badly quoted string")?;
                self.push(Value::Bytes(bytes));
            }
            b'V' => {
                let text = raw_unicode_escape(self.raw_line()?);
                self.push(Value::Text(text));
            }
            b'U' | b'C' => self.counted_bytes(1)?,
            b'T' | b'B' => self.counted_bytes(4)?,
            0x8e | 0x96 => self.counted_bytes(8)?,
            0x8c => self.counted_text(1)?,
            b'X' => self.counted_text(4)?,
            0x8d => self.counted_text(8)?,

            b')' | b']' => self.push(Value::Items(Vec::new())),
            b't' | b'l' => {
                let items = self.pop_to_mark()?;
                self.push(Value::Items(items));
            }
            0x85 => self.tuple(1)?,
            0x86 => self.tuple(2)?,
            0x87 => self.tuple(3)?,
            b'a' => {
                let item = self.pop()?;
                self.append(vec![item])?;
            }
            b'e' => {
                let items = self.pop_to_mark()?;
                self.append(items)?;
            }
            b'}' => self.push(Value::Dict(Vec::new())),
            b'd' => {
                let items = self.pop_to_mark()?;
                self.push(Value::Dict(Vec::new()));
                self.set_items(&items)?;
            }
            b's' => {
                let value = self.pop()?;
                let key = self.pop()?;
                self.set_items(&[key, value])?;
            }
            b'u' => {
                let items = self.pop_to_mark()?;
                self.set_items(&items)?;
            }

            b'p' => {
                let key = self.memo_key()?;
                self.memoize(key)?;
            }
            b'q' => {
                let key = self.length(1)? as u64;
                self.memoize(key)?;
            }
            b'r' => {
                let key = self.length(4)? as u64;
                self.memoize(key)?;
            }
            0x94 => self.memoize(self.memo.len() as u64)?,
            b'g' => {
                let key = self.memo_key()?;
                self.recall(key)?;
            }
            b'h' => {
                let key = self.length(1)? as u64;
                self.recall(key)?;
            }
            b'j' => {
                let key = self.length(4)? as u64;
                self.recall(key)?;
            }

            b'c' => {
                let module = self.line()?.to_owned();
                let name = self.line()?.to_owned();
                let callable = callable(&module, &name)?;
                self.push(Value::Callable(callable));
            }
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let callable = match (&self.values[module], &self.values[name]) {
                    (Value::Text(module), Value::Text(name)) => callable(module, name)?,
                    _ => return Err("a callable whose name is no text".to_owned()),
                };
                self.push(Value::Callable(callable));
            }
            b'R' => {
                let (arguments, callable) = (self.pop()?, self.pop()?);
                let value = self.call(callable, arguments)?;
                self.push(value);
            }
            b'b' => {
                let state = self.pop()?;
                self.build(state)?;
            }
            b'Q' => {
                let reference = self.pop()?;
                self.push(Value::Persistent(reference));
            }
            other => return Err(format!("operation 0x{other:02x}, which no array needs")),
        }
        Ok(None)
    }

    fn take(&mut self, count: usize) -> Step<&[u8]> {
        let rest = &self.bytes[self.at..];
        let taken = rest.get(..count).ok_or("the file ends too early; it is truncated")?;
        self.at += count;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Step<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    /// An unsigned little-endian number of `width` bytes.
    fn length(&mut self, width: usize) -> Step<usize> {
        let mut little = [0; 8];
        little[..width].copy_from_slice(self.take(width)?);
        usize::try_from(u64::from_le_bytes(little)).map_err(|_| "an impossible length".to_owned())
    }

    fn raw_line(&mut self) -> Step<&[u8]> {
        let rest = &self.bytes[self.at..];
        let end = rest.iter().position(|&b| b == b'\n').ok_or("the file ends too early; it is truncated")?;
        self.at += end + 1;
        Ok(&rest[..end])
    }

    fn line(&mut self) -> Step<&str> {
        let line = self.raw_line()?;
        std::str::from_utf8(line).map(str::trim_end).map_err(|_| "text that is not UTF-8".to_owned())
    }

    fn memo_key(&mut self) -> Step<u64> {
        self.line()?.parse().map_err(|_| "a malformed memo index".to_owned())
    }

    fn push(&mut self, value: Value) {
        self.stack.push(self.values.len());
        self.values.push(value);
    }

    fn top(&self) -> Step<Id> {
        // Operations may not reach below the last mark.
        let floor = self.marks.last().copied().unwrap_or(0);
        if self.stack.len() > floor { Ok(self.stack[self.stack.len() - 1]) } else { Err("an empty stack".to_owned()) }
    }

    fn pop(&mut self) -> Step<Id> {
        let top = self.top()?;
        self.stack.pop();
        Ok(top)
    }

    fn pop_to_mark(&mut self) -> Step<Vec<Id>> {
        let mark = self.marks.pop().ok_or("no mark")?;
        Ok(self.stack.split_off(mark))
    }

    fn tuple(&mut self, count: usize) -> Step<()> {
        let mut items = (0..count).map(|_| self.pop()).collect::<Step<Vec<Id>>>()?;
        items.reverse();
        self.push(Value::Items(items));
        Ok(())
    }

    fn append(&mut self, items: Vec<Id>) -> Step<()> {
        let top = self.top()?;
        let Value::Items(list) = &mut self.values[top] else { return Err("items without their list".to_owned()) };
        list.extend(items);
        Ok(())
    }

    fn set_items(&mut self, items: &[Id]) -> Step<()> {
        let top = self.top()?;
        let Value::Dict(dict) = &mut self.values[top] else {
            return Err("entries without their dictionary".to_owned());
        };
        if !items.len().is_multiple_of(2) {
            return Err("a key without a value".to_owned());
        }
        dict.extend(items.chunks_exact(2).map(|pair| (pair[0], pair[1])));
        Ok(())
    }

    fn memoize(&mut self, key: u64) -> Step<()> {
        let top = self.top()?;
        self.memo.insert(key, top);
        Ok(())
    }

    fn recall(&mut self, key: u64) -> Step<()> {
        let id = *self.memo.get(&key).ok_or("a memo index that was never set")?;
        self.stack.push(id);
        Ok(())
    }

    fn counted_bytes(&mut self, width: usize) -> Step<()> {
        let length = self.length(width)?;
        let bytes = self.take(length)?.to_vec();
        self.push(Value::Bytes(bytes));
        Ok(())
    }

    fn counted_text(&mut self, width: usize) -> Step<()> {
        let length = self.length(width)?;
        let text = std::str::from_utf8(self.take(length)?).map_err(|_| "text that is not UTF-8")?.to_owned();
        self.push(Value::Text(text));
        Ok(())
    }

    /// A two's complement integer of `length` bytes.
    fn long(&mut self, length: usize) -> Step<()> {
        let raw = self.take(length)?;
        if raw.len() > 8 {
            return Err("an integer of more than 64 bits".to_owned());
        }
        let negative = raw.last().is_some_and(|&b| b & 0x80 != 0);
        let mut little = [if negative { 0xff } else { 0 }; 8];
        little[..raw.len()].copy_from_slice(raw);
        self.push(Value::Int(i64::from_le_bytes(little)));
        Ok(())
    }

    fn call(&self, callable: Id, arguments: Id) -> Step<Value> {
        let Value::Callable(callable) = self.values[callable] else {
            return Err("a call of something else".to_owned());
        };
        let Value::Items(arguments) = &self.values[arguments] else {
            return Err("a call without arguments".to_owned());
        };
        let argument = |i: usize| arguments.get(i).map(|&id| &self.values[id]);
        let refused = || format!("a call of {callable:?} with unexpected arguments");
        match callable {
            Callable::Reconstruct => match argument(0) {
                Some(Value::Callable(Callable::NdArray)) => Ok(Value::Array(Array::default())),
                _ => Err(refused()),
            },
            Callable::Dtype => {
                let code = match argument(0) {
                    Some(Value::Text(code)) => code.as_str(),
                    Some(Value::Bytes(code)) => std::str::from_utf8(code).map_err(|_| refused())?,
                    _ => return Err(refused()),
                };
                let dtype = Dtype::parse(code).ok_or_else(|| format!("an array of type {code:?}"))?;
                Ok(Value::Dtype(dtype))
            }
            Callable::Scalar => match (argument(0), arguments.get(1)) {
                (Some(&Value::Dtype(dtype)), Some(&content)) => {
                    Ok(Value::Array(Array { dtype: Some(dtype), content: Some(content), ..Array::default() }))
                }
                _ => Err(refused()),
            },
            Callable::FromBuffer => match (arguments.first(), argument(1), argument(2), argument(3)) {
                (Some(&content), Some(&Value::Dtype(dtype)), Some(shape), Some(Value::Text(order))) => {
                    let (shape, dtype, content) = (self.shape(shape)?, Some(dtype), Some(content));
                    Ok(Value::Array(Array { shape, fortran_order: order == "F", dtype, content }))
                }
                _ => Err(refused()),
            },
            Callable::Encode => match (argument(0), argument(1)) {
                (Some(Value::Text(text)), Some(Value::Text(codec))) if codec == "latin1" => {
                    let bytes = text.chars().map(|c| u8::try_from(c).map_err(|_| refused())).collect::<Step<_>>()?;
                    Ok(Value::Bytes(bytes))
                }
                _ => Err(refused()),
            },
            Callable::EmptyBytes if arguments.is_empty() => Ok(Value::Bytes(Vec::new())),
            Callable::OrderedDict if arguments.is_empty() => Ok(Value::Dict(Vec::new())),
            Callable::RebuildTensor => match (arguments.first(), argument(1), argument(2), argument(3)) {
                (Some(&storage), Some(&Value::Int(offset)), Some(shape), Some(stride))
                    if matches!(self.values[storage], Value::Persistent(_)) =>
                {
                    let offset = usize::try_from(offset).map_err(|_| refused())?;
                    let (shape, stride) = (self.shape(shape)?, self.shape(stride)?);
                    Ok(Value::Tensor(Tensor { storage, offset, shape, stride }))
                }
                _ => Err(refused()),
            },
            Callable::RebuildParameter => match argument(0) {
                Some(Value::Tensor(tensor)) => Ok(Value::Tensor(tensor.clone())),
                _ => Err(refused()),
            },
            Callable::EmptyBytes | Callable::NdArray | Callable::OrderedDict | Callable::Storage(_) => Err(refused()),
        }
    }

    fn shape(&self, value: &Value) -> Step<Vec<usize>> {
        let Value::Items(dimensions) = value else { return Err("an array without a shape".to_owned()) };
        let dimension = |&id: &Id| match self.values[id] {
            Value::Int(d) => usize::try_from(d).map_err(|_| format!("an array {d} elements wide")),
            _ => Err("a shape that is not made of integers".to_owned()),
        };
        dimensions.iter().map(dimension).collect()
    }

    /// Gives the value on top of the stack its state.
    fn build(&mut self, state: Id) -> Step<()> {
        let top = self.top()?;
        // torch hangs version numbers on the dictionary of a module's weights; they are of no use here.
        if matches!((&self.values[top], &self.values[state]), (Value::Dict(_), Value::Dict(_))) {
            return Ok(());
        }
        let Value::Items(state) = &self.values[state] else { return Err("a state that is no tuple".to_owned()) };
        match &self.values[top] {
            // (version, byte order, ...)
            Value::Dtype(dtype) => {
                let big_endian = match state.get(1).map(|&id| &self.values[id]) {
                    Some(Value::Text(order)) => order == ">",
                    Some(Value::Bytes(order)) => order == b">",
                    _ => return Err("a type without byte order".to_owned()),
                };
                self.values[top] = Value::Dtype(Dtype { big_endian, ..*dtype });
            }
            // (version, shape, dtype, fortran order, content)
            Value::Array(_) => {
                let &[_, shape, dtype, fortran_order, content] = state.as_slice() else {
                    return Err("an array whose state does not have five entries".to_owned());
                };
                let shape = self.shape(&self.values[shape])?;
                let (Value::Dtype(dtype), fortran_order) = (&self.values[dtype], &self.values[fortran_order]) else {
                    return Err("an array without a type".to_owned());
                };
                let fortran_order = matches!(fortran_order, Value::Bool(true) | Value::Int(1));
                self.values[top] =
                    Value::Array(Array { shape, fortran_order, dtype: Some(*dtype), content: Some(content) });
            }
            _ => return Err("a state for something that has none".to_owned()),
        }
        Ok(())
    }
}

/// The callables that numpy's arrays need, under the module names of numpy 1 and 2 and of Python 2 and 3.
fn callable(module: &str, name: &str) -> Step<Callable> {
    Ok(match (module, name) {
        ("numpy.core.multiarray" | "numpy._core.multiarray", "_reconstruct") => Callable::Reconstruct,
        ("numpy.core.multiarray" | "numpy._core.multiarray", "scalar") => Callable::Scalar,
        ("numpy.core.numeric" | "numpy._core.numeric", "_frombuffer") => Callable::FromBuffer,
        ("numpy", "dtype") => Callable::Dtype,
        ("numpy", "ndarray") => Callable::NdArray,
        ("_codecs", "encode") => Callable::Encode,
        ("builtins" | "__builtin__", "bytes") => Callable::EmptyBytes,
        ("collections", "OrderedDict") => Callable::OrderedDict,
        ("torch._utils", "_rebuild_tensor" | "_rebuild_tensor_v2") => Callable::RebuildTensor,
        ("torch._utils", "_rebuild_parameter") => Callable::RebuildParameter,
        ("torch", name) if name.ends_with("Storage") => Callable::Storage(match name {
            "HalfStorage" => StorageType::F16,
            "BFloat16Storage" => StorageType::BF16,
            "FloatStorage" => StorageType::F32,
            "DoubleStorage" => StorageType::F64,
            _ => StorageType::Other,
        }),
        _ => return Err(format!("a call of {module}.{name}, which is never made")),
    })
}

/// The bytes of a quoted Python 2 string.
fn python2_string(quoted: &str) -> Option<Vec<u8>> {
    let quote = quoted.chars().next().filter(|q| matches!(q, '\'' | '"'))?;
    let mut rest = quoted.strip_prefix(quote)?.strip_suffix(quote)?.chars();
    let mut bytes = Vec::new();
    while let Some(c) = rest.next() {
        let byte = match c {
            '\\' => match rest.next()? {
                'n' => b'\n',
                'r' => b'\r',
                't' => b'\t',
                'x' => {
                    let (high, low) = (rest.next()?.to_digit(16)?, rest.next()?.to_digit(16)?);
                    (high * 16 + low) as u8
                }
                other => u8::try_from(other).ok()?,
            },
            other => u8::try_from(other).ok()?,
        };
        bytes.push(byte);
    }
    Some(bytes)
}

/// Latin-1 with `\uXXXX` for everything else, and for the backslash and line ends.
fn raw_unicode_escape(line: &[u8]) -> String {
    let mut text = String::with_capacity(line.len());
    let mut at = 0;
    while at < line.len() {
        let escape = (line[at] == b'\\' && line.get(at + 1) == Some(&b'u'))
            .then(|| line.get(at + 2..at + 6))
            .flatten()
            .and_then(|hex| std::str::from_utf8(hex).ok())
            .and_then(|hex| u32::from_str_radix(hex, 16).ok())
            .and_then(char::from_u32);
        match escape {
            Some(c) => {
                text.push(c);
                at += 6;
            }
            None => {
                text.push(char::from(line[at]));
                at += 1;
            }
        }
    }
    text
}
