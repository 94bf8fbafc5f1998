//! How policies are named: `NAME`, `NAME@ALIAS`, `NAME:VERSION`, and exactly which one answered.

use std::fmt;
use std::str::FromStr;

use crate::invalid::Invalid;

/// Longest name of a policy or alias, in characters.
const LONGEST: usize = 64;

/// Which version of a policy is asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Which {
    /// The newest.
    Newest,
    /// What an alias points to now.
    Alias(String),
    /// This one.
    Version(u64),
}

/// A policy as a caller names it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicySpec {
    /// Name of the policy.
    pub name: String,
    /// Its version.
    pub which: Which,
}

impl FromStr for PolicySpec {
    type Err = Invalid;

    fn from_str(text: &str) -> Result<Self, Invalid> {
        let wrong = || {
            let expected = "NAME, NAME@ALIAS or NAME:VERSION; a name has 1 to 64 letters, digits, '.', '_' or '-' and does not start with '.'";
            Invalid::new("policy", format!("{text:?}"), expected)
        };
        let (name, which) = if let Some((name, alias)) = text.split_once('@') {
            check_name("policy", alias).map_err(|_| wrong())?;
            (name, Which::Alias(alias.to_owned()))
        } else if let Some((name, version)) = text.split_once(':') {
            let digits = !version.is_empty() && version.bytes().all(|b| b.is_ascii_digit());
            let version = version.parse().ok().filter(|&v| digits && v > 0).ok_or_else(wrong)?;
            (name, Which::Version(version))
        } else {
            (text, Which::Newest)
        };
        check_name("policy", name).map_err(|_| wrong())?;
        Ok(Self { name: name.to_owned(), which })
    }
}

impl fmt::Display for PolicySpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.which {
            Which::Newest => f.write_str(&self.name),
            Which::Alias(alias) => write!(f, "{}@{alias}", self.name),
            Which::Version(version) => write!(f, "{}:{version}", self.name),
        }
    }
}

/// Checks the name of a policy or alias.
///
/// # Errors
/// Empty, too long, a character other than ASCII letters, digits, `.`, `_`, `-`, or a `.` first, which paths do not keep;
/// `field` is named.
pub fn check_name(field: &str, name: &str) -> Result<(), Invalid> {
    let allowed = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-');
    if !name.is_empty() && name.len() <= LONGEST && name.bytes().all(allowed) && !name.starts_with('.') {
        return Ok(());
    }
    let expected = format!("1 to {LONGEST} letters, digits, '.', '_' or '-', not starting with '.'");
    Err(Invalid::new(field, format!("{name:?}"), expected))
}

/// Exactly one version of one policy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicyRef {
    /// Name.
    pub name: String,
    /// Version, from 1.
    pub version: u64,
    /// SHA-256 of the checkpoint, or of the name and parameters of a baseline.
    pub digest: [u8; 32],
}

impl PolicyRef {
    /// The digest in hexadecimal.
    pub fn digest_hex(&self) -> String {
        hex::encode(self.digest)
    }
}

impl fmt::Display for PolicyRef {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.name, self.version)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_ways_to_name_a_policy() {
        let parse = |text: &str| text.parse::<PolicySpec>().map(|spec| spec.which);
        assert_eq!(parse("sweep"), Ok(Which::Newest));
        assert_eq!(parse("sweep@prod"), Ok(Which::Alias("prod".into())));
        assert_eq!(parse("sweep:12"), Ok(Which::Version(12)));
        for wrong in [
            "",
            "a b",
            "a:",
            "a:0",
            "a:+1",
            "a:-1",
            "a:x",
            "a@",
            "@b",
            ":1",
            "a@b:1",
            "a:1@b",
            ".a",
            "..",
            "a@.b",
            "é",
            &"x".repeat(65),
        ] {
            assert!(parse(wrong).is_err(), "{wrong:?}");
        }
        for text in ["sweep", "sweep@prod", "sweep:12"] {
            assert_eq!(text.parse::<PolicySpec>().unwrap().to_string(), text);
        }
    }
}
