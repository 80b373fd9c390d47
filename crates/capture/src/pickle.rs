//! A reader of pickles that hold numbers, text, numpy arrays and torch tensors, and nothing else.
//!
//! A pickle is a program for a small stack machine, and Python's own reader lets it call any function. This one knows
//! the callables with which numpy writes arrays, dtypes and scalars and torch writes tensors, builds plain data from
//! them, and refuses everything else. Protocols 0 to 5 (Python's `Lib/pickletools.py` documents the operations).
//!
//! Values live in one arena and refer to each other by index: sharing costs nothing, hostile nesting cannot overflow the
//! stack, and memory is bounded by `MAX_OPERATIONS` and the size of the input.

mod machine;

use machine::Machine;

/// A real mask takes about 200 operations.
const MAX_OPERATIONS: usize = 1 << 20;

/// Index of a value in `Pickle::values`.
pub type Id = usize;

/// What a pickle can hold here.
#[derive(Debug, Clone)]
pub enum Value {
    /// `None`.
    None,
    /// A truth value.
    Bool(bool),
    /// An integer of up to 64 bits.
    Int(i64),
    /// A number.
    Float(f64),
    /// A `str`.
    Text(String),
    /// A `bytes`, or a `str` of Python 2.
    Bytes(Vec<u8>),
    /// Lists and tuples.
    Items(Vec<Id>),
    /// Keys and values, in the order of insertion.
    Dict(Vec<(Id, Id)>),
    /// A function or class that was named, not called.
    Callable(Callable),
    /// A numpy element type.
    Dtype(Dtype),
    /// A numpy array or scalar.
    Array(Array),
    /// A torch tensor.
    Tensor(Tensor),
    /// A reference to something outside the pickle: for torch the tuple `('storage', type, key, place, count, ...)`.
    Persistent(Id),
}

/// What a pickle may call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Callable {
    /// `numpy.core.multiarray._reconstruct(ndarray, shape, type)`: an array without content, which `BUILD` fills.
    Reconstruct,
    /// `numpy.core.multiarray.scalar(dtype, bytes)`.
    Scalar,
    /// `numpy.core.numeric._frombuffer(bytes, dtype, shape, order)`, protocol 5.
    FromBuffer,
    /// `numpy.dtype(code, align, copy)`.
    Dtype,
    /// `numpy.ndarray`, only as an argument of `_reconstruct`.
    NdArray,
    /// `_codecs.encode(text, "latin1")`, how protocols 0 to 2 write bytes.
    Encode,
    /// `bytes()`, how protocols 0 to 2 write no bytes.
    EmptyBytes,
    /// `collections.OrderedDict()`, read as a plain dictionary.
    OrderedDict,
    /// `torch._utils._rebuild_tensor_v2(storage, offset, shape, stride, ...)` and its older form.
    RebuildTensor,
    /// `torch._utils._rebuild_parameter(tensor, ...)`, read as the tensor.
    RebuildParameter,
    /// `torch.FloatStorage` and its like, only inside a reference.
    Storage(StorageType),
}

/// The numbers in a torch storage.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StorageType {
    /// Half precision.
    F16,
    /// The upper half of single precision.
    BF16,
    /// Single precision.
    F32,
    /// Double precision.
    F64,
    /// Integers, which no weights are.
    Other,
}

/// A torch tensor: a view of a storage that lies outside the pickle. Numbers are counted in elements.
#[derive(Debug, Clone)]
pub struct Tensor {
    /// A [`Value::Persistent`].
    pub storage: Id,
    /// Where the first element lies in the storage.
    pub offset: usize,
    /// Size along each axis.
    pub shape: Vec<usize>,
    /// Elements between neighbours along each axis.
    pub stride: Vec<usize>,
}

/// An element type: kind and width.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Dtype {
    /// numpy's letter: `b` bool, `i`, `u`, `f`, `O`.
    pub kind: u8,
    /// Bytes per element.
    pub size: usize,
    /// Byte order of the elements.
    pub big_endian: bool,
}

/// The content of a numpy array.
#[derive(Debug, Clone, Default)]
pub struct Array {
    /// Size along each axis.
    pub shape: Vec<usize>,
    /// Whether the first index runs fastest.
    pub fortran_order: bool,
    /// Type of the elements; `None` until `BUILD`.
    pub dtype: Option<Dtype>,
    /// The elements' bytes (a [`Value::Bytes`]), or for objects the list of them; `None` until `BUILD`.
    pub content: Option<Id>,
}

