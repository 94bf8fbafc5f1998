//! Clients whose requests are valid, or nearly so, but too many or too large.

use std::io;
use std::time::Duration;

use futures::future::join_all;
use hyper_util::rt::TokioIo;
use qedgix::wire::v1;
use qedgix::wire::v1::act_request::{Memory, Observation};
use qedgix::wire::v1::policy_service_client::PolicyServiceClient;
use reqwest::Method;
use tonic::transport::{Channel, Endpoint, Uri};
use tonic::{Request, Status};

use super::Attacker;
use crate::scene;
use crate::wire::dial;

/// Deadline of a call.
const DEADLINE: Duration = Duration::from_secs(10);

fn act(policy: &str, uavs: usize, users: usize, seed: u64) -> v1::ActRequest {
    v1::ActRequest {
        policy: policy.into(),
        observation: Some(Observation::Scene(scene(uavs, users, seed))),
        ..Default::default()
    }
}

impl Attacker {
    async fn client(&self) -> io::Result<PolicyServiceClient<Channel>> {
        let (address, from) = (self.target.grpc, self.from);
        let connector = tower::service_fn(move |_: Uri| async move { dial(address, from).await.map(TokioIo::new) });
        let endpoint = Endpoint::from_shared(format!("http://{address}")).unwrap();
        let channel = endpoint.connect_with_connector(connector).await.map_err(io::Error::other)?;
        Ok(PolicyServiceClient::new(channel).max_decoding_message_size(usize::MAX))
    }

    fn signed<T>(&self, message: T) -> Request<T> {
        let mut request = Request::new(message);
        request.metadata_mut().insert("authorization", format!("Bearer {}", self.target.key).parse().unwrap());
        request.set_timeout(DEADLINE);
        request
    }

    fn count<T>(&self, answer: &Result<T, Status>) {
        match answer {
            Ok(_) => self.counts.add(self.client, "answered"),
            Err(status) => self.counts.add(self.client, &format!("{:?}", status.code())),
        }
    }

    /// Sends the request `copies` times at once, `times` times.
    async fn repeat(&self, request: v1::ActRequest, copies: usize, times: usize) -> io::Result<()> {
        let client = self.client().await?;
        join_all((0..copies).map(|_| async {
            let mut client = client.clone();
            for _ in 0..times {
                self.count(&client.act(self.signed(request.clone())).await);
            }
        }))
        .await;
        Ok(())
    }

    pub(super) async fn fly_large_fleets(&self) -> io::Result<()> {
        self.repeat(act("tour", 1024, 1000, 1), 16, 4).await
    }

    pub(super) async fn fly_dense_scenes(&self, round: u64) -> io::Result<()> {
        let policy = ["qedgix", "sweep", "max-aoi"][round as usize % 3];
        self.repeat(act(policy, 1000, 10_000, 1), 8, 4).await
    }

    pub(super) async fn pipeline(&self) -> io::Result<()> {
        const SLOTS: usize = 30_000;
        let mut client = self.client().await?;
        let (slow, small) = (act("sweep", 1024, 1000, 1), act("persistent", 1, 1, 1));
        let slots = std::iter::repeat_n(slow, 3).chain(std::iter::repeat_n(small, SLOTS));
        let mut request = self.signed(futures::stream::iter(slots));
        request.set_timeout(Duration::from_secs(120));
        let mut answers = match client.act_stream(request).await {
            Ok(answers) => answers.into_inner(),
            Err(status) => return Err(io::Error::other(status)),
        };
        loop {
            match answers.message().await {
                Ok(Some(_)) => self.counts.add(self.client, "slots"),
                Ok(None) => return Ok(()),
                Err(status) => {
                    self.count::<()>(&Err(status.clone()));
                    return Err(io::Error::other(status));
                }
            }
        }
    }

    pub(super) async fn open_sessions(&self, round: u64) -> io::Result<()> {
        let client = self.client().await?;
        let template = act("", 1024, 1000, 1);
        join_all((0..4).map(|lane| {
            let (mut client, template) = (client.clone(), &template);
            async move {
                for number in 0..20 {
                    let id = format!("flood-{round}-{lane}-{number}");
                    let policy = if number % 2 == 0 { "tour" } else { "qedgix" };
                    let open = v1::OpenSessionRequest {
                        policy: policy.into(),
                        session_id: id.clone(),
                        run_id: None,
                        seed: None,
                        ..Default::default()
                    };
                    self.count(&client.open_session(self.signed(open)).await);
                    let request = v1::ActRequest { memory: Some(Memory::SessionId(id)), ..template.clone() };
                    self.count(&client.act(self.signed(request)).await);
                }
            }
        }))
        .await;
        Ok(())
    }

    /// Nothing may succeed without a key.
    pub(super) async fn call_without_key(&self, round: u64) -> io::Result<()> {
        let client = self.client().await?;
        join_all((0..16).map(|lane| {
            let mut client = client.clone();
            async move {
                for number in 0..50 {
                    let mut request = Request::new(act("tour", 30, 100, 1));
                    if lane % 2 == 0 {
                        let key = format!("Bearer qdx_{round:08}_{lane:032}{number:032}");
                        request.metadata_mut().insert("authorization", key.parse().unwrap());
                    }
                    let answer = client.act(request).await;
                    assert!(answer.is_err(), "a request without a valid key is answered");
                    self.count(&answer);
                }
            }
        }))
        .await;
        Ok(())
    }

    pub(super) async fn command_from_a_page(&self, round: u64) -> io::Result<()> {
        let client =
            reqwest::Client::builder().local_address(std::net::IpAddr::V4(self.from)).build().map_err(io::Error::other)?;
        for path in ["/v1/jobs", "/v1/act", "/v2/repository/models/qedgix/unload", "/v1/sessions"] {
            let request = client.request(Method::POST, format!("http://{}{path}", self.target.http)).timeout(DEADLINE);
            let request = request.header("origin", "https://elsewhere.example").header("sec-fetch-site", "cross-site");
            let host = if round.is_multiple_of(2) { "elsewhere.example" } else { "localhost" };
            let request = request.header("host", host).header("content-type", "text/plain").body("{}");
            let status = request.send().await.map_err(io::Error::other)?.status();
            assert!(status.is_client_error() || status.is_server_error(), "{path} {status}");
            self.counts.add(self.client, status.as_str());
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
        Ok(())
    }
}
