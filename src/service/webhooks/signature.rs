//! Signatures of messages, as the specification "Standard Webhooks" describes them, so that receivers verify them with its libraries:
//! HMAC-SHA256 over `ID.TIMESTAMP.BODY`, as Base64 after `v1,`.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, KeyInit, Mac};
use sha2::Sha256;

use crate::store::Secret;

/// Prefix of secrets that are Base64.
const ENCODED: &str = "whsec_";

/// The bytes of a secret: after `whsec_` what the Base64 means, and otherwise its text.
fn key(Secret(secret): &Secret) -> Option<Vec<u8>> {
    match secret.strip_prefix(ENCODED) {
        Some(encoded) => STANDARD.decode(encoded).ok(),
        None => Some(secret.as_bytes().to_vec()),
    }
}

/// The signature of a message; `None`: the secret is not Base64 after `whsec_`.
pub(super) fn sign(secret: &Secret, id: &str, timestamp: i64, body: &str) -> Option<String> {
    let mut mac = Hmac::<Sha256>::new_from_slice(&key(secret)?).ok()?;
    mac.update(format!("{id}.{timestamp}.{body}").as_bytes());
    Some(format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signatures_are_those_of_the_specification() {
        // The example of the specification.
        let secret = Secret("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw".into());
        let signature = sign(&secret, "msg_p5jXN8AQM9LWM0D4loKWxJek", 1_614_265_330, r#"{"test": 2432232314}"#);
        assert_eq!(signature.unwrap(), "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
        assert!(sign(&Secret("plain".into()), "id", 0, "").is_some());
        assert_eq!(sign(&Secret("whsec_?".into()), "id", 0, ""), None);
    }
}
