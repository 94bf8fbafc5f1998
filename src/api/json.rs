//! Reads JSON by the rules of JSON Schema. Derived `Deserialize` differs in two points: it accepts an array for an object, and
//! rejects `3.0` for an integer. Maps differ from structs in a third: of a key that occurs twice, they keep the last value.

use std::collections::BTreeMap;
use std::fmt;
use std::marker::PhantomData;

use serde::de::{DeserializeOwned, Deserializer, Error, MapAccess, SeqAccess, Unexpected, Visitor};
use serde::{Deserialize, forward_to_deserialize_any};
use serde_json::{Map, Value};

use crate::invalid::Invalid;
use crate::service;

/// A deserializer that reads structs from objects only, not from arrays of their fields.
pub(super) struct ObjectOnly<D>(pub(super) D);

impl<'de, D: Deserializer<'de>> Deserializer<'de> for ObjectOnly<D> {
    type Error = D::Error;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
        self.0.deserialize_any(visitor)
    }

    fn deserialize_struct<V>(self, _: &'static str, _: &'static [&'static str], visitor: V) -> Result<V::Value, D::Error>
    where
        V: Visitor<'de>,
    {
        self.0.deserialize_map(visitor)
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf option unit unit_struct
        newtype_struct seq tuple tuple_struct map enum identifier ignored_any
    }
}

/// Implements `Deserialize` from objects only, at any depth of a document, for types that derive it with
/// `#[serde(remote = "Self")]`. Write `Serialize +` for types that also derive `Serialize`.
macro_rules! objects_only {
    (Serialize + $($type:ty),+) => {
        crate::api::json::objects_only!($($type),+);
        $(impl serde::Serialize for $type {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                <$type>::serialize(self, serializer)
            }
        })+
    };
    ($($type:ty),+) => {
        $(impl<'de> serde::Deserialize<'de> for $type {
            fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                <$type>::deserialize(crate::api::json::ObjectOnly(deserializer))
            }
        })+
    };
}
pub(super) use objects_only;

/// An integer of type `T` in any notation: `3`, `3.0`, `3e0`.
struct Integer<T>(T);

impl<'de, T: TryFrom<i128>> Deserialize<'de> for Integer<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct IntegerVisitor<T>(PhantomData<T>);

        impl<T: TryFrom<i128>> Visitor<'_> for IntegerVisitor<T> {
            type Value = Integer<T>;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(std::any::type_name::<T>())
            }

            fn visit_i64<E: Error>(self, value: i64) -> Result<Integer<T>, E> {
                T::try_from(value.into()).map(Integer).map_err(|_| E::invalid_value(Unexpected::Signed(value), &self))
            }

            fn visit_u64<E: Error>(self, value: u64) -> Result<Integer<T>, E> {
                T::try_from(value.into()).map(Integer).map_err(|_| E::invalid_value(Unexpected::Unsigned(value), &self))
            }

            fn visit_f64<E: Error>(self, value: f64) -> Result<Integer<T>, E> {
                // The conversion saturates at bounds that no `T` contains.
                let whole = Some(value as i128).filter(|_| value.fract() == 0.0);
                let integer = whole.and_then(|whole| T::try_from(whole).ok());
                integer.map(Integer).ok_or_else(|| E::invalid_value(Unexpected::Float(value), &self))
            }
        }

        deserializer.deserialize_any(IntegerVisitor(PhantomData))
    }
}

/// For `deserialize_with`: an integer.
pub(super) fn integer<'de, D: Deserializer<'de>, T: TryFrom<i128>>(deserializer: D) -> Result<T, D::Error> {
    Integer::deserialize(deserializer).map(|Integer(value)| value)
}

/// For `deserialize_with`: an integer or null.
pub(super) fn optional_integer<'de, D: Deserializer<'de>, T: TryFrom<i128>>(deserializer: D) -> Result<Option<T>, D::Error> {
    Option::deserialize(deserializer).map(|value| value.map(|Integer(value)| value))
}

/// For `deserialize_with`: a value or null, told from an absent one.
pub(super) fn present<'de, D: Deserializer<'de>, T: Deserialize<'de>>(deserializer: D) -> Result<Option<Option<T>>, D::Error> {
    Option::deserialize(deserializer).map(Some)
}

/// For `deserialize_with`: an integer or null, told from an absent one.
pub(super) fn present_integer<'de, D, T>(deserializer: D) -> Result<Option<Option<T>>, D::Error>
where
    D: Deserializer<'de>,
    T: TryFrom<i128>,
{
    optional_integer(deserializer).map(Some)
}

/// For `deserialize_with`: a list of integers.
pub(super) fn integers<'de, D: Deserializer<'de>, T: TryFrom<i128>>(deserializer: D) -> Result<Vec<T>, D::Error> {
    Vec::deserialize(deserializer).map(|values| values.into_iter().map(|Integer(value)| value).collect())
}

/// A map in which every key occurs once.
struct Object<V>(BTreeMap<String, V>);