/// What was wrong, and at which byte of the pickle.
#[derive(Debug, PartialEq, Eq)]
pub struct Fault {
    /// Where, from 0.
    pub byte: usize,
    /// What was found, as a clause.
    pub found: String,
}

/// A pickle's values.
#[derive(Debug)]
pub struct Pickle {
    values: Vec<Value>,
    root: Id,
}

impl Pickle {
    /// Reads a pickle, up to its `STOP`.
    ///
    /// # Errors
    /// The bytes end early or are no pickle, or the pickle wants to call something else than it may.
    pub fn read(bytes: &[u8]) -> Result<Self, Fault> {
        Ok(Self::read_prefix(bytes)?.0)
    }

    /// Like [`Self::read`], with the number of bytes up to and with `STOP`, behind which another pickle may follow.
    ///
    /// # Errors
    /// As for [`Self::read`].
    pub fn read_prefix(bytes: &[u8]) -> Result<(Self, usize), Fault> {
        let mut machine = Machine::new(bytes);
        for _ in 0..MAX_OPERATIONS {
            let start = machine.at;
            match machine.step() {
                Ok(None) => {}
                Ok(Some(root)) => return Ok((Self { values: machine.values, root }, machine.at)),
                Err(found) => return Err(Fault { byte: start, found }),
            }
        }
        Err(Fault { byte: machine.at, found: format!("more than {MAX_OPERATIONS} operations") })
    }

    /// The value that the pickle stands for.
    pub fn root(&self) -> &Value {
        &self.values[self.root]
    }

    /// A value by its index, which only this pickle hands out.
    pub fn get(&self, id: Id) -> &Value {
        &self.values[id]
    }

    /// The entry of a dictionary under a text key.
    pub fn entry(&self, dict: &[(Id, Id)], key: &str) -> Option<&Value> {
        // A later item replaces an earlier one of the same key, as in Python.
        let (_, value) = dict.iter().rev().find(|(k, _)| match self.get(*k) {
            Value::Text(text) => text == key,
            Value::Bytes(bytes) => bytes == key.as_bytes(),
            _ => false,
        })?;
        Some(self.get(*value))
    }

    /// A number, also where numpy wrapped it into an array of one element.
    pub fn number(&self, value: &Value) -> Option<f64> {
        match value {
            Value::Int(v) => Some(*v as f64),
            Value::Float(v) => Some(*v),
            _ => match self.numbers(value)?.as_slice() {
                [v] => Some(*v),
                _ => None,
            },
        }
    }

    /// The elements of a list, tuple or array of numbers, an array's in C order.
    pub fn numbers(&self, value: &Value) -> Option<Vec<f64>> {
        self.numbers_as(value, |number| number)
    }

    /// Like [`Self::numbers`], each converted at once: a large mask need not be held as floats.
    pub fn numbers_as<T: Copy>(&self, value: &Value, convert: impl Fn(f64) -> T) -> Option<Vec<T>> {
        match value {
            Value::Items(items) => items
                .iter()
                .map(|&id| match self.get(id) {
                    Value::Int(v) => Some(convert(*v as f64)),
                    Value::Float(v) => Some(convert(*v)),
                    // numpy's scalars are arrays of one element here.
                    Value::Array(array) => self.elements(array, &convert).filter(|e| e.len() == 1).map(|e| e[0]),
                    _ => None,
                })
                .collect(),
            Value::Array(array) => self.elements(array, convert),
            _ => None,
        }
    }

    fn elements<T: Copy>(&self, array: &Array, convert: impl Fn(f64) -> T) -> Option<Vec<T>> {
        let dtype = array.dtype?;
        let Value::Bytes(bytes) = self.get(array.content?) else { return None };
        let count = array.shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d))?;
        if dtype.size == 0 || bytes.len() != count.checked_mul(dtype.size)? {
            return None;
        }
        let stored: Vec<T> =
            bytes.chunks_exact(dtype.size).map(|raw| dtype.number(raw).map(&convert)).collect::<Option<_>>()?;
        if !array.fortran_order || array.shape.len() < 2 {
            return Some(stored);
        }
        // The first index runs fastest on disk; hand the elements out with the last one fastest.
        let mut index = vec![0usize; array.shape.len()];
        let mut elements = Vec::with_capacity(count);
        for _ in 0..count {
            let at = index.iter().zip(&array.shape).rev().fold(0, |at, (&i, &d)| at * d + i);
            elements.push(stored[at]);
            for axis in (0..index.len()).rev() {
                index[axis] += 1;
                if index[axis] < array.shape[axis] {
                    break;
                }
                index[axis] = 0;
            }
        }
        Some(elements)
    }
}

