"""What a server answers: decisions, sessions, states of environments, policies, jobs and metrics."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from functools import cached_property
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from .v1 import environment_pb2, policy_pb2

__all__ = [
    "AliasMove",
    "Attempt",
    "Checkpoint",
    "Decision",
    "EnvironmentState",
    "FinishedEpisode",
    "JobEvent",
    "Metric",
    "Metrics",
    "Overruled",
    "Policy",
    "PolicyRef",
    "PolicyVersion",
    "SessionInfo",
    "SessionWarning",
    "Timings",
    "directions",
]

Floats = NDArray[np.float64]

# Unit vectors of the headings 0 .. 7, and of hover (8).
_ANGLES = np.deg2rad(45.0 * np.arange(8))
_DIRECTIONS = np.concatenate([np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1), np.zeros((1, 2))])


def directions(headings: NDArray[np.integer[Any]] | Sequence[int]) -> Floats:
    """Unit vectors (..., 2) of heading indices (...): (1, 0) for 0, (0, 1) for 2; zeros for hover (8)."""
    vectors: Floats = _DIRECTIONS[np.asarray(headings)]
    return vectors


class PolicyRef(NamedTuple):
    """Exactly one version of a policy."""

    name: str
    version: int
    digest: str
    """SHA-256 of the checkpoint in hexadecimal."""

    def __str__(self) -> str:
        return f"{self.name}:{self.version}"

    @staticmethod
    def of(ref: policy_pb2.PolicyRef) -> PolicyRef:
        """From a message."""
        return PolicyRef(ref.name, ref.version, ref.digest)


class Timings(NamedTuple):
    """Where the time of a decision went. A repeated step has the timings of its first computation."""

    queue: float
    """Seconds in the queue of the engine."""
    compute: float
    """Seconds of the forward pass."""
    batch_size: int
    """Number of fleets in the forward pass."""


class Overruled(NamedTuple):
    """What constraints did to the heading of a UAV. Constraints are named as the fields of `Constraints`."""

    preferred_heading: int
    """The heading that the policy prefers."""
    because: tuple[str, ...]
    """The constraints that it would break, given the headings of the other UAVs."""
    violates: tuple[str, ...]
    """The constraints that the heading of the decision breaks: no heading keeps all."""

    @staticmethod
    def of(overruled: policy_pb2.Overruled) -> Overruled:
        """From a message."""

        def names(constraints: Iterable[policy_pb2.Constraint]) -> tuple[str, ...]:
            known = map(policy_pb2.Constraint.Name, constraints)
            return tuple(name.removeprefix("CONSTRAINT_").lower() for name in known)

        return Overruled(overruled.preferred_heading_index, names(overruled.because), names(overruled.violates))


class Influence(NamedTuple):
    """What one detection, or one message of another UAV, means for a heading."""

    node_id: str
    """The node that the UAV detects, or the UAV that sends the message."""
    message: bool
    """Whether it is the message of the node: what it detects and remembers."""
    change: float
    """The Q-value of the heading minus that without the detection or message. Positive: it speaks for the heading."""


class Decision:
    """The headings of one fleet for one slot, in the order of the UAVs in the observation."""

    __slots__ = ("_headings", "message")

    def __init__(self, message: policy_pb2.ActResponse) -> None:
        self.message = message
        """The message of the protocol."""
        self._headings: NDArray[np.int64] | None = None

    @property
    def uav_ids(self) -> list[str]:
        """Ids of the M UAVs."""
        return [action.uav_id for action in self.message.actions]

    @property
    def headings(self) -> NDArray[np.int64]:
        """(M,) heading indices: h is the direction 45 h degrees counter-clockwise from +x; 8 is hover."""
        if self._headings is None:
            self._headings = np.array([action.heading_index for action in self.message.actions], np.int64)
        return self._headings

    @property
    def degrees(self) -> Floats:
        """(M,) directions in degrees, counter-clockwise from +x; NaN for hover."""
        actions = self.message.actions
        return np.array([action.heading_deg if action.HasField("heading_deg") else np.nan for action in actions])

    @property
    def directions(self) -> Floats:
        """(M, 2) unit vectors; zeros for hover. A UAV moves by its speed times this vector in the slot."""
        angles = np.deg2rad(self.degrees)
        return np.nan_to_num(np.stack([np.cos(angles), np.sin(angles)], axis=-1), nan=0.0)

    @property
    def by_id(self) -> dict[str, int]:
        """Heading index of each UAV, by id."""
        return {action.uav_id: action.heading_index for action in self.message.actions}

    @property
    def q_values(self) -> NDArray[np.float32] | None:
        """(M, A) Q-values of the A headings; None if they were not requested, or if the policy is a baseline."""
        rows = [action.q_values for action in self.message.actions]
        return np.array(rows, np.float32) if rows and len(rows[0]) else None

    @property
    def velocities(self) -> Floats | None:
        """(M, 2) velocities along your axes, per second; None if they were not requested with `motion`."""
        actions = self.message.actions
        if not any(action.HasField("velocity") for action in actions):
            return None
        return np.array([(action.velocity.x, action.velocity.y) for action in actions])

    @property
    def waypoints(self) -> Floats | None:
        """(M, 2) where the UAVs should be after the slot, in your coordinates; NaN for a UAV without a position in the
        observation. None if they were not requested with `motion`."""
        actions = self.message.actions
        if not any(action.HasField("waypoint") for action in actions):
            return None
        known = [action.waypoint if action.HasField("waypoint") else None for action in actions]
        return np.array([(np.nan, np.nan) if at is None else (at.x, at.y) for at in known])

    @property
    def overruled(self) -> dict[str, Overruled]:
        """What constraints did, by id of the UAV; UAVs whose heading is that of the policy and breaks nothing are not in it."""
        return {
            action.uav_id: Overruled.of(action.overruled) for action in self.message.actions if action.HasField("overruled")
        }

    @property
    def influences(self) -> dict[str, list[Influence]]:
        """What speaks for and against the heading of each UAV, by id, the strongest first; empty without `explain`, and for
        policies without Q-values."""
        return {
            action.uav_id: [Influence(of.node_id, of.message, of.change) for of in action.influences]
            for action in self.message.actions
        }

    @property
    def policy(self) -> PolicyRef:
        """The version that decided."""
        return PolicyRef.of(self.message.policy)

    @property
    def step(self) -> int:
        """Index of the slot, from 0."""
        return self.message.step

    @property
    def recurrent_state(self) -> bytes:
        """The recurrent state for the next slot, if the caller keeps it; empty with a session of the server."""
        return self.message.recurrent_state

    @property
    def timings(self) -> Timings:
        """Where the time went on the server."""
        times = self.message.timings
        return Timings(times.queue.ToNanoseconds() / 1e9, times.compute.ToNanoseconds() / 1e9, times.batch_size)

    def __repr__(self) -> str:
        return f"<Decision: step {self.step}, headings {self.headings.tolist()}>"


class SessionWarning(NamedTuple):
    """Something that a caller should know about its session."""

    field: str
    """The field of the request, such as `world.speed`."""
    message: str
    """What it means."""


@dataclass(frozen=True)
class SessionInfo:
    """A session as the server knows it."""

    session_id: str
    policy: PolicyRef
    steps: int
    """Steps in the current run."""
    opened_at: datetime
    ttl: timedelta
    """The session expires after this time without a request."""
    owner: str
    """Id of the API key that made it; empty: no key was required."""
    warnings: tuple[SessionWarning, ...]
    """How the world of the session differs from the one of the policy."""

    @staticmethod
    def of(session: policy_pb2.Session) -> SessionInfo:
        """From a message."""
        # Tools for types take the name of the message for the class of Python.
        warnings: Any = session.warnings
        return SessionInfo(
            session.session_id,
            PolicyRef.of(session.policy),
            session.steps,
            session.opened_at.ToDatetime(timezone.utc),
            session.ttl.ToTimedelta(),
            session.owner,
            tuple(SessionWarning(warning.field, warning.message) for warning in warnings),
        )


class Arrays(NamedTuple):
    """Positions and AoI of the fleets of B copies."""

    uavs: NDArray[np.float32]
    """(B, M, 2), in units of the side of the square."""
    users: NDArray[np.float32]
    """(B, N, 2)."""
    aoi: NDArray[np.float32]
    """(B, N), in slots."""

    @staticmethod
    def of(scenes: Sequence[policy_pb2.Scene]) -> Arrays:
        """From messages of fleets of one size."""
        count = len(scenes)
        uavs = [(uav.x, uav.y) for scene in scenes for uav in scene.uavs]
        users = [(user.x, user.y, user.aoi) for scene in scenes for user in scene.users]
        flat = np.array(users, np.float32).reshape(count, -1, 3)
        return Arrays(np.array(uavs, np.float32).reshape(count, -1, 2), flat[..., :2], flat[..., 2])


@dataclass(frozen=True)
class FinishedEpisode:
    """An episode that a step has completed. AoI is in slots."""

    seed: int
    mean_aoi: float
    """Mean over users and slots, weighted by the weights of the users if they have any."""
    peak_aoi: float
    """Maximum of any user in any slot."""
    p95_aoi: float
    """95th percentile over users and slots."""
    coverage: float
    """Fraction of the users whose data was collected at least once, 0 to 1."""
    fairness: float
    """Jain's fairness index of the mean AoI per user, 0 to 1."""
    scene: policy_pb2.Scene | None = field(repr=False)
    """The final scene, if an automatic reset has replaced it; None: it is the current scene."""

    @property
    def metrics(self) -> dict[str, float]:
        """The metrics by name."""
        names = ("mean_aoi", "peak_aoi", "p95_aoi", "coverage", "fairness")
        return {name: getattr(self, name) for name in names}

    @staticmethod
    def of(finished: environment_pb2.FinishedEpisode) -> FinishedEpisode:
        """From a message."""
        metrics = finished.metrics
        return FinishedEpisode(
            finished.seed,
            metrics.mean_aoi,
            metrics.peak_aoi,
            metrics.p95_aoi,
            metrics.coverage,
            metrics.fairness,
            finished.scene if finished.HasField("scene") else None,
        )