impl<'de, V: Deserialize<'de>> Deserialize<'de> for Object<V> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct ObjectVisitor<V>(PhantomData<V>);

        impl<'de, V: Deserialize<'de>> Visitor<'de> for ObjectVisitor<V> {
            type Value = Object<V>;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a map")
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<Object<V>, A::Error> {
                distinct_entries(map).map(Object)
            }
        }

        deserializer.deserialize_map(ObjectVisitor(PhantomData))
    }
}

fn distinct_entries<'de, V: Deserialize<'de>, A: MapAccess<'de>>(mut map: A) -> Result<BTreeMap<String, V>, A::Error> {
    let mut entries = BTreeMap::new();
    while let Some(key) = map.next_key::<String>()? {
        if entries.contains_key(&key) {
            return Err(A::Error::custom(format_args!("duplicate field `{key}`")));
        }
        entries.insert(key, map.next_value()?);
    }
    Ok(entries)
}

/// A JSON value in whose objects every key occurs once.
struct Distinct(Value);

impl<'de> Deserialize<'de> for Distinct {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct ValueVisitor;

        impl<'de> Visitor<'de> for ValueVisitor {
            type Value = Distinct;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a JSON value")
            }

            fn visit_unit<E: Error>(self) -> Result<Distinct, E> {
                Ok(Distinct(Value::Null))
            }

            fn visit_bool<E: Error>(self, value: bool) -> Result<Distinct, E> {
                Ok(Distinct(value.into()))
            }

            fn visit_i64<E: Error>(self, value: i64) -> Result<Distinct, E> {
                Ok(Distinct(value.into()))
            }

            fn visit_u64<E: Error>(self, value: u64) -> Result<Distinct, E> {
                Ok(Distinct(value.into()))
            }

            fn visit_f64<E: Error>(self, value: f64) -> Result<Distinct, E> {
                Ok(Distinct(value.into()))
            }

            fn visit_str<E: Error>(self, value: &str) -> Result<Distinct, E> {
                Ok(Distinct(value.into()))
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Distinct, A::Error> {
                let mut values = Vec::new();
                while let Some(Distinct(value)) = items.next_element()? {
                    values.push(value);
                }
                Ok(Distinct(values.into()))
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<Distinct, A::Error> {
                Ok(Distinct(values(distinct_entries(map)?).into()))
            }
        }

        deserializer.deserialize_any(ValueVisitor)
    }
}

fn values(entries: BTreeMap<String, Distinct>) -> Map<String, Value> {
    entries.into_iter().map(|(key, Distinct(value))| (key, value)).collect()
}

/// For `deserialize_with`: an object of any values, in which every key occurs once, at any depth.
pub(super) fn object<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Map<String, Value>, D::Error> {
    Object::deserialize(deserializer).map(|Object(entries)| values(entries))
}

/// For `deserialize_with`: as [`object`], or null.
pub(super) fn optional_object<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Map<String, Value>>, D::Error> {
    Option::deserialize(deserializer).map(|object| object.map(|Object(entries)| values(entries)))
}

/// For `deserialize_with`: an object of texts, in which every key occurs once, or null.
pub(super) fn optional_texts<'de, D>(deserializer: D) -> Result<Option<BTreeMap<String, String>>, D::Error>
where
    D: Deserializer<'de>,
{
    Option::deserialize(deserializer).map(|object| object.map(|Object(entries)| entries))
}

/// For `deserialize_with`: an object of texts and nulls, or null, told from an absent one.
pub(super) fn present_texts<'de, D>(deserializer: D) -> Result<Option<Option<BTreeMap<String, Option<String>>>>, D::Error>
where
    D: Deserializer<'de>,
{
    Option::deserialize(deserializer).map(|object| Some(object.map(|Object(entries)| entries)))
}

/// Longest document that is read again to explain an error.
const MAX_EXPLAINED: usize = 1 << 20;

/// The error of a document that has something else at `path` than one of the words that are accepted there: for the parser, that is
/// not JSON at all. None if the document is not JSON indeed.
fn not_a_word<T: DeserializeOwned>(body: &[u8], path: &serde_path_to_error::Path) -> Option<Invalid> {
    use serde_path_to_error::Segment;
    let mut document: Value = serde_json::from_slice(body.get(..body.len().min(MAX_EXPLAINED))?).ok()?;
    let mut place = &mut document;
    for segment in path {
        place = match segment {
            Segment::Seq { index } => place.get_mut(*index)?,
            Segment::Map { key } => place.get_mut(key)?,
            Segment::Enum { .. } | Segment::Unknown => return None,
        };
    }
    let value = std::mem::take(place).to_string();
    // A word is read as a word, so this error lists those that are accepted.
    *place = Value::String(value.clone());
    let error = serde_path_to_error::deserialize::<_, T>(ObjectOnly(document)).err()?;
    let path = error.path().to_string();
    let listed = Invalid::from_parser(&path, error.inner());
    Some(Invalid::schema(path, value, listed.expected))
}

