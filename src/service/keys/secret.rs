//! The text form of an API key, `qdx_ID_SECRET`: how it is generated, parsed and verified.
//!
//! The server stores the id and the SHA-256 of the secret, never the secret itself.

use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;

/// Prefix of every key, so that people and secret scanners recognise one.
const PREFIX: &str = "qdx_";
const ALPHABET: &[u8; 62] = b"0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz";
/// Length of the id in characters: about 59 bits, so that two keys never get the same one.
const ID_LEN: usize = 10;
/// Length of the secret in characters: 43 characters of 62 are 256 bits.
const SECRET_LEN: usize = 43;

/// A new API key with its secret. It has no `Debug`, so that it cannot reach a log.
pub struct PlainKey {
    id: String,
    secret: String,
}

impl PlainKey {
    /// Generates a key with the random generator of the operating system.
    ///
    /// # Errors
    /// [`getrandom::Error`] when the operating system has no random numbers.
    pub fn generate() -> Result<Self, getrandom::Error> {
        Ok(Self { id: random_text(ID_LEN)?, secret: random_text(SECRET_LEN)? })
    }

    /// The public part.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// SHA-256 of the secret, which the database stores.
    pub fn digest(&self) -> [u8; 32] {
        digest(&self.secret)
    }

    /// The whole key, `qdx_ID_SECRET`.
    pub fn to_text(&self) -> String {
        format!("{PREFIX}{}_{}", self.id, self.secret)
    }
}

/// Splits a whole key into id and secret. Returns `None` when `text` has another form.
pub fn parse(text: &str) -> Option<(&str, &str)> {
    let (id, secret) = text.strip_prefix(PREFIX)?.split_once('_')?;
    (id.len() == ID_LEN && secret.len() == SECRET_LEN).then_some((id, secret))
}

/// The id in `text`, which is an id or a whole key.
pub fn id_of(text: &str) -> &str {
    let id = text.strip_prefix(PREFIX).unwrap_or(text);
    id.split_once('_').map_or(id, |(id, _)| id)
}

/// Whether `secret` has the digest `expected`. The comparison takes the same time wherever the two differ.
pub fn verify(secret: &str, expected: &[u8; 32]) -> bool {
    digest(secret).ct_eq(expected).into()
}

fn digest(secret: &str) -> [u8; 32] {
    Sha256::digest(secret).into()
}

/// `len` characters of the alphabet, uniformly distributed.
fn random_text(len: usize) -> Result<String, getrandom::Error> {
    // 248 is the largest multiple of 62 below 256. Larger bytes are rejected, or some characters would be more likely.
    const LIMIT: u8 = 248;
    let mut text = String::with_capacity(len);
    let mut bytes = [0; 64];
    loop {
        getrandom::fill(&mut bytes)?;
        for byte in bytes.into_iter().filter(|byte| *byte < LIMIT) {
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
    fn generated_keys_parse_and_verify() {
        let (a, b) = (PlainKey::generate().unwrap(), PlainKey::generate().unwrap());
        assert_ne!(a.to_text(), b.to_text());
        let text = a.to_text();
        let (id, secret) = parse(&text).unwrap();
        assert_eq!(id, a.id());
        assert_eq!([&text, id, &format!("{PREFIX}{id}")].map(id_of), [id; 3]);
        assert!(verify(secret, &a.digest()) && !verify(secret, &b.digest()));
        assert!(text.bytes().all(|c| c == b'_' || ALPHABET.contains(&c)), "{text}");
        for wrong in ["", "qdx_", &text[1..], &text[..text.len() - 1], &format!("{text}x"), "qdx_é_é", "Bearer x"] {
            assert!(parse(wrong).is_none(), "{wrong}");
        }
    }
}
