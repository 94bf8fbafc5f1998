//! TOML documents as JSON values, which have neither dates nor numbers that are not finite.

use anyhow::Context;
use serde_json::{Map, Value};
use toml::Value as Toml;

use crate::invalid::Invalid;

/// The document `text`, of the file `name`.
///
/// # Errors
/// It is not TOML, or has a value that JSON cannot have; the error names file, field and value.
pub fn parse(name: &str, text: &str) -> anyhow::Result<Value> {
    let table: toml::Table = toml::from_str(text).with_context(|| name.to_owned())?;
    json("", Toml::Table(table)).with_context(|| name.to_owned())
}

fn json(path: &str, value: Toml) -> Result<Value, Invalid> {
    Ok(match value {
        Toml::String(text) => text.into(),
        Toml::Integer(number) => number.into(),
        Toml::Boolean(flag) => flag.into(),
        Toml::Float(number) if number.is_finite() => number.into(),
        Toml::Float(number) => return Err(Invalid::schema(path, number, "a finite number")),
        Toml::Datetime(date) => return Err(Invalid::schema(path, date, "a number, or text in quotes")),
        Toml::Array(items) => {
            let items = items.into_iter().enumerate().map(|(i, item)| json(&format!("{path}[{i}]"), item));
            items.collect::<Result<Vec<_>, _>>()?.into()
        }
        Toml::Table(fields) => {
            let dot = if path.is_empty() { "" } else { "." };
            let fields = fields.into_iter().map(|(name, field)| {
                let value = json(&format!("{path}{dot}{name}"), field)?;
                Ok((name, value))
            });
            fields.collect::<Result<Map<_, _>, Invalid>>()?.into()
        }
    })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn what_json_cannot_have_is_named_with_its_field() {
        let document = "title = \"t\"\nseeds = [1, 2]\n[[series]]\ntraining = { learning_rate = 1e-3, shaping = true }";
        let expected = json!({"title": "t", "seeds": [1, 2], "series": [{"training": {"learning_rate": 1e-3, "shaping": true}}]});
        assert_eq!(parse("a.toml", document).unwrap(), expected);
        for (value, shown) in [("nan", "NaN"), ("inf", "inf"), ("-inf", "-inf"), ("2026-01-02", "2026-01-02")] {
            let error = parse("a.toml", &document.replace("1e-3", value)).unwrap_err();
            let error = format!("{error:#}");
            assert!(error.starts_with(&format!("a.toml: series[0].training.learning_rate: got {shown}, expected")), "{error}");
        }
        assert!(format!("{:#}", parse("a.toml", "[run").unwrap_err()).contains("a.toml"));
    }
}
