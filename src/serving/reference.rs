//! References to policies: `NAME`, `NAME@ALIAS` or `NAME:VERSION` in requests, and name, version and digest in responses.

use std::fmt;
use std::str::FromStr;

use crate::invalid::Invalid;

/// Maximum length of the name of a policy or alias, in characters.
const MAX_NAME: usize = 64;

/// Selects a version of a policy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum VersionSelector {
    /// The newest version.
    Newest,
    /// The version that this alias points to.
    Alias(String),
    /// The version with this number.
    Version(u64),
}

/// A reference to a policy in a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicySpec {
    /// Name of the policy.
    pub name: String,
    /// The version of the policy.
    pub version: VersionSelector,
}

impl FromStr for PolicySpec {
    type Err = Invalid;

    fn from_str(text: &str) -> Result<Self, Invalid> {
        let wrong = || {
            let expected = "NAME, NAME@ALIAS or NAME:VERSION; a name has 1 to 64 letters, digits, '.', '_' or '-' and does not start with '.'";
            Invalid::new("policy", format!("{text:?}"), expected)
        };
        let (name, version) = if let Some((name, alias)) = text.split_once('@') {
            check_name("policy", alias).map_err(|_| wrong())?;
            (name, VersionSelector::Alias(alias.to_owned()))
        } else if let Some((name, version)) = text.split_once(':') {
            let digits = !version.is_empty() && version.bytes().all(|b| b.is_ascii_digit());
            let version = version.parse().ok().filter(|&v| digits && v > 0).ok_or_else(wrong)?;
            (name, VersionSelector::Version(version))
        } else {
            (text, VersionSelector::Newest)
        };
        check_name("policy", name).map_err(|_| wrong())?;
        Ok(Self { name: name.to_owned(), version })
    }
}

impl fmt::Display for PolicySpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.version {
            VersionSelector::Newest => f.write_str(&self.name),
            VersionSelector::Alias(alias) => write!(f, "{}@{alias}", self.name),
            VersionSelector::Version(version) => write!(f, "{}:{version}", self.name),
        }
    }
}

/// Checks the name of a policy or alias.
///
/// # Errors
/// Names `field` if `name` is empty, is longer than 64 characters, has other characters than ASCII letters, digits, `.`, `_`,
/// `-`, or begins with `.` (HTTP clients drop path segments like `..`).
pub fn check_name(field: &str, name: &str) -> Result<(), Invalid> {
    let allowed = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-');
    if !name.is_empty() && name.len() <= MAX_NAME && name.bytes().all(allowed) && !name.starts_with('.') {
        return Ok(());
    }
    let expected = format!("1 to {MAX_NAME} letters, digits, '.', '_' or '-', not starting with '.'");
    Err(Invalid::new(field, format!("{name:?}"), expected))
}

/// One version of one policy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicyRef {
    /// Name.
    pub name: String,
    /// Version, from 1.
    pub version: u64,
    /// SHA-256 of the checkpoint file, or of the name and parameters of a baseline.
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
    fn parses_name_alias_and_version() {
        let parse = |text: &str| text.parse::<PolicySpec>().map(|spec| spec.version);
        assert_eq!(parse("sweep"), Ok(VersionSelector::Newest));
        assert_eq!(parse("sweep@prod"), Ok(VersionSelector::Alias("prod".into())));
        assert_eq!(parse("sweep:12"), Ok(VersionSelector::Version(12)));
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
