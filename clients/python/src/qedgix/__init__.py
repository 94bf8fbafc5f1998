"""Client of Qedgix, a server that selects headings for fleets of UAVs, hosts environments and trains policies.

    import qedgix

    with qedgix.Client("127.0.0.1:50051") as client, client.session("qedgix") as session:
        decision = session.act(qedgix.Scene(uavs, users, aoi))
        uavs += 0.04 * decision.directions

Lengths are in units of the side of the square, AoI in slots, times in seconds. `AsyncClient` is the same for asyncio.
"""

from importlib.metadata import PackageNotFoundError, version

from ._async.client import AsyncClient
from ._async.environments import AsyncEnvironment
from ._async.jobs import AsyncJob, AsyncJobs
from ._async.policies import AsyncPolicies
from ._async.sessions import AsyncActStream, AsyncFleet, AsyncLocalSession, AsyncSession
from ._async.uavs import AsyncUav
from ._settings import Retry
from ._sync.client import Client
from ._sync.environments import Environment
from ._sync.jobs import Job, Jobs
from ._sync.policies import Policies
from ._sync.sessions import ActStream, Fleet, LocalSession, Session
from ._sync.uavs import Uav
from .environments import fleet_env, parallel_env, vector_env
from .errors import (
    AlreadyExists,
    DeadlineExceeded,
    FailedPrecondition,
    Internal,
    InvalidArgument,
    JobEnded,
    NotFound,
    PermissionDenied,
    QedgixError,
    ResourceExhausted,
    TooLarge,
    Unauthenticated,
    Unavailable,
)
from .observations import Graph, Observation, Scene
from .results import (
    AliasMove,
    Attempt,
    Checkpoint,
    Decision,
    EnvironmentState,
    FinishedEpisode,
    Influence,
    JobEvent,
    Metric,
    Metrics,
    Overruled,
    Policy,
    PolicyRef,
    PolicyVersion,
    SessionInfo,
    SessionWarning,
    Timings,
    directions,
)
from .world import Constraints, Frame, World, Zone

try:
    __version__ = version("qedgix")
except PackageNotFoundError:  # from a source tree that is not installed
    __version__ = "0"

__all__ = [
    "ActStream",
    "AliasMove",
    "AlreadyExists",
    "AsyncActStream",
    "AsyncClient",
    "AsyncEnvironment",
    "AsyncFleet",
    "AsyncJob",
    "AsyncJobs",
    "AsyncLocalSession",
    "AsyncPolicies",
    "AsyncSession",
    "AsyncUav",
    "Attempt",
    "Checkpoint",
    "Client",
    "Constraints",
    "DeadlineExceeded",
    "Decision",
    "Environment",
    "EnvironmentState",
    "FailedPrecondition",
    "FinishedEpisode",
    "Fleet",
    "Frame",
    "Graph",
    "Influence",
    "Internal",
    "InvalidArgument",
    "Job",
    "JobEnded",
    "JobEvent",
    "Jobs",
    "LocalSession",
    "Metric",
    "Metrics",
    "NotFound",
    "Observation",
    "Overruled",
    "PermissionDenied",
    "Policies",
    "Policy",
    "PolicyRef",
    "PolicyVersion",
    "QedgixError",
    "ResourceExhausted",
    "Retry",
    "Scene",
    "Session",
    "SessionInfo",
    "SessionWarning",
    "Timings",
    "TooLarge",
    "Uav",
    "Unauthenticated",
    "Unavailable",
    "World",
    "Zone",
    "directions",
    "fleet_env",
    "parallel_env",
    "vector_env",
]
