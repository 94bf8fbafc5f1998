//! The addresses that a caller wants to be told when a job ends.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Serialize};
use url::Url;

use crate::invalid::{Invalid, in_range};
pub use crate::store::Secret;
use crate::store::{JobEnd, Webhook};

/// Most webhooks of a job.
const MAX_WEBHOOKS: usize = 8;
/// Most characters of a URL, and of a secret.
const MAX_URL: usize = 2000;
const MAX_SECRET: usize = 255;

/// A webhook as it is submitted.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WebhookRequest {
    /// The address.
    pub url: String,
    /// The ends after which a message is sent; default: all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub events: Option<Vec<JobEnd>>,
    /// Key of the signatures; default: messages are not signed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub secret: Option<Secret>,
}

impl WebhookRequest {
    fn resolve(self, path: &str) -> Result<Webhook, Invalid> {
        let field = |name: &str| format!("{path}.{name}");
        check_url(&field("url"), &self.url)?;
        let ends = [JobEnd::Succeeded, JobEnd::Failed, JobEnd::Cancelled];
        let events = self.events.unwrap_or_else(|| ends.to_vec());
        in_range(&field("events"), events.len(), 1..=ends.len())?;
        for (i, event) in events.iter().enumerate() {
            if events[..i].contains(event) {
                return Err(Invalid::new(field(&format!("events[{i}]")), event, "succeeded, failed and cancelled, each once"));
            }
        }
        if self.secret.as_ref().is_some_and(|secret| !is_secret(secret)) {
            let expected = format!("1 to {MAX_SECRET} printable ASCII characters, and Base64 after whsec_");
            return Err(Invalid::new(field("secret"), "a secret", expected));
        }
        Ok(Webhook { url: self.url, events, signed: self.secret.is_some(), secret: self.secret })
    }
}

/// Resolves the webhooks of a job.
///
/// # Errors
/// The first field that is not accepted.
pub(super) fn resolve(webhooks: Vec<WebhookRequest>) -> Result<Vec<Webhook>, Invalid> {
    in_range("webhooks", webhooks.len(), 0..=MAX_WEBHOOKS)?;
    webhooks.into_iter().enumerate().map(|(i, webhook)| webhook.resolve(&format!("webhooks[{i}]"))).collect()
}

fn check_url(field: &str, text: &str) -> Result<(), Invalid> {
    let expected = format!("an http or https URL of at most {MAX_URL} characters, without user and password");
    let url = Url::parse(text).ok().filter(|_| text.len() <= MAX_URL);
    match url {
        // The value could contain the password.
        Some(url) if !url.username().is_empty() || url.password().is_some() => {
            Err(Invalid::new(field, "a URL with a user or a password", expected))
        }
        Some(url) if matches!(url.scheme(), "http" | "https") && url.has_host() => Ok(()),
        _ => Err(Invalid::new(field, format!("{text:?}"), expected)),
    }
}

fn is_secret(Secret(secret): &Secret) -> bool {
    let printable = (1..=MAX_SECRET).contains(&secret.len()) && secret.bytes().all(|b| b.is_ascii_graphic());
    printable && secret.strip_prefix("whsec_").is_none_or(|encoded| STANDARD.decode(encoded).is_ok())
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn read(document: Value) -> Result<Vec<Webhook>, Invalid> {
        resolve(serde_json::from_value(json!([document])).unwrap())
    }

    #[test]
    fn secrets_are_neither_stored_with_the_job_nor_printed() {
        let webhooks = read(json!({"url": "https://example.org/?a=b", "secret": "hunter2"})).unwrap();
        assert_eq!(webhooks[0].events.len(), 3);
        assert!(webhooks[0].signed);
        let texts = [serde_json::to_string(&webhooks).unwrap(), format!("{webhooks:?}")];
        assert!(texts.iter().all(|text| !text.contains("hunter2")), "{texts:?}");
    }

    #[test]
    fn invalid_webhooks_are_reported_by_name() {
        let url = "https://example.org";
        for (document, field) in [
            (json!({}), "url"),
            (json!({"url": "example.org"}), "url"),
            (json!({"url": "ftp://example.org"}), "url"),
            (json!({"url": "file:///etc/passwd"}), "url"),
            (json!({"url": "https://me:hunter2@example.org"}), "url"),
            (json!({"url": format!("https://example.org/{}", "x".repeat(2000))}), "url"),
            (json!({"url": url, "events": []}), "events"),
            (json!({"url": url, "events": ["failed", "failed"]}), "events[1]"),
            (json!({"url": url, "secret": ""}), "secret"),
            (json!({"url": url, "secret": "hunter 2"}), "secret"),
            (json!({"url": url, "secret": "whsec_hunter2!"}), "secret"),
        ] {
            let error = read(document.clone()).unwrap_err();
            assert_eq!(error.field, format!("webhooks[0].{field}"), "{document}");
            assert!(!error.to_string().contains("hunter"), "{error}");
        }
        assert_eq!(resolve(vec![WebhookRequest::default(); 9]).unwrap_err().field, "webhooks");
    }
}
