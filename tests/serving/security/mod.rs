//! Security: API keys and scopes, rates, TLS, limits on connections, and secrecy of keys.

mod access;
mod binary;
mod browser;
mod clocks;
mod connections;
mod keys;
mod owners;
mod rates;
mod tls;

use qedgix::service::keys::{CreatedKey, NewKey, create};
use tonic::Request;

use super::harness::Server;

/// Creates a key that the server already knows when this returns.
async fn make(server: &Server, scopes: &str, change: impl FnOnce(&mut NewKey)) -> CreatedKey {
    let mut new = NewKey {
        name: "of a test".into(),
        scopes: scopes.parse().unwrap(),
        owner: None,
        lifetime: None,
        rate: None,
        burst: None,
    };
    change(&mut new);
    let created = create(&server.app.store, new, server.app.clock.now()).await.unwrap();
    refresh(server).await;
    created
}

async fn key(server: &Server, scopes: &str) -> String {
    make(server, scopes, |_| {}).await.key
}

/// `key` with another last letter: as long, with the same id, and of no key.
fn misspelled(key: &str) -> String {
    let last = if key.ends_with('x') { 'y' } else { 'x' };
    format!("{}{last}", &key[..key.len() - 1])
}

/// Reloads the keys, which the server does every second.
async fn refresh(server: &Server) {
    server.app.keys.refresh(&server.app.store).await.unwrap();
}

/// A gRPC request with an API key.
fn signed<T>(key: &str, message: T) -> Request<T> {
    let mut request = Request::new(message);
    request.metadata_mut().insert("authorization", format!("Bearer {key}").parse().unwrap());
    request
}
