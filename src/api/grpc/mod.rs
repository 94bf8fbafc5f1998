//! gRPC: all services on one router, health and reflection included.

mod deadline;
mod envelope;
mod environment;
mod inference;
mod job;
mod policy;
mod stream;
mod worker;

use std::sync::Arc;

use tonic::service::Routes;
use tonic_health::pb::health_server::{Health, HealthServer};

pub use deadline::stamp;
use deadline::{Deadline, deadline};

use crate::api::observe::Meters;
use crate::service::App;
use crate::wire::{DESCRIPTORS, oip, v1};

/// Names of the services that health tells about.
pub const SERVICES: &[&str] = &[
    v1::policy_service_server::SERVICE_NAME,
    v1::environment_service_server::SERVICE_NAME,
    v1::job_service_server::SERVICE_NAME,
    v1::worker_service_server::SERVICE_NAME,
    oip::grpc_inference_service_server::SERVICE_NAME,
];

const BUILT_IN: &str = "the descriptors are built into the program";

/// All services. A message larger than `max_message` bytes is refused.
///
/// # Panics
/// When the descriptor set built into the program does not decode; a test would have failed before.
pub fn routes<H: Health>(app: &Arc<App>, health: HealthServer<H>, max_message: usize) -> Routes {
    let reflection = || {
        let builder = tonic_reflection::server::Builder::configure().register_encoded_file_descriptor_set(DESCRIPTORS);
        builder.register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    let mut routes = Routes::builder();
    routes
        .add_service(policy::service(app.clone()).max_decoding_message_size(max_message))
        .add_service(inference::service(app.clone()).max_decoding_message_size(max_message))
        .add_service(environment::service(app.clone()).max_decoding_message_size(max_message))
        .add_service(job::service(app.clone()).max_decoding_message_size(max_message))
        .add_service(worker::service(app.clone()).max_decoding_message_size(max_message.max(worker::LARGEST_MESSAGE)))
        .add_service(health)
        .add_service(reflection().build_v1().expect(BUILT_IN))
        .add_service(reflection().build_v1alpha().expect(BUILT_IN));
    let meters = Arc::new(Meters::new("grpc"));
    let around = move |request, next| envelope::around(meters.clone(), request, next);
    let router = routes.routes().into_axum_router().layer(axum::middleware::from_fn(around));
    Routes::from(router)
}
