//! The agent of a stream: which world it has joined, and where it is in its sequence.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde_json::{Map, Value};

use super::fleet::{self, HEADINGS};
use super::properties;
use super::tensors::{headings, settings};
use crate::env::{EnvConfig, EpisodeMetrics};
use crate::error_code::ErrorCode;
use crate::invalid::Invalid;
use crate::service::environments::{self, NewEnvironment};
use crate::service::keys::Caller;
use crate::service::{App, Error};
use crate::serving::{EnvironmentReset, EnvironmentStep, Owner};
use crate::wire::dm::dm_env_rpc::v1 as wire;
use wire::environment_request::Payload as Request;
use wire::environment_response::Payload as Response;
use wire::{ActionObservationSpecs, EnvironmentStateType as State};

/// The worlds that agents have joined, with the number of their resets since.
#[derive(Clone, Default)]
pub(super) struct Joined(Arc<Mutex<HashMap<(Owner, String), u64>>>);

impl Joined {
    fn lock(&self) -> MutexGuard<'_, HashMap<(Owner, String), u64>> {
        // Nothing panics while holding the lock.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a world, unless an agent has joined it.
    fn add(&self, world: &(Owner, String)) -> bool {
        let mut all = self.lock();
        let is_new = !all.contains_key(world);
        all.entry(world.clone()).or_default();
        is_new
    }

    fn has(&self, world: &(Owner, String)) -> bool {
        self.lock().contains_key(world)
    }
}

/// A world that the agent has joined. Dropping it leaves the world.
struct World {
    joined: Joined,
    key: (Owner, String),
    config: EnvConfig,
    state: State,
    /// Resets of the world that the agent has taken notice of.
    resets: u64,
    seed: Option<u64>,
    /// Headings of the last step.
    headings: Vec<u32>,
    /// Metrics and seed of the last episode that ended.
    finished: Option<(EpisodeMetrics, u64)>,
}

impl Drop for World {
    fn drop(&mut self) {
        self.joined.lock().remove(&self.key);
    }
}

/// The agent.
pub(super) struct Agent {
    app: Arc<App>,
    caller: Caller,
    joined: Joined,
    world: Option<World>,
}

fn wrong_state(message: impl Into<String>) -> Error {
    Error::Precondition { code: ErrorCode::WrongState, message: message.into() }
}

/// The seed in settings, which have nothing else.
fn seed(mut settings: Map<String, Value>) -> Result<Option<u64>, Invalid> {
    let seed = settings
        .remove("seed")
        .map(|seed| seed.as_u64().ok_or_else(|| Invalid::new("settings.seed", &seed, "a whole number, 0 or more")));
    match settings.keys().next() {
        None => seed.transpose(),
        Some(name) => Err(Invalid::unknown_field(format!("settings.{name}"), "one of seed")),
    }
}

impl Agent {
    /// An agent that has joined no world.
    pub(super) fn new(app: Arc<App>, caller: Caller, joined: Joined) -> Self {
        Self { app, caller, joined, world: None }
    }

    /// Answers a request.
    ///
    /// # Errors
    /// As the use cases of environments; `wrong_state` where no world is joined, or one is that should not be.
    pub(super) async fn answer(&mut self, request: wire::EnvironmentRequest) -> Result<Response, Error> {
        let Some(request) = request.payload else {
            return Err(Invalid::missing("payload", "a request").into());
        };
        Ok(match request {
            Request::CreateWorld(request) => Response::CreateWorld(self.create(request).await?),
            Request::JoinWorld(request) => Response::JoinWorld(wire::JoinWorldResponse { specs: Some(self.join(request)?) }),
            Request::Step(request) => Response::Step(self.step(request).await?),
            Request::Reset(request) => Response::Reset(wire::ResetResponse { specs: Some(self.reset(request)?) }),
            Request::ResetWorld(request) => {
                self.reset_world(request).await?;
                Response::ResetWorld(wire::ResetWorldResponse {})
            }
            Request::LeaveWorld(_) => {
                self.world = None;
                Response::LeaveWorld(wire::LeaveWorldResponse {})
            }
            Request::DestroyWorld(request) => {
                self.destroy(request).await?;
                Response::DestroyWorld(wire::DestroyWorldResponse {})
            }
            Request::Extension(request) => {
                let world = self.world.as_ref();
                let world = world.map(|world| (&world.config, world.finished.as_ref()));
                Response::Extension(properties::answer(&request, world)?)
            }
        })
    }

    fn key(&self, world: String) -> (Owner, String) {
        (self.caller.owner().clone(), world)
    }

    /// Settings are the fields of the configuration, and `seed`.
    async fn create(&self, request: wire::CreateWorldRequest) -> Result<wire::CreateWorldResponse, Error> {
        let mut settings = settings(request.settings)?;
        let seed = seed(settings.remove("seed").map(|seed| ("seed".to_owned(), seed)).into_iter().collect())?;
        let config = crate::train_config::parse_environment(Value::Object(settings.clone()))
            .map_err(|e| Invalid { field: e.field.replacen("environment", "settings", 1), ..e })?;
        fleet::check_size(&config)?;
        let new = NewEnvironment {
            id: None,
            environment: Value::Object(settings),
            seed: seed.unwrap_or(0),
            count: 1,
            auto_reset: false,
        };
        let created = environments::create(&self.app, &self.caller, new).await?;
        Ok(wire::CreateWorldResponse { world_name: created.id })
    }

