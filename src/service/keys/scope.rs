//! Scopes: the operations that an API key allows.

use std::fmt;
use std::str::FromStr;

use serde::{Serialize, Serializer};

use crate::invalid::Invalid;

/// A group of operations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// Reading: lists, details, metrics, reflection.
    Read,
    /// `Act`, sessions, environments, inference.
    Act,
    /// Submitting, cancelling, pausing, resuming and deleting jobs.
    Jobs,
    /// Changing policies and aliases, and everything that the other scopes allow.
    Admin,
}

impl Scope {
    /// All scopes, in the order of their text form.
    pub const ALL: [Self; 4] = [Self::Read, Self::Act, Self::Jobs, Self::Admin];

    /// Name in flags, in the database and in JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::Read => "read",
            Self::Act => "act",
            Self::Jobs => "jobs",
            Self::Admin => "admin",
        }
    }
}

/// The scopes of one key, at least one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Scopes(u8);

impl Scopes {
    fn bit(scope: Scope) -> u8 {
        1 << scope as u8
    }

    /// Whether operations of `scope` are allowed. `admin` allows every scope.
    pub fn allows(self, scope: Scope) -> bool {
        self.0 & (Self::bit(scope) | Self::bit(Scope::Admin)) != 0
    }

    /// The scopes as granted; `admin` is one scope here.
    pub fn iter(self) -> impl Iterator<Item = Scope> {
        Scope::ALL.into_iter().filter(move |scope| self.0 & Self::bit(*scope) != 0)
    }

    /// Parses the text form from the database. Names that this version does not know are ignored.
    pub(super) fn from_stored(text: &str) -> Self {
        let known = text.split(',').filter_map(|name| Scope::ALL.into_iter().find(|scope| scope.name() == name));
        Self(known.fold(0, |bits, scope| bits | Self::bit(scope)))
    }
}

impl FromStr for Scopes {
    type Err = Invalid;

    fn from_str(text: &str) -> Result<Self, Invalid> {
        let mut bits = 0;
        for name in text.split(',').map(str::trim) {
            let found = Scope::ALL.into_iter().find(|scope| scope.name() == name);
            let scope = found.ok_or_else(|| {
                Invalid::new("scopes", format!("{name:?}"), "one or more of read, act, jobs, admin, separated by commas")
            })?;
            bits |= Self::bit(scope);
        }
        Ok(Self(bits))
    }
}

impl fmt::Display for Scopes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.iter().enumerate().try_for_each(|(i, scope)| write!(f, "{}{}", if i == 0 { "" } else { "," }, scope.name()))
    }
}

impl Serialize for Scopes {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.iter().map(Scope::name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scopes_round_trip_and_admin_allows_all() {
        let scopes: Scopes = "act, read".parse().unwrap();
        assert_eq!(scopes.to_string(), "read,act");
        assert_eq!(scopes, "read,act".parse().unwrap());
        assert_eq!(Scopes::from_stored(&scopes.to_string()), scopes);
        let allowed = |scopes: Scopes| Scope::ALL.map(|scope| scopes.allows(scope));
        assert_eq!(allowed(scopes), [true, true, false, false]);
        assert_eq!(allowed("admin".parse().unwrap()), [true; 4]);
        assert_eq!(allowed(Scopes::from_stored("unknown,jobs")), [false, false, true, false]);
        for wrong in ["", "read,", "READ", "read;act", "all"] {
            let error = wrong.parse::<Scopes>().unwrap_err();
            assert_eq!(error.field, "scopes", "{wrong}");
        }
    }
}
