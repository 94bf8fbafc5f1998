//! Values of a tensor in JSON: an array, flat or nested as the shape is.

use std::fmt;

use serde::Deserialize;
use serde::de::{DeserializeSeed, Deserializer, Error, SeqAccess, Visitor};

use crate::api::convert::tensors::{Data, Datatype};
use crate::invalid::Invalid;

/// What an array holds, row by row.
#[derive(Debug, Default)]
pub(super) struct Values {
    numbers: Vec<Number>,
    texts: Vec<String>,
    /// Length of the arrays at each depth.
    sizes: Vec<Option<usize>>,
    /// Arrays of one depth differ in length, or values in depth.
    ragged: bool,
    /// Depth of the values.
    depth: Option<usize>,
}

#[derive(Clone, Copy, Debug)]
enum Number {
    Whole(i64),
    Real(f64),
}

impl Number {
    fn real(self) -> f64 {
        match self {
            Self::Whole(value) => value as f64,
            Self::Real(value) => value,
        }
    }

    fn whole(self) -> Option<i64> {
        if let Self::Whole(value) = self { Some(value) } else { None }
    }
}

impl Values {
    /// The values as tensor `name` of this datatype and shape has them. An unknown datatype is told by who knows them.
    ///
    /// # Errors
    /// Texts among numbers, numbers that do not fit the datatype, or nesting that is not the shape's.
    pub(super) fn into_data(self, name: &str, datatype: &str, shape: &[i64]) -> Result<Data, Invalid> {
        let nested: Vec<i64> = self.sizes.iter().map(|size| size.unwrap_or(0) as i64).collect();
        if self.ragged || nested.len() > 1 && nested != shape {
            let found = if self.ragged { "ragged arrays".into() } else { format!("arrays of shape {nested:?}") };
            return Err(Invalid::new(format!("{name}.data"), found, format!("a flat array, or arrays of shape {shape:?}")));
        }
        let Some(datatype) = Datatype::parse(datatype) else { return Ok(Data::Raw(bytes::Bytes::new())) };
        let texts = datatype == Datatype::Bytes;
        if !(if texts { self.numbers.is_empty() } else { self.texts.is_empty() }) {
            let (found, expected) = if texts { ("numbers", "texts") } else { ("texts", "numbers") };
            return Err(Invalid::new(format!("{name}.data"), found, format!("{expected}, as its datatype says")));
        }
        let numbers = self.numbers;
        let unfit =
            |i: usize| Invalid::new(format!("{name}.data[{i}]"), numbers[i].real(), format!("a whole number of {datatype}"));
        let whole = numbers.iter().enumerate().map(|(i, number)| number.whole().ok_or_else(|| unfit(i)));
        Ok(match datatype {
            Datatype::Int64 => Data::Int64(whole.collect::<Result<_, _>>()?),
            Datatype::Int32 => {
                let narrow = |(i, value): (usize, Result<i64, _>)| value.and_then(|v| i32::try_from(v).map_err(|_| unfit(i)));
                Data::Int32(whole.enumerate().map(narrow).collect::<Result<_, _>>()?)
            }
            Datatype::Fp32 => Data::Fp32(numbers.iter().map(|number| number.real() as f32).collect()),
            Datatype::Fp64 => Data::Fp64(numbers.iter().map(|number| number.real()).collect()),
            Datatype::Bytes => Data::Bytes(self.texts.into_iter().map(Into::into).collect()),
        })
    }
}

impl<'de> Deserialize<'de> for Values {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut values = Self::default();
        Level { values: &mut values, depth: 0 }.deserialize(deserializer)?;
        Ok(values)
    }
}

/// Reads what stands at one depth: an array, or below the first one a value.
struct Level<'a> {
    values: &'a mut Values,
    depth: usize,
}

impl Level<'_> {
    fn leaf<E: Error>(&mut self) -> Result<(), E> {
        if self.depth == 0 {
            return Err(E::custom("a value, expected an array of values"));
        }
        self.values.ragged |= *self.values.depth.get_or_insert(self.depth) != self.depth;
        Ok(())
    }

    fn number<E: Error>(mut self, number: Number) -> Result<(), E> {
        self.leaf()?;
        self.values.numbers.push(number);
        Ok(())
    }
}

impl<'de> DeserializeSeed<'de> for Level<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Level<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("arrays of numbers or of texts")
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<(), E> {
        self.number(Number::Whole(value))
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<(), E> {
        self.number(i64::try_from(value).map_or(Number::Real(value as f64), Number::Whole))
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<(), E> {
        self.number(Number::Real(value))
    }

    fn visit_str<E: Error>(mut self, value: &str) -> Result<(), E> {
        self.leaf()?;
        self.values.texts.push(value.to_owned());
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<(), A::Error> {
        let Self { values, depth } = self;
        if values.sizes.len() == depth {
            values.sizes.push(None);
        }
        let mut size = 0;
        while seq.next_element_seed(Level { values: &mut *values, depth: depth + 1 })?.is_some() {
            size += 1;
        }
        values.ragged |= *values.sizes[depth].get_or_insert(size) != size;
        // Values stand in the innermost arrays.
        values.ragged |= values.depth.is_some_and(|at| at != values.sizes.len());
        Ok(())
    }
}