impl Dtype {
    /// From numpy's code, such as `b1`, `i8`, `<f4`, `O8`, `?`.
    fn parse(code: &str) -> Option<Self> {
        let (big_endian, code) = match code.as_bytes().first()? {
            b'>' => (true, &code[1..]),
            b'<' | b'=' | b'|' => (false, &code[1..]),
            _ => (false, code),
        };
        let kind = *code.as_bytes().first()?;
        let (kind, size) = match (kind, &code[1..]) {
            (b'?', "") => (b'b', 1),
            (b'O', _) => (b'O', 8),
            (b'b' | b'i' | b'u' | b'f', digits) => (kind, digits.parse().ok()?),
            _ => return None,
        };
        let known = matches!((kind, size), (b'b', 1) | (b'i' | b'u', 1 | 2 | 4 | 8) | (b'f', 4 | 8) | (b'O', _));
        known.then_some(Self { kind, size, big_endian })
    }

    fn number(self, raw: &[u8]) -> Option<f64> {
        let mut little = [0u8; 8];
        for (i, slot) in little.iter_mut().take(raw.len()).enumerate() {
            *slot = if self.big_endian { raw[raw.len() - 1 - i] } else { raw[i] };
        }
        let unsigned = u64::from_le_bytes(little);
        Some(match (self.kind, self.size) {
            (b'b' | b'u', _) => unsigned as f64,
            (b'i', size) => {
                let unused = 64 - 8 * size as u32;
                ((unsigned << unused) as i64 >> unused) as f64
            }
            (b'f', 4) => f64::from(f32::from_bits(unsigned as u32)),
            (b'f', 8) => f64::from_bits(unsigned),
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn plain_data_of_every_protocol() {
        // pickle.dumps({"a": (1, -2, 2.5, True)}, protocol) for protocols 0 and 2.
        let protocol_0 = b"(dp0\nVa\np1\n(I1\nI-2\nF2.5\nI01\ntp2\ns.";
        let protocol_2 =
            b"\x80\x02}q\x00X\x01\x00\x00\x00aq\x01(K\x01J\xfe\xff\xff\xffG@\x04\x00\x00\x00\x00\x00\x00\x88tq\x02s.";
        for bytes in [protocol_0.as_slice(), protocol_2] {
            let pickle = Pickle::read(bytes).unwrap();
            let Value::Dict(dict) = pickle.root() else { panic!("{pickle:?}") };
            let Some(Value::Items(items)) = pickle.entry(dict, "a") else { panic!("{pickle:?}") };
            let items: Vec<_> = items.iter().map(|&i| pickle.get(i)).collect();
            assert!(matches!(items[..], [Value::Int(1), Value::Int(-2), Value::Float(2.5), Value::Bool(true)]));
        }
    }

    #[test]
    fn no_call_but_numpys_is_made() {
        for (bytes, what) in [
            (b"cos\nsystem\n(S'echo x'\ntR.".as_slice(), "os.system"),
            (b"\x80\x04\x8c\x08builtins\x94\x8c\x04eval\x94\x93\x8c\x011\x85R.", "builtins.eval"),
            (b"c__builtin__\neval\n(Vx\ntR.", "__builtin__.eval"),
            (b"cnumpy.testing._private.utils\nrunstring\n(t", "runstring"),
        ] {
            let fault = Pickle::read(bytes).unwrap_err();
            assert!(fault.found.contains(what), "{fault:?}");
        }
    }

    #[test]
    fn deep_nesting_and_self_reference_are_harmless() {
        let mut nested = vec![b')'];
        nested.resize(500_000, 0x85);
        nested.push(b'.');
        assert!(matches!(Pickle::read(&nested).unwrap().root(), Value::Items(_)));
        // A list that holds itself.
        let pickle = Pickle::read(b"]q\x00h\x00a.").unwrap();
        assert_eq!(pickle.numbers(pickle.root()), None);
    }

    #[test]
    fn a_declared_length_allocates_nothing() {
        for bytes in [b"\x8e\xff\xff\xff\xff\xff\xff\xff\x7f".as_slice(), b"B\xff\xff\xff\xff", b"X\xff\xff\xff\x7f"] {
            assert!(Pickle::read(bytes).unwrap_err().found.contains("truncated"));
        }
    }

    proptest! {
        #[test]
        fn any_bytes_end_in_a_value_or_a_fault(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
            let _ = Pickle::read(&bytes);
        }
    }
}