class EnvironmentState:
    """The state of the B copies of an environment after a reset or a step."""

    def __init__(self, message: environment_pb2.EnvironmentState) -> None:
        self.message = message
        """The message of the protocol."""

    @property
    def step(self) -> int:
        """Steps since the last reset."""
        return self.message.step

    @property
    def episode(self) -> int:
        """Index of the episode of the scenes."""
        return self.message.episode

    @property
    def slot(self) -> int:
        """Slots completed in this episode."""
        return self.message.slot

    @property
    def scenes(self) -> list[policy_pb2.Scene]:
        """The current scene of each copy, which `act` accepts unchanged."""
        return [copy.scene for copy in self.message.copies]

    @property
    def graphs(self) -> list[policy_pb2.Graph]:
        """The graph of each copy, which `act` accepts unchanged; empty graphs if they were not requested."""
        return [copy.graph for copy in self.message.copies]

    @cached_property
    def arrays(self) -> Arrays:
        """Positions and AoI of all copies."""
        return Arrays.of(self.scenes)

    @property
    def uavs(self) -> NDArray[np.float32]:
        """(B, M, 2) positions of the UAVs in units of the side of the square."""
        return self.arrays.uavs

    @property
    def users(self) -> NDArray[np.float32]:
        """(B, N, 2) positions of the users."""
        return self.arrays.users

    @property
    def aoi(self) -> NDArray[np.float32]:
        """(B, N) AoI of the users in slots."""
        return self.arrays.aoi

    @cached_property
    def rewards(self) -> NDArray[np.float32]:
        """(B,) rewards of the last step; 0 after a reset."""
        return np.array([copy.reward for copy in self.message.copies], np.float32)

    @cached_property
    def truncated(self) -> NDArray[np.bool_]:
        """(B,) whether the last step was the last one of its episode: a time limit, not a terminal state."""
        return np.array([copy.truncated for copy in self.message.copies], np.bool_)

    @property
    def seeds(self) -> NDArray[np.uint64]:
        """(B,) seed of the episode of each copy. A reset with this seed repeats the episode as episode 0 of copy 0."""
        return np.array([copy.seed for copy in self.message.copies], np.uint64)

    @property
    def finished(self) -> list[FinishedEpisode | None]:
        """The episode that the last step completed, for each copy; None: none."""
        return [FinishedEpisode.of(copy.finished) if copy.HasField("finished") else None for copy in self.message.copies]

    def __repr__(self) -> str:
        return f"<EnvironmentState: {len(self.message.copies)} copies, episode {self.episode}, slot {self.slot}>"


