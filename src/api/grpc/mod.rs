//! gRPC: the router with all services, including health and reflection.

mod call;
mod deadline;
mod dm_env;
mod environment;
mod health;
mod inference;
mod inflated_body;
mod job;
mod large_messages;
mod metrics;
mod middleware;
mod policy;
mod request_body;
mod stream;
mod upload;
mod worker;

use std::sync::Arc;

use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;
use tonic::service::Routes;

use deadline::deadline;
pub use health::Health;
use large_messages::LargeMessages;
use metrics::Methods;
use middleware::Middleware;

use super::auth::Authorized;
use crate::service::App;
use crate::wire::v1::worker_service_server::{WorkerService, WorkerServiceServer};
use crate::wire::{DESCRIPTORS, dm, oip, v1};

/// Names of the services with a health status.
pub const SERVICES: &[&str] = &[
    v1::policy_service_server::SERVICE_NAME,
    v1::environment_service_server::SERVICE_NAME,
    v1::job_service_server::SERVICE_NAME,
    v1::worker_service_server::SERVICE_NAME,
    oip::grpc_inference_service_server::SERVICE_NAME,
    dm::dm_env_rpc::v1::environment_server::SERVICE_NAME,
];

/// The result of a unary method.
type GrpcResult<T> = Result<tonic::Response<T>, tonic::Status>;

const BUILT_IN: &str = "the descriptors are built into the program";

/// The services with authorization and the middleware for all calls.
pub type Services = Middleware<Authorized<LargeMessages<Routes>>>;

/// All services. Messages larger than `max_message` bytes are refused; `background` handles large ones. Streams end when `closing` is
/// cancelled.
///
/// # Panics
/// If a descriptor set built into the program does not decode.
pub fn services(app: &Arc<App>, health: &Health, max_message: usize, background: Handle, closing: CancellationToken) -> Services {
    let reflection = || {
        let builder = tonic_reflection::server::Builder::configure().register_encoded_file_descriptor_set(DESCRIPTORS);
        builder.register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    let mut routes = Routes::builder();
    routes
        .add_service(policy::service(app.clone()).max_decoding_message_size(max_message))
        .add_service(inference::service(app.clone()).max_decoding_message_size(max_message))
        .add_service(environment::service(app.clone()).max_decoding_message_size(max_message))
        .add_service(dm_env::service(app.clone()).max_decoding_message_size(max_message))
        .add_service(job::service(app.clone()).max_decoding_message_size(max_message))
        .add_service(workers(app, max_message))
        .add_service(health.server())
        .add_service(reflection().build_v1().expect(BUILT_IN))
        .add_service(reflection().build_v1alpha().expect(BUILT_IN));
    wrap(app, routes.routes(), max_message, background, closing)
}

/// Only the service for workers, for an address of its own.
///
/// # Panics
/// As [`services`].
pub fn worker_services(app: &Arc<App>, max_message: usize, background: Handle, closing: CancellationToken) -> Services {
    wrap(app, Routes::new(workers(app, max_message)), max_message, background, closing)
}

fn workers(app: &Arc<App>, max_message: usize) -> WorkerServiceServer<impl WorkerService> {
    worker::service(app.clone()).max_decoding_message_size(max_message.max(worker::MAX_WORKER_MESSAGE))
}

fn wrap(app: &Arc<App>, routes: Routes, max_message: usize, background: Handle, closing: CancellationToken) -> Services {
    use tonic_reflection::pb::{v1, v1alpha};
    let known = [DESCRIPTORS, tonic_health::pb::FILE_DESCRIPTOR_SET, v1::FILE_DESCRIPTOR_SET, v1alpha::FILE_DESCRIPTOR_SET];
    let methods = Methods::new(&known, max_message);
    let inner = LargeMessages::new(routes.prepare(), methods.client_streams(), background);
    Middleware::new(Authorized::new(inner, app.clone()), methods, closing)
}
