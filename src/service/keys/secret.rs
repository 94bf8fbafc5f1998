//! `qdx_ID_SECRET`: how a key is written, made and compared. Only the SHA-256 of its secret is ever kept.

use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;

/// How every key begins, so that people and scanners recognise one.
const PREFIX: &str = "qdx_";
const ALPHABET: &[u8; 62] = b"0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz";
/// Characters of the public part: room enough that two are never the same.
const ID: usize = 10;
/// Characters of the secret part: 43 of 62 are 256 bits.
const SECRET: usize = 43;

/// A key in full, as its owner holds it. Not to be logged: it has no `Debug`.
pub struct Plain {
    id: String,
    secret: String,
}

impl Plain {
    /// A new one from the system's generator.
    ///
    /// # Errors
    /// The system has no random numbers.
    pub fn generate() -> Result<Self, getrandom::Error> {
        Ok(Self { id: random(ID)?, secret: random(SECRET)? })
    }

    /// The public part.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// What is kept of the secret.
    pub fn digest(&self) -> [u8; 32] {
        digest(&self.secret)
    }

    /// The whole key, to be shown once.
    pub fn reveal(&self) -> String {
        format!("{PREFIX}{}_{}", self.id, self.secret)
    }
}

/// The public and the secret part of a key that a caller shows.
pub fn split(text: &str) -> Option<(&str, &str)> {
    let (id, secret) = text.strip_prefix(PREFIX)?.split_once('_')?;
    (id.len() == ID && secret.len() == SECRET).then_some((id, secret))
}

/// The public part of what a person may have pasted: an id or a whole key.
pub fn public(text: &str) -> &str {
    let id = text.strip_prefix(PREFIX).unwrap_or(text);
    id.split_once('_').map_or(id, |(id, _)| id)
}

/// Whether `secret` is the one of which `digest` was kept, in a time that does not depend on where they differ.
pub fn matches(secret: &str, kept: &[u8; 32]) -> bool {
    digest(secret).ct_eq(kept).into()
}

fn digest(secret: &str) -> [u8; 32] {
    Sha256::digest(secret).into()
}

/// Characters of the alphabet, each as likely as any other.
fn random(len: usize) -> Result<String, getrandom::Error> {
    // Bytes from 248 on would make some characters more likely.
    const FAIR: u8 = 248;
    let mut text = String::with_capacity(len);
    let mut bytes = [0; 64];
    loop {
        getrandom::fill(&mut bytes)?;
        for byte in bytes.into_iter().filter(|byte| *byte < FAIR) {
            if text.len() == len {
                return Ok(text);
            }
            text.push(char::from(ALPHABET[usize::from(byte) % ALPHABET.len()]));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_what_they_are_split_into() {
        let (a, b) = (Plain::generate().unwrap(), Plain::generate().unwrap());
        assert_ne!(a.reveal(), b.reveal());
        let text = a.reveal();
        let (id, secret) = split(&text).unwrap();
        assert_eq!(id, a.id());
        assert_eq!([&text, id, &format!("{PREFIX}{id}")].map(public), [id; 3]);
        assert!(matches(secret, &a.digest()) && !matches(secret, &b.digest()));
        assert!(text.bytes().all(|c| c == b'_' || ALPHABET.contains(&c)), "{text}");
        for wrong in ["", "qdx_", &text[1..], &text[..text.len() - 1], &format!("{text}x"), "qdx_é_é", "Bearer x"] {
            assert!(split(wrong).is_none(), "{wrong}");
        }
    }
}