def instant(text: str | None) -> datetime | None:
    """A time of JSON, such as 2026-11-22T12:04:18.472905123Z. Digits after the microseconds are dropped."""
    if text is None:
        return None
    whole, _, fraction = text.removesuffix("Z").partition(".")
    return datetime.fromisoformat(f"{whole}.{fraction[:6]:0<6}").replace(tzinfo=timezone.utc)


def given_instant(text: str) -> datetime:
    """A time of JSON that is always there."""
    found = instant(text)
    assert found is not None
    return found


@dataclass(frozen=True)
class Policy:
    """A policy version with its properties."""

    ref: PolicyRef
    kind: str
    """`checkpoint` or `baseline`."""
    description: str
    uavs: int | None
    """The number of UAVs that the policy requires; None: any number."""
    users: int | None
    """The number of users that the policy requires; None: any number."""
    headings: int
    """8, or 9 if the policy supports hover."""
    needs: str
    """The input that the policy requires: `detections`, `own_positions` or `full_scene`."""
    detection_range: float
    """In units of the side of the square."""
    aliases: list[str]
    """The aliases that point to this version."""
    versions: list[int]
    """The newest 100 versions of this name, oldest first."""
    version_count: int
    loaded: bool
    created_at: datetime
    document: Mapping[str, Any]
    """Everything that the server tells, with `config` and `metrics` of a checkpoint."""

    @staticmethod
    def of(document: Mapping[str, Any]) -> Policy:
        """From JSON."""
        return Policy(
            PolicyRef(**document["ref"]),
            document["kind"].removeprefix("POLICY_KIND_").lower(),
            document["description"],
            document.get("uavs"),
            document.get("users"),
            document["headings"],
            document["needs"].removeprefix("NEEDS_").lower(),
            document["detection_range"],
            document["aliases"],
            document["versions"],
            document["version_count"],
            document["loaded"],
            given_instant(document["created_at"]),
            document,
        )


