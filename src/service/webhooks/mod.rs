//! Tells the receivers of webhooks that jobs have ended. The messages are in the database; this sends them until they are accepted.

mod address;
mod signature;

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use futures::future::join_all;
use hyper_rustls::ConfigBuilderExt;
use jiff::Timestamp;
use reqwest::header::CONTENT_TYPE;
use reqwest::redirect::Policy;
use reqwest::{StatusCode, Url};
use rustls::{ClientConfig, RootCertStore};

use self::address::AllowedReceivers;
use super::App;
use crate::causes;
use crate::invalid::Invalid;
use crate::store::{self, Webhook, WebhookMessage};

/// Time for a message to be sent and the status of the response to arrive.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Time between a failed try and the next one: at first, doubled by every further one, and at most.
const FIRST_DELAY: Duration = Duration::from_secs(5);
const LONGEST_DELAY: Duration = Duration::from_secs(3600);
/// Age at which a message is given up.
const GIVEN_UP_AFTER: Duration = Duration::from_secs(24 * 3600);
/// Messages that are sent at once.
const AT_ONCE: u32 = 16;
/// Time between two tries to use a database that fails.
const RETRY_DELAY: Duration = Duration::from_secs(1);

/// Sends messages to the receivers that the operator permits.
#[derive(Debug)]
pub struct Webhooks {
    allowed: AllowedReceivers,
    /// Time between the first try and the second.
    first_delay: Duration,
    /// Made with the first message.
    client: OnceLock<Result<reqwest::Client, String>>,
}

impl Webhooks {
    /// Besides public addresses, messages may go to these hosts.
    pub fn new(allowed: &[String]) -> Self {
        Self { allowed: AllowedReceivers::new(allowed), first_delay: FIRST_DELAY, client: OnceLock::new() }
    }

    /// With this time between the first try of a message and the second.
    pub fn retrying_after(self, first_delay: Duration) -> Self {
        Self { first_delay, ..self }
    }

    /// The time before the next try of a message after this many failed ones.
    fn delay(&self, tries: u32) -> Duration {
        let factor = 1_u32.checked_shl(tries.saturating_sub(1)).unwrap_or(u32::MAX);
        self.first_delay.saturating_mul(factor).min(LONGEST_DELAY)
    }

    /// Checks the addresses of a new job.
    ///
    /// # Errors
    /// [`Invalid`] for the first one that messages may not go to.
    pub(super) fn check(&self, webhooks: &[Webhook]) -> Result<(), Invalid> {
        for (i, webhook) in webhooks.iter().enumerate() {
            let field = format!("webhooks[{i}].url");
            let url = webhook.url.parse().map_err(|e| Invalid::new(&field, e, "a URL"))?;
            self.allowed.check(&field, &url)?;
        }
        Ok(())
    }

    fn client(&self) -> Result<&reqwest::Client, String> {
        self.client.get_or_init(|| client(self.allowed.clone()).map_err(|e| causes::text(&*e))).as_ref().map_err(Clone::clone)
    }

    /// Sends a message once. An error says why it was not accepted, and whether another try can succeed.
    async fn send(&self, message: &WebhookMessage, now: Timestamp) -> Result<(), (String, bool)> {
        let again = |reason: String| (reason, true);
        let url: Url = message.url.parse().map_err(|_| ("the URL cannot be read".to_owned(), false))?;
        // Addresses in URLs are not resolved. The setting may have changed since the submission.
        self.allowed.check("url", &url).map_err(|e| again(e.to_string()))?;
        let request = self.client().map_err(again)?.post(url).header(CONTENT_TYPE, "application/json");
        let request = request.header("webhook-id", &message.id).header("webhook-timestamp", now.as_second());
        let request = match &message.secret {
            Some(secret) => {
                let signature = signature::sign(secret, &message.id, now.as_second(), &message.body);
                request.header("webhook-signature", signature.ok_or_else(|| ("the secret cannot be read".to_owned(), false))?)
            }
            None => request,
        };
        // The body of the response is not read.
        let sent = request.body(message.body.clone()).send().await;
        let status = sent.map_err(|e| again(causes::text(&e.without_url())))?.status();
        match status {
            _ if status.is_success() => Ok(()),
            StatusCode::GONE => Err((format!("the receiver answered {status}"), false)),
            _ => Err(again(format!("the receiver answered {status}"))),
        }
    }
}

