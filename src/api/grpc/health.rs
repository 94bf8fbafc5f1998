//! `grpc.health.v1.Health`: a status for each service.
//!
//! Replaces the service of `tonic-health`, which violates the protocol in two ways. Here, the watch of an unknown service stays
//! open, and setting a status again without a change sends nothing. While the server drains, every service is `NOT_SERVING`.
//! Watches end when the server closes, so that they do not delay the shutdown.

use std::collections::BTreeMap;
use std::sync::Arc;

use futures::stream::{BoxStream, StreamExt};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status};
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_server::{Health as HealthService, HealthServer};
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};

use super::SERVICES;
use crate::draining::Draining;
use crate::service::operations::{ServerHealth, server_health, server_health_changed};
use crate::service::{App, Error};
use crate::wire::v1;

/// The statuses of all services. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Health {
    /// Whether each service is available, unless the server drains.
    serving: Arc<watch::Sender<BTreeMap<String, bool>>>,
    draining: Draining,
    closing: CancellationToken,
}

fn status(serving: &BTreeMap<String, bool>, service: &str, draining: bool) -> Option<ServingStatus> {
    let serving = *serving.get(service)?;
    Some(if serving && !draining { ServingStatus::Serving } else { ServingStatus::NotServing })
}

impl Health {
    /// Statuses without a service; [`Health::report`] adds them. Once `draining` has begun, every service is `NOT_SERVING`.
    /// Watches end when `closing` is cancelled.
    pub fn new(draining: Draining, closing: CancellationToken) -> Self {
        Self { serving: Arc::default(), draining, closing }
    }

    /// Sets whether `service` is available; `""` is the server as a whole.
    pub fn set(&self, service: &str, serving: bool) {
        self.serving.send_if_modified(|services| services.insert(service.to_owned(), serving) != Some(serving));
    }

    fn status(&self, service: &str) -> Option<ServingStatus> {
        status(&self.serving.borrow(), service, self.draining.begun())
    }

    /// Derives the status of each service from the state of the server.
    pub fn report(&self, health: ServerHealth) {
        let ServerHealth { database, writes, policies, scheduler } = health;
        self.set("", database && writes && policies);
        for &service in SERVICES {
            let serving = match service {
                v1::environment_service_server::SERVICE_NAME => true,
                v1::job_service_server::SERVICE_NAME => database && writes && scheduler,
                v1::worker_service_server::SERVICE_NAME => database,
                // Services that run policies.
                _ => policies,
            };
            self.set(service, serving);
        }
    }

    /// Keeps the statuses up to date.
    pub async fn follow(self, app: Arc<App>) {
        loop {
            server_health_changed(&app).await;
            self.report(server_health(&app).await);
        }
    }

    /// The service.
    pub fn server(&self) -> HealthServer<impl HealthService> {
        HealthServer::new(self.clone())
    }
}

fn response(status: ServingStatus) -> HealthCheckResponse {
    HealthCheckResponse { status: status.into() }
}

#[tonic::async_trait]
impl HealthService for Health {
    async fn check(&self, request: Request<HealthCheckRequest>) -> Result<Response<HealthCheckResponse>, Status> {
        let service = request.into_inner().service;
        let status = self.status(&service);
        Ok(Response::new(response(status.ok_or_else(|| Error::not_found("service", service))?)))
    }

    type WatchStream = BoxStream<'static, Result<HealthCheckResponse, Status>>;