    fn join(&mut self, request: wire::JoinWorldRequest) -> Result<ActionObservationSpecs, Error> {
        let wire::JoinWorldRequest { world_name, settings } = request;
        if let Some(world) = &self.world {
            return Err(wrong_state(format!("this stream has joined world {:?}; leave it first", world.key.1)));
        }
        if let Some(name) = settings.keys().next() {
            return Err(Invalid::unknown_field(format!("settings.{name}"), "no settings").into());
        }
        let key = self.key(world_name);
        let info = environments::get(&self.app, &self.caller, &key.1)?;
        if info.owner != key.0 || info.spec.copies != 1 || info.spec.auto_reset {
            let message = format!("environment {:?} is not a world: it was not made by CreateWorld of this owner", key.1);
            return Err(wrong_state(message));
        }
        let config = info.spec.config;
        fleet::check_size(&config)?;
        if !self.joined.add(&key) {
            return Err(wrong_state(format!("another stream has joined world {:?}; its agent flies all UAVs", key.1)));
        }
        let specs = fleet::specs(&config);
        let headings = vec![0; config.uavs];
        let joined = self.joined.clone();
        self.world =
            Some(World { joined, key, config, state: State::Interrupted, resets: 0, seed: None, headings, finished: None });
        Ok(specs)
    }

    fn joined_world(&mut self) -> Result<&mut World, Error> {
        self.world.as_mut().ok_or_else(|| wrong_state("this stream has joined no world"))
    }

    async fn step(&mut self, request: wire::StepRequest) -> Result<wire::StepResponse, Error> {
        let (app, caller) = (self.app.clone(), self.caller.clone());
        let world = self.joined_world()?;
        let wire::StepRequest { actions, requested_observations: requested } = request;
        fleet::check_requested(&requested)?;
        let resets = world.joined.lock().get(&world.key).copied().unwrap_or(0);
        let interrupted = resets != std::mem::replace(&mut world.resets, resets) && world.state == State::Running;
        let name = world.key.1.clone();
        let state = if world.state == State::Running && !interrupted {
            let headings = world.headings(actions)?;
            let step = EnvironmentStep { actions: vec![headings.clone()], step: None, graph: true };
            let state = environments::step(&app, &caller, &name, step).await?;
            world.headings = headings;
            state
        } else {
            // The actions are ignored, and a sequence begins: the next episode, or the current one if it is at slot 0.
            let reset = EnvironmentReset { seed: world.seed.take(), episode: None, graph: true };
            environments::reset(&app, &caller, &name, reset).await?
        };
        let finished = state.copies.first().and_then(|copy| copy.finished.as_ref());
        world.finished = finished.map(|finished| (finished.metrics, finished.seed)).or(world.finished.take());
        // An episode ends at a time limit, which is no natural end: learners bootstrap from its last slot.
        world.state = if interrupted || finished.is_some() { State::Interrupted } else { State::Running };
        let observations = fleet::observe(&world.config, &state, &requested);
        Ok(wire::StepResponse { state: world.state.into(), observations })
    }

    fn reset(&mut self, request: wire::ResetRequest) -> Result<ActionObservationSpecs, Error> {
        let world = self.joined_world()?;
        world.seed = seed(settings(request.settings)?)?.or(world.seed);
        world.state = State::Interrupted;
        Ok(fleet::specs(&world.config))
    }

    async fn reset_world(&self, request: wire::ResetWorldRequest) -> Result<(), Error> {
        let seed = seed(settings(request.settings)?)?;
        let reset = EnvironmentReset { seed, episode: None, graph: false };
        environments::reset(&self.app, &self.caller, &request.world_name, reset).await?;
        if let Some(resets) = self.joined.lock().get_mut(&self.key(request.world_name)) {
            *resets += 1;
        }
        Ok(())
    }

    async fn destroy(&self, request: wire::DestroyWorldRequest) -> Result<(), Error> {
        let key = self.key(request.world_name);
        if self.joined.has(&key) {
            return Err(wrong_state(format!("a stream has joined world {:?}; leave it first", key.1)));
        }
        environments::delete(&self.app, &self.caller, &key.1).await?;
        Ok(())
    }
}

impl World {
    /// The headings of an action; without one, those of the last step.
    fn headings(&self, mut actions: HashMap<u64, wire::Tensor>) -> Result<Vec<u32>, Invalid> {
        let sent = actions.remove(&HEADINGS);
        if let Some(uid) = actions.keys().next() {
            return Err(Invalid::new("actions", uid, format!("{HEADINGS}, the only action")));
        }
        match sent {
            None => Ok(self.headings.clone()),
            Some(action) => headings(action, self.config.uavs, self.config.actions()),
        }
    }
}
