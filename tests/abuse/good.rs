//! The well-behaved client: 200 `Act` a second with an API key, each slot at its time, in four sessions.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use qedgix::wire::v1;
use qedgix::wire::v1::act_request::{Memory, Observation};
use qedgix::wire::v1::policy_service_client::PolicyServiceClient;
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::transport::{Channel, Endpoint};
use tonic::{Request, Status};

use super::scene;

/// Sessions, each of which sends a slot every 20 ms.
const SESSIONS: u64 = 4;
const PERIOD: Duration = Duration::from_millis(20);
/// A slot without an answer after this time is an error.
const TIMEOUT: Duration = Duration::from_secs(10);

/// What the client has experienced in one phase.
#[derive(Debug, Default)]
pub struct Experience {
    /// Times from the moment at which a slot was due to its answer.
    pub latencies: Vec<Duration>,
    pub errors: Vec<String>,
}

impl Experience {
    /// The latency that this fraction of the slots does not exceed.
    pub fn quantile(&mut self, fraction: f64) -> Duration {
        self.latencies.sort_unstable();
        let at = (self.latencies.len() as f64 * fraction) as usize;
        self.latencies.get(at.min(self.latencies.len().saturating_sub(1))).copied().unwrap_or(Duration::MAX)
    }
}

/// The client, on a thread of its own, until it is stopped.
pub struct Good {
    now: Arc<Mutex<Experience>>,
    _stop: tokio::sync::oneshot::Sender<()>,
}

impl Good {
    pub fn start(grpc: &str, key: &str) -> Self {
        let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
        let now = Arc::<Mutex<Experience>>::default();
        let (endpoint, key) =
            (Endpoint::from_shared(format!("http://{grpc}")).unwrap(), format!("Bearer {key}").parse().unwrap());
        let shared = Arc::clone(&now);
        std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(async {
                let client = Client { policies: PolicyServiceClient::new(endpoint.connect_lazy()), key, now: shared };
                let mut sessions: JoinSet<()> = (0..SESSIONS).map(|number| client.clone().fly(number)).collect();
                tokio::select! {
                    // Its end is the end of `Good`.
                    _ = stopped => {}
                    ended = sessions.join_next() => panic!("sessions do not end: {ended:?}"),
                }
            });
        });
        Self { now, _stop: stop }
    }

    /// What the client has experienced since this was called last.
    pub fn experience(&self) -> Experience {
        std::mem::take(&mut *self.now.lock().unwrap())
    }
}

#[derive(Clone)]
struct Client {
    policies: PolicyServiceClient<Channel>,
    key: MetadataValue<Ascii>,
    now: Arc<Mutex<Experience>>,
}

impl Client {
    fn signed<T>(&self, message: T) -> Request<T> {
        let mut request = Request::new(message);
        request.metadata_mut().insert("authorization", self.key.clone());
        request.set_timeout(TIMEOUT);
        request
    }

    async fn fly(mut self, number: u64) {
        let id = format!("good-{number}");
        let open = v1::OpenSessionRequest {
            policy: "qedgix".into(),
            session_id: id.clone(),
            run_id: None,
            seed: Some(number),
            ..Default::default()
        };
        let request = self.signed(open);
        if let Err(status) = self.policies.open_session(request).await {
            self.fail("opening a session", &status);
        }
        // The sessions take turns.
        tokio::time::sleep(PERIOD / SESSIONS as u32 * number as u32).await;
        let mut ticks = tokio::time::interval(PERIOD);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Burst);
        for step in 0.. {
            let due: Instant = ticks.tick().await.into();
            let request = self.signed(v1::ActRequest {
                observation: Some(Observation::Scene(scene(3, 5, step))),
                memory: Some(Memory::SessionId(id.clone())),
                step: Some(step),
                ..Default::default()
            });
            match self.policies.act(request).await {
                Ok(_) => self.now.lock().unwrap().latencies.push(due.elapsed()),
                Err(status) => self.fail("a slot", &status),
            }
        }
    }

    fn fail(&self, what: &str, status: &Status) {
        self.now.lock().unwrap().errors.push(format!("{what}: {:?} {}", status.code(), status.message()));
    }
}