fn client(allowed: AllowedReceivers) -> Result<reqwest::Client, Box<dyn std::error::Error + Send + Sync>> {
    let builder = ClientConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()));
    let builder = builder.with_safe_default_protocol_versions()?;
    // A machine may have no certificate authorities. Then every message over TLS fails, and says so.
    let tls = match builder.clone().with_native_roots() {
        Ok(builder) => builder.with_no_client_auth(),
        Err(_) => builder.with_root_certificates(RootCertStore::empty()).with_no_client_auth(),
    };
    let client = reqwest::Client::builder()
        .tls_backend_preconfigured(tls)
        .dns_resolver(Arc::new(allowed))
        // A redirect could lead to an address that is not allowed.
        .redirect(Policy::none())
        .no_proxy()
        .pool_max_idle_per_host(0)
        .http1_only()
        .timeout(TIMEOUT)
        .user_agent(concat!("qedgix/", env!("CARGO_PKG_VERSION")));
    Ok(client.build()?)
}

/// Sends messages as they become due. Those that wait when the server starts are due at once. Runs until it is dropped.
pub async fn deliver(app: &App) {
    let mut changes = app.store.any_changes();
    let mut hurried = false;
    loop {
        changes.borrow_and_update();
        let sent = async {
            if !hurried {
                app.store.hurry_webhook_messages(app.clock.now()).await?;
                hurried = true;
            }
            send_due(app).await
        };
        let wait = match sent.await {
            Ok(next) => next.map(|next| Duration::try_from(next.duration_since(app.clock.now())).unwrap_or_default()),
            Err(error) => {
                tracing::warn!(%error, "messages of webhooks cannot be read or recorded; trying again");
                Some(RETRY_DELAY)
            }
        };
        let due = async {
            match wait {
                Some(wait) => app.clock.sleep_until(app.clock.monotonic().saturating_add(wait)).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            _ = changes.changed() => {}
            () = due => {}
        }
    }
}

/// Sends the messages that are due. Returns when the next one is.
async fn send_due(app: &App) -> Result<Option<Timestamp>, store::Error> {
    loop {
        let due = app.store.due_webhook_messages(app.clock.now(), AT_ONCE).await?;
        if due.is_empty() {
            return app.store.next_webhook_message().await;
        }
        for recorded in join_all(due.iter().map(|message| send_and_record(app, message))).await {
            recorded?;
        }
    }
}

async fn send_and_record(app: &App, message: &WebhookMessage) -> Result<(), store::Error> {
    let WebhookMessage { row_id, id, job, created_at, tries, .. } = message;
    let result = app.webhooks.send(message, app.clock.now()).await;
    let now = app.clock.now();
    let count = |result: &'static str| metrics::counter!("qedgix_webhook_messages_total", "result" => result).increment(1);
    let (reason, again) = match result {
        Ok(()) => {
            count("delivered");
            tracing::info!(job, message = id, "the receiver of a webhook was told");
            return app.store.delete_webhook_message(*row_id).await;
        }
        Err(failed) => failed,
    };
    let delay = app.webhooks.delay(tries + 1);
    let age = Duration::try_from(now.duration_since(*created_at)).unwrap_or_default();
    if !again || age.saturating_add(delay) > GIVEN_UP_AFTER {
        count("given_up");
        tracing::warn!(job, message = id, reason, "the receiver of a webhook cannot be told; giving up");
        return app.store.delete_webhook_message(*row_id).await;
    }
    count("failed");
    tracing::info!(job, message = id, reason, ?delay, "the receiver of a webhook could not be told; trying again");
    let next = now.saturating_add(jiff::SignedDuration::try_from(delay).unwrap_or(jiff::SignedDuration::MAX));
    app.store.retry_webhook_message(*row_id, next.unwrap_or(Timestamp::MAX)).await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tries_become_rare_and_end() {
        let webhooks = Webhooks::new(&[]);
        let delay = |tries| webhooks.delay(tries);
        assert_eq!([1, 2, 3, 40].map(|tries| delay(tries).as_secs()), [5, 10, 20, 3600]);
        let mut tries = 0;
        let mut age = Duration::ZERO;
        while age + delay(tries + 1) <= GIVEN_UP_AFTER {
            tries += 1;
            age += delay(tries);
        }
        assert!((20..50).contains(&tries), "{tries} tries in a day");
    }
}