/// Reads a JSON document.
///
/// # Errors
/// [`service::Error::Invalid`] where the body is not JSON or does not match the schema of `T`.
pub fn parse<T: DeserializeOwned>(body: &[u8]) -> Result<T, service::Error> {
    let mut deserializer = serde_json::Deserializer::from_slice(body);
    let document = serde_path_to_error::deserialize(ObjectOnly(&mut deserializer)).map_err(|e| {
        let path = e.path().to_string();
        let inner = e.inner();
        if inner.is_data() {
            return Invalid::from_parser(if path == "." { "" } else { &path }, inner);
        }
        let not_json = || Invalid::new("body", format!("{} bytes that are not JSON ({inner})", body.len()), "a JSON document");
        not_a_word::<T>(body, e.path()).unwrap_or_else(not_json)
    })?;
    deserializer.end().map_err(|e| Invalid::new("body", format!("more than one document ({e})"), "one JSON document"))?;
    Ok(document)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Deserialize, PartialEq)]
    #[serde(deny_unknown_fields)]
    struct Outer {
        #[serde(default, deserialize_with = "optional_integer")]
        count: Option<u32>,
        #[serde(default)]
        inner: Vec<Inner>,
    }

    #[derive(Debug, Deserialize, PartialEq)]
    #[serde(remote = "Self")]
    struct Inner {
        x: f64,
        #[serde(deserialize_with = "integer")]
        step: u64,
    }

    objects_only!(Inner);

    fn read(text: &str) -> Result<Outer, String> {
        Outer::deserialize(ObjectOnly(&mut serde_json::Deserializer::from_str(text))).map_err(|e| e.to_string())
    }

    #[test]
    fn integers_are_accepted_in_every_notation() {
        let outer = read(r#"{"count": 3.0, "inner": [{"x": 1, "step": 2e1}, {"x": 1, "step": 18446744073709551615}]}"#).unwrap();
        assert_eq!(outer.count, Some(3));
        assert_eq!(outer.inner, [Inner { x: 1.0, step: 20 }, Inner { x: 1.0, step: u64::MAX }]);
        assert_eq!(read(r#"{"count": null}"#).unwrap().count, None);
        for wrong in ["3.5", "-1", "-1.0", "4294967296", "4294967296.0", "1e300", "\"3\"", "[3]"] {
            assert!(read(&format!(r#"{{"count": {wrong}}}"#)).unwrap_err().contains("expected u32"), "{wrong}");
        }
    }

    #[test]
    fn keys_of_maps_occur_once_at_any_depth() {
        #[derive(Debug, Deserialize)]
        struct Free {
            #[serde(deserialize_with = "object")]
            any: Map<String, Value>,
            #[serde(default, deserialize_with = "optional_texts")]
            labels: Option<BTreeMap<String, String>>,
            #[serde(default, deserialize_with = "optional_object")]
            some: Option<Map<String, Value>>,
        }
        let text =
            r#"{"any": {"a": [1, -2, 0.5, "x", null, true, {"b": 18446744073709551615}]}, "labels": {"k": "v"}, "some": null}"#;
        let free: Free = serde_json::from_str(text).unwrap();
        assert_eq!(Value::Object(free.any), serde_json::from_str::<Value>(text).unwrap()["any"]);
        assert_eq!((free.labels.unwrap()["k"].as_str(), free.some), ("v", None));
        for twice in [
            r#"{"any": {"a": 1, "a": 1}}"#,
            r#"{"any": {"b": [{"a": 1, "a": 2}]}}"#,
            r#"{"any": {"b": {"a": {}, "a": {}}}}"#,
            r#"{"any": {}, "labels": {"a": "1", "a": "2"}}"#,
            r#"{"any": {}, "some": {"a": null, "\u0061": null}}"#,
        ] {
            let error = serde_json::from_str::<Free>(twice).unwrap_err();
            assert!(error.to_string().starts_with("duplicate field `a`"), "{twice}: {error}");
        }
    }

    #[test]
    fn what_is_not_a_word_is_not_called_malformed() {
        #[derive(Debug, Deserialize)]
        #[serde(rename_all = "snake_case")]
        enum Word {
            Clamp,
            Free,
        }
        #[derive(Debug, Deserialize)]
        struct Of {
            words: Vec<Word>,
        }
        let error = |body: &str| parse::<Of>(body.as_bytes()).unwrap_err().to_string();
        assert_eq!(error(r#"{"words": ["clamp", 9]}"#), "words[1]: got 9, expected clamp or free");
        assert_eq!(error(r#"{"words": [true]}"#), "words[0]: got true, expected clamp or free");
        assert!(error(r#"{"words": ["clamp", 9}"#).contains("not JSON"));
        assert_eq!(parse::<Of>(br#"{"words": ["free"]}"#).unwrap().words.len(), 1);
    }

    #[test]
    fn lists_are_not_objects_and_fields_occur_once() {
        assert!(read("[3, []]").unwrap_err().contains("invalid type: sequence, expected struct Outer"));
        assert!(read(r#"{"inner": [[1, 2]]}"#).unwrap_err().contains("invalid type: sequence, expected struct Inner"));
        assert!(read(r#"{"count": 3, "count": 3}"#).unwrap_err().contains("duplicate field `count`"));
    }
}