    async fn watch(&self, request: Request<HealthCheckRequest>) -> Result<Response<Self::WatchStream>, Status> {
        let service = request.into_inner().service;
        let (serving, draining, closing) = (self.serving.subscribe(), self.draining.clone(), self.closing.clone());
        let states = futures::stream::unfold((serving, None), move |(mut serving, sent)| {
            let (service, draining, closing) = (service.clone(), draining.clone(), closing.clone());
            async move {
                loop {
                    let drained = draining.begun();
                    let status = status(&serving.borrow_and_update(), &service, drained);
                    let status = status.unwrap_or(ServingStatus::ServiceUnknown);
                    if sent != Some(status) {
                        return Some((Ok(response(status)), (serving, Some(status))));
                    }
                    // The last status is sent before the stream ends.
                    tokio::select! {
                        biased;
                        changed = serving.changed() => changed.ok()?,
                        () = draining.wait(), if !drained => {}
                        () = closing.cancelled() => return None,
                    }
                }
            }
        });
        Ok(Response::new(states.boxed()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn watch(health: &Health, service: &str) -> BoxStream<'static, Result<HealthCheckResponse, Status>> {
        let request = HealthCheckRequest { service: service.to_owned() };
        HealthService::watch(health, Request::new(request)).await.unwrap().into_inner()
    }

    async fn next(states: &mut BoxStream<'static, Result<HealthCheckResponse, Status>>) -> Option<ServingStatus> {
        states.next().await.map(|state| state.unwrap().status())
    }

    #[tokio::test]
    async fn a_watch_sends_changes_only() {
        let closing = CancellationToken::new();
        let health = Health::new(Draining::default(), closing.clone());
        let mut states = watch(&health, "a.Later").await;
        assert_eq!(next(&mut states).await, Some(ServingStatus::ServiceUnknown));
        for _ in 0..3 {
            health.set("a.Later", true);
            health.set("another", true);
        }
        assert_eq!(next(&mut states).await, Some(ServingStatus::Serving));
        health.set("a.Later", false);
        assert_eq!(next(&mut states).await, Some(ServingStatus::NotServing));
        // A change that is reverted before the next poll is not sent.
        health.set("a.Later", true);
        health.set("a.Later", false);
        let mut later = Box::pin(next(&mut states));
        assert!(futures::poll!(&mut later).is_pending());
        health.set("a.Later", true);
        assert_eq!(later.await, Some(ServingStatus::Serving));
    }

    #[tokio::test]
    async fn watches_send_not_serving_before_they_end() {
        let closing = CancellationToken::new();
        let draining = Draining::default();
        let health = Health::new(draining.clone(), closing.clone());
        health.set("", true);
        let (mut known, mut unknown) = (watch(&health, "").await, watch(&health, "nobody").await);
        assert_eq!(next(&mut known).await, Some(ServingStatus::Serving));
        assert_eq!(next(&mut unknown).await, Some(ServingStatus::ServiceUnknown));
        draining.begin();
        closing.cancel();
        health.set("", true);
        assert_eq!(next(&mut known).await, Some(ServingStatus::NotServing));
        assert_eq!(next(&mut known).await, None);
        assert_eq!(next(&mut unknown).await, None);
    }

    #[test]
    fn the_status_of_a_service_depends_on_its_dependencies() {
        let health = Health::new(Draining::default(), CancellationToken::new());
        let is_serving = |service: &str| health.status(service).map(|status| status == ServingStatus::Serving);
        let all = ServerHealth { database: true, writes: true, policies: true, scheduler: true };
        let cases = [
            (all, [true; 5]),
            (ServerHealth { scheduler: false, ..all }, [true, true, true, false, true]),
            // Workers keep calling: they wait for the database.
            (ServerHealth { writes: false, ..all }, [false, true, true, false, true]),
            (ServerHealth { policies: false, ..all }, [false, false, true, true, true]),
            (ServerHealth { database: false, ..all }, [false, true, true, false, false]),
        ];
        for (components, expected) in cases {
            health.report(components);
            let services = [
                "",
                "qedgix.v1.PolicyService",
                "qedgix.v1.EnvironmentService",
                "qedgix.v1.JobService",
                "qedgix.v1.WorkerService",
            ];
            assert_eq!(services.map(|service| is_serving(service).unwrap()), expected, "{components:?}");
        }
        assert_eq!(is_serving("nobody"), None);
    }
}
