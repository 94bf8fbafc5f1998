"""The asynchronous client."""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any

from .._client import BaseClient
from .._settings import Settings
from .._values import made, several, text, texts
from ..errors import QedgixError
from ..observations import Observation
from ..results import Decision, SessionInfo
from ..v1 import policy_pb2 as pb
from ..world import Constraints, Frame, Surroundings, World
from . import sessions
from .environments import AsyncEnvironment, create_request
from .jobs import AsyncJobs
from .policies import AsyncPolicies
from .sessions import AsyncActStream, AsyncFleet, AsyncLocalSession, AsyncSession
from .transport import AsyncTransport
from .uavs import AsyncUav

if TYPE_CHECKING:
    from typing_extensions import Self


class AsyncClient(BaseClient):
    """A client of one server. Connections are opened when they are first used, and kept.

    Example:
        >>> async with AsyncClient() as client, client.session("qedgix") as session:
        ...     decision = await session.act(Scene(uavs, users, aoi))
    """

    def _begin(self, settings: Settings) -> None:
        self._transport = AsyncTransport(settings)
        self.jobs = AsyncJobs(self._transport)
        """Training jobs."""
        self.policies = AsyncPolicies(self._transport)
        """Policies, versions and aliases."""

    def session(
        self,
        policy: str,
        *,
        session_id: str | None = None,
        run_id: str | None = None,
        seed: int | None = None,
        frame: Frame | None = None,
        world: World | None = None,
        constraints: Constraints | None = None,
        symmetric: bool = True,
    ) -> AsyncSession:
        """A session for `async with`, which opens it on the server and closes it at the end.

        Args:
            policy: NAME (the newest version), NAME@ALIAS or NAME:VERSION. The session keeps the version of its opening.
            session_id: a name of your own. Default: a random one.
            run_id: name of the first run, see `restart`. With a new one, an open session of this id starts again at slot 0.
            seed: seed of the random choices of the policy. Default: derived from `session_id` and `run_id`.
            frame: the area in your coordinates. Default: the unit square.
            world: what differs from the world of the policy. `warnings` of the session tell what that means.
            constraints: what no heading may break.
            symmetric: whether, where only one of two nodes of a graph reports the other, both detect each other. Default: True.
        """
        name = session_id or uuid.uuid4().hex
        request = made(pb.OpenSessionRequest, policy=policy, session_id=name, run_id=run_id, seed=seed)
        Surroundings(frame, world, constraints, symmetric).put(request)
        return AsyncSession(self._transport, request)

    async def open_session(
        self,
        policy: str,
        *,
        session_id: str | None = None,
        run_id: str | None = None,
        seed: int | None = None,
        frame: Frame | None = None,
        world: World | None = None,
        constraints: Constraints | None = None,
        symmetric: bool = True,
        timeout: float | None = None,
    ) -> AsyncSession:
        """Opens a session, which you close yourself. Arguments and errors: as `session` and `AsyncSession.open`."""
        session = self.session(
            policy,
            session_id=session_id,
            run_id=run_id,
            seed=seed,
            frame=frame,
            world=world,
            constraints=constraints,
            symmetric=symmetric,
        )
        return await session.open(timeout)

    async def get_session(self, session_id: str) -> AsyncSession:
        """An open session, to continue it.

        Raises:
            NotFound, FailedPrecondition: the session is closed or has expired.
        """
        found = await self._transport.call(sessions.GET, made(pb.GetSessionRequest, session_id=session_id))
        session = AsyncSession(self._transport, pb.OpenSessionRequest(session_id=session_id))
        session.info = SessionInfo.of(found)
        session.step = found.steps
        return session

    async def list_sessions(self) -> list[SessionInfo]:
        """All open sessions, by id."""
        found: list[SessionInfo] = []
        token = ""
        while True:
            page = await self._transport.call(sessions.LIST, pb.ListSessionsRequest(page_token=token))
            found += map(SessionInfo.of, page.sessions)
            token = page.next_page_token
            if not token:
                return found

    def local_session(
        self,
        policy: str,
        *,
        seed: int | None = None,
        frame: Frame | None = None,
        world: World | None = None,
        constraints: Constraints | None = None,
        symmetric: bool = True,
        recurrent_state: bytes = b"",
        step: int = 0,
    ) -> AsyncLocalSession:
        """A fleet whose memory is kept here and not on the server. Nothing is sent before `act`.

        Args:
            policy: NAME (the newest version), NAME@ALIAS or NAME:VERSION. The episode keeps the version of its slot 0.
            seed: seed of the random choices of the policy. Default: 0.
            frame: as for `session`.
            world: as for `session`.
            constraints: as for `session`.
            symmetric: as for `session`.
            recurrent_state: that of an earlier object, to continue its episode.
            step: that of the earlier object.
        """
        # What slot 0 and later slots send is checked here, where the caller gives it.
        made(pb.ActRequest, seed=seed, recurrent_state=recurrent_state, step=step)
        common = made(pb.ActRequest, policy=policy)
        Surroundings(frame, world, constraints, symmetric).put(common)
        session = AsyncLocalSession(self._transport, common, seed, recurrent_state)
        session.step = step
        return session

    def uav(
        self,
        policy: str,
        uav_id: str,
        *,
        uav_ids: Iterable[str],
        user_ids: Iterable[str],
        seed: int | None = None,
        frame: Frame | None = None,
        world: World | None = None,
        state: bytes = b"",
    ) -> AsyncUav:
        """One UAV that decides alone. Nothing is sent before `encode`. All arguments but `uav_id` and `state` are the same for all
        UAVs of the fleet.

        Args:
            policy: NAME (the newest version), NAME@ALIAS or NAME:VERSION. Not one that needs a scene.
            uav_id: this UAV.
            uav_ids: all UAVs of the fleet.
            user_ids: all users; their positions need not be known.
            seed: seed of the random choices of the policy. Default: 0.
            frame: as for `session`.
            world: as for `session`.
            state: that of an earlier object, to continue.
        """
        made(pb.EncodeRequest, state=state)
        uavs, users = texts("uav_ids", uav_ids), texts("user_ids", user_ids)
        first = made(pb.EncodeRequest, policy=policy, uav_ids=uavs, user_ids=users, seed=seed)
        Surroundings(frame, world).put(first)
        return AsyncUav(self._transport, first, text("uav_id", uav_id), state)

    async def act(
        self,
        observation: Observation,
        *,
        policy: str,
        seed: int | None = None,
        frame: Frame | None = None,
        world: World | None = None,
        constraints: Constraints | None = None,
        symmetric: bool = True,
        q_values: bool = False,
        motion: bool = False,
        explain: bool = False,
        timeout: float | None = None,
    ) -> Decision:
        """The headings for one observation of a fleet without a past. For more than one slot use a session.

        The arguments are those of `local_session` and of its `act`.

        Raises:
            QedgixError: as `act` of a session.
        """
        fleet = self.local_session(policy, seed=seed, frame=frame, world=world, constraints=constraints, symmetric=symmetric)
        return await fleet.act(observation, q_values=q_values, motion=motion, explain=explain, timeout=timeout)

    async def act_batch(
        self,
        slots: Iterable[tuple[AsyncFleet, Observation]],
        *,
        q_values: bool = False,
        timeout: float | None = None,
    ) -> list[Decision | QedgixError]:
        """The headings of several fleets in one call, in their order. Each succeeds or fails on its own.

        Args:
            slots: pairs of a session or local session and what its fleet observes: at most 1024, each fleet once.
            q_values: whether to return Q-values.
            timeout: seconds for all attempts. Default: that of the client.

        Returns:
            For each fleet its decision, or the exception, which is not raised.

        Raises:
            QedgixError: the whole call failed.
        """
        return await sessions.act_batch(self._transport, several("slots", slots), q_values, timeout)

    def stream(self) -> AsyncActStream:
        """A stream for `async with`: slots of many fleets without a call for each."""
        return AsyncActStream(self._transport)

    def environment(
        self,
        environment: Mapping[str, Any] | None = None,
        *,
        count: int = 1,
        seed: int = 0,
        auto_reset: bool = False,
        environment_id: str | None = None,
    ) -> AsyncEnvironment:
        """A hosted environment for `async with`, which creates it on the server and deletes it at the end.

        Args:
            environment: the configuration, such as `{"uavs": 3, "users": 5}` or `{"M": 3, "N": 5}`. Every field has a default.
            count: B, the number of copies, 1 to 1024.
            seed: episode 0 of copy b has the seed `seed` + b. 0 to 2^53 - 1.
            auto_reset: whether the last step of an episode also starts the next episode.
            environment_id: a name of your own. Default: a random one.
        """
        name = environment_id or uuid.uuid4().hex
        return AsyncEnvironment(self._transport, create_request(name, environment, count, seed, auto_reset))

    async def create_environment(
        self,
        environment: Mapping[str, Any] | None = None,
        *,
        count: int = 1,
        seed: int = 0,
        auto_reset: bool = False,
        environment_id: str | None = None,
        timeout: float | None = None,
    ) -> AsyncEnvironment:
        """Creates a hosted environment, which you delete yourself. Arguments and errors: as `environment` and
        `AsyncEnvironment.create`."""
        made = self.environment(environment, count=count, seed=seed, auto_reset=auto_reset, environment_id=environment_id)
        return await made.create(timeout)

    async def close(self) -> None:
        """Closes the connections. Sessions and environments stay on the server until they expire."""
        await self._transport.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()
