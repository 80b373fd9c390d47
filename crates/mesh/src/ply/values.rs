//! The numbers after a PLY header, whatever their encoding.

use super::header::{Encoding, Scalar};

/// Why a number could not be read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Bad {
    /// The file ends before it.
    End,
    /// A word that is no number of the declared type.
    Word(String),
}

/// Reads one number after the other.
pub(super) struct Values<'a> {
    bytes: &'a [u8],
    at: usize,
    encoding: Encoding,
}

impl<'a> Values<'a> {
    pub(super) fn new(bytes: &'a [u8], encoding: Encoding) -> Self {
        Self { bytes, at: 0, encoding }
    }

    /// Bytes not read yet.
    pub(super) fn remaining(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// Lines begun so far; for messages.
    pub(super) fn line(&self) -> usize {
        self.bytes[..self.at].iter().filter(|&&b| b == b'\n').count()
    }

    /// A number as `f64`, which holds every type exactly.
    pub(super) fn number(&mut self, scalar: Scalar) -> Result<f64, Bad> {
        match self.encoding {
            Encoding::Ascii => self.ascii(scalar),
            Encoding::LittleEndian => self.binary(scalar, false),
            Encoding::BigEndian => self.binary(scalar, true),
        }
    }

    /// Passes over `count` numbers.
    pub(super) fn skip(&mut self, scalar: Scalar, count: usize) -> Result<(), Bad> {
        match self.encoding {
            Encoding::Ascii => (0..count).try_for_each(|_| self.ascii(scalar).map(|_| ())),
            _ => {
                let bytes = count.checked_mul(scalar.size()).filter(|&n| n <= self.remaining()).ok_or(Bad::End)?;
                self.at += bytes;
                Ok(())
            }
        }
    }

    fn ascii(&mut self, scalar: Scalar) -> Result<f64, Bad> {
        let rest = &self.bytes[self.at..];
        let start = rest.iter().position(|b| !b.is_ascii_whitespace()).ok_or(Bad::End)?;
        let length = rest[start..].iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len() - start);
        let word = &rest[start..start + length];
        let word = std::str::from_utf8(word).map_err(|_| Bad::Word(String::from_utf8_lossy(word).into_owned()))?;
        self.at += start + length;
        let value: f64 = word.parse().map_err(|_| Bad::Word(word.to_owned()))?;
        if !scalar.is_float() && value.fract() != 0.0 {
            return Err(Bad::Word(word.to_owned()));
        }
        Ok(value)
    }

    fn binary(&mut self, scalar: Scalar, big_endian: bool) -> Result<f64, Bad> {
        fn take<const N: usize>(values: &mut Values, big_endian: bool) -> Result<[u8; N], Bad> {
            let bytes = values.bytes.get(values.at..values.at + N).ok_or(Bad::End)?;
            values.at += N;
            let mut bytes: [u8; N] = bytes.try_into().map_err(|_| Bad::End)?;
            if big_endian {
                bytes.reverse();
            }
            Ok(bytes)
        }
        Ok(match scalar {
            Scalar::I8 => f64::from(i8::from_le_bytes(take(self, big_endian)?)),
            Scalar::U8 => f64::from(u8::from_le_bytes(take(self, big_endian)?)),
            Scalar::I16 => f64::from(i16::from_le_bytes(take(self, big_endian)?)),
            Scalar::U16 => f64::from(u16::from_le_bytes(take(self, big_endian)?)),
            Scalar::I32 => f64::from(i32::from_le_bytes(take(self, big_endian)?)),
            Scalar::U32 => f64::from(u32::from_le_bytes(take(self, big_endian)?)),
            Scalar::F32 => f64::from(f32::from_le_bytes(take(self, big_endian)?)),
            Scalar::F64 => f64::from_le_bytes(take(self, big_endian)?),
        })
    }
}