@dataclass(frozen=True)
class PolicyVersion:
    """A version in the list of a policy."""

    ref: PolicyRef
    loaded: bool
    aliases: list[str]


@dataclass(frozen=True)
class AliasMove:
    """A move of an alias."""

    alias: str
    version: int | None
    """The version that it points to since then; None: it was deleted."""
    previous: int | None
    """The version that it pointed to before; None: it was new."""
    at: datetime
    by: str | None
    """Id of the API key that moved it, where known."""


class Metric(NamedTuple):
    """A number that a job has measured."""

    name: str
    step: int
    """Environment steps completed when it was measured."""
    value: float
    """NaN if it is not finite."""
    at: datetime
    """When the server stored it."""

    @staticmethod
    def of(row: Mapping[str, Any]) -> Metric:
        """From JSON."""
        value = row["value"]
        return Metric(row["name"], row["step"], float("nan") if value is None else value, given_instant(row["at"]))


class Metrics(Sequence[Metric]):
    """The metrics of a job, ordered by name and step."""

    def __init__(self, rows: Sequence[Metric]) -> None:
        self._rows = tuple(rows)

    @overload
    def __getitem__(self, index: int) -> Metric: ...
    @overload
    def __getitem__(self, index: slice) -> Metrics: ...
    def __getitem__(self, index: int | slice) -> Metric | Metrics:
        return Metrics(self._rows[index]) if isinstance(index, slice) else self._rows[index]

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[Metric]:
        return iter(self._rows)

    @property
    def names(self) -> list[str]:
        """Names of the metrics, in order."""
        return list(dict.fromkeys(row.name for row in self._rows))

    def curve(self, name: str) -> tuple[NDArray[np.int64], Floats]:
        """Environment steps (n,) and values (n,) of one metric; empty if the job has not measured it."""
        rows = [row for row in self._rows if row.name == name]
        return np.array([row.step for row in rows], np.int64), np.array([row.value for row in rows], np.float64)

    def to_pandas(self) -> Any:
        """A `pandas.DataFrame` with the columns name, step, value and at. Requires pandas."""
        import pandas

        return pandas.DataFrame(self._rows, columns=list(Metric._fields))

    def __repr__(self) -> str:
        return f"<Metrics: {len(self)} rows of {', '.join(self.names) or 'nothing'}>"


@dataclass(frozen=True)
class JobEvent:
    """An event of a job: a change of its state, or metrics of one report."""

    id: int
    """1, 2, ... in the order of the events of the job."""
    state: str | None
    """The new state; None: the event has metrics."""
    attempt: int
    """Number of the newest attempt at that time, from 1; 0: none, or the event has metrics."""
    reason: str | None
    """Cause of the change of state, if there is one."""
    metrics: Metrics
    """The metrics; empty: the event is a change of state."""

    @staticmethod
    def of(event_id: int, kind: str, data: Mapping[str, Any]) -> JobEvent:
        """From the JSON of a server-sent event."""
        if kind == "state":
            return JobEvent(event_id, data["state"], data["attempt"], data["reason"], Metrics(()))
        return JobEvent(event_id, None, 0, None, Metrics([Metric.of(row) for row in data["metrics"]]))


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint of a job, without its bytes."""

    id: str
    kind: str
    """`best` or `last`."""
    step: int
    """Environment steps completed when it was taken."""
    size: int
    """Bytes."""
    sha256: str
    """SHA-256 of the bytes in hexadecimal."""
    metrics: Mapping[str, float]
    """Metrics of its evaluation."""

    @staticmethod
    def of(document: Mapping[str, Any]) -> Checkpoint:
        """From JSON."""
        return Checkpoint(**{name: document[name] for name in ("id", "kind", "step", "size", "sha256", "metrics")})


@dataclass(frozen=True)
class Attempt:
    """An attempt at a job by one worker process."""

    number: int
    outcome: str | None
    """None: it runs."""
    reason: str | None
    log: str
    """The end of the output of the worker."""
    started_at: datetime
    ended_at: datetime | None
