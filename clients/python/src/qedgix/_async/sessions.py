"""Fleets that act slot by slot: sessions of the server, sessions of the caller, and streams."""

from __future__ import annotations

import uuid
from collections import deque
from time import monotonic
from types import TracebackType
from typing import TYPE_CHECKING

import grpc

from .._values import made
from ..errors import (
    DeadlineExceeded,
    InvalidArgument,
    NotFound,
    QedgixError,
    Unavailable,
    from_act_error,
    invalid,
    out_of_order,
)
from ..observations import Observation, put
from ..results import Decision, PolicyRef, SessionInfo, SessionWarning
from ..v1 import policy_pb2 as pb
from ._platform import RawStream, sleep
from .transport import AsyncTransport, Method

if TYPE_CHECKING:
    from typing_extensions import Self

_SERVICE = "/qedgix.v1.PolicyService/"
ACT = Method(_SERVICE + "Act", pb.ActRequest, pb.ActResponse)
ACT_BATCH = Method(_SERVICE + "ActBatch", pb.ActBatchRequest, pb.ActBatchResponse)
ACT_STREAM = Method(_SERVICE + "ActStream", pb.ActRequest, pb.ActResult)
OPEN = Method(_SERVICE + "OpenSession", pb.OpenSessionRequest, pb.Session)
GET = Method(_SERVICE + "GetSession", pb.GetSessionRequest, pb.Session)
LIST = Method(_SERVICE + "ListSessions", pb.ListSessionsRequest, pb.ListSessionsResponse)
CLOSE = Method(_SERVICE + "CloseSession", pb.CloseSessionRequest, pb.Session)


class AsyncFleet:
    """A fleet whose policy remembers earlier slots. `AsyncSession` keeps that memory on the server, `AsyncLocalSession` here.

    One fleet is used by one task or thread at a time.
    """

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport
        self.step = 0
        """Index of the next slot, from 0."""

    async def act(
        self,
        observation: Observation,
        *,
        q_values: bool = False,
        motion: bool = False,
        explain: bool = False,
        timeout: float | None = None,
    ) -> Decision:
        """Returns the headings for what the fleet observes in this slot, and goes on to the next slot.

        A lost answer is asked for again with the same step, which the server does not compute twice. If this raises, the
        fleet is still in this slot: call again with the same observation.

        Args:
            observation: a `Scene`, a `Graph`, their message or a dict.
            q_values: whether to return Q-values.
            motion: whether to return velocities and waypoints.
            explain: whether to return what speaks for and against each heading; takes longer.
            timeout: seconds for all attempts. Default: that of the client.

        Raises:
            InvalidArgument: `field` says what is not accepted.
            FailedPrecondition: `not_open`: the session was never opened; `session_expired` and others: it cannot go on.
            NotFound: there is no such session or policy; a server that was restarted has no sessions.
            Unavailable, ResourceExhausted, DeadlineExceeded: no answer within the deadline.
        """
        request = self.request(observation, q_values=q_values, motion=motion)
        request.explain = bool(explain)
        response = await self._transport.call(ACT, request, timeout)
        return self.accept(response)

    def request(self, observation: Observation, *, q_values: bool = False, motion: bool = False) -> pb.ActRequest:
        """The request of this slot."""
        request = self._begin()
        if q_values:
            request.return_q_values = True
        if motion:
            request.return_velocity = request.return_waypoint = True
        put(observation, request)
        return request

    def _begin(self) -> pb.ActRequest:
        """The request of this slot without its observation."""
        raise NotImplementedError

    def accept(self, response: pb.ActResponse) -> Decision:
        """Takes the answer of this slot and goes on to the next slot."""
        self.step = response.step + 1
        return Decision(response)


class AsyncSession(AsyncFleet):
    """A session: the server keeps the memory of the fleet. Closes itself at the end of `async with`.

    Obtain one from `AsyncClient.session`, `open_session` or `get_session`.
    """

    def __init__(self, transport: AsyncTransport, request: pb.OpenSessionRequest) -> None:
        super().__init__(transport)
        self._open_request = request
        self._run_id: str | None = None
        self.id: str = request.session_id
        """Id of the session."""
        self.info: SessionInfo | None = None
        """What the server said when it opened the session."""

    @property
    def policy(self) -> PolicyRef:
        """The policy version of the session. It never changes.

        Raises:
            FailedPrecondition: `not_open`: the session is not open yet.
        """
        return self._opened().policy

    @property
    def warnings(self) -> tuple[SessionWarning, ...]:
        """How the world of the session differs from the one of the policy.

        Raises:
            FailedPrecondition: `not_open`: the session is not open yet.
        """
        return self._opened().warnings

    def _opened(self) -> SessionInfo:
        if self.info is None:
            raise out_of_order("the session is not open; use `async with client.session(...)`, or `open` it", "not_open")
        return self.info

    async def open(self, timeout: float | None = None) -> Self:
        """Opens the session; `async with` does this itself.

        Raises:
            NotFound: there is no such policy.
            AlreadyExists: a session with this id is open and has steps, or other options.
            ResourceExhausted: the server has no room for another session.
        """
        self.info = SessionInfo.of(await self._transport.call(OPEN, self._open_request, timeout))
        self.step = self.info.steps
        return self

    def _begin(self) -> pb.ActRequest:
        self._opened()
        return made(pb.ActRequest, session_id=self.id, step=self.step, run_id=self._run_id)

    def restart(self, run_id: str | None = None) -> None:
        """Starts again at slot 0, for example when the simulator is reset. The next `act` tells the server.

        Args:
            run_id: a name of the new run that the session has not had. Default: a random one.
        """
        self._run_id = run_id or uuid.uuid4().hex
        self.step = 0

    async def close(self, timeout: float | None = None) -> None:
        """Closes the session, if the server still has it."""
        try:
            await self._transport.call(CLOSE, pb.CloseSessionRequest(session_id=self.id), timeout, gone=NotFound)
        except QedgixError as error:
            if error.code not in ("not_found", "session_expired"):
                raise

    async def __aenter__(self) -> Self:
        return self if self.info else await self.open()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            await self.close()
        except QedgixError:
            # The session expires by itself. The error of the block, if there is one, matters more.
            if kind is None:
                raise

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.id}, step {self.step}>"


class AsyncLocalSession(AsyncFleet):
    """A session without the server: this object keeps the memory of the fleet, and any replica of the server can answer.

    It survives a restart of the server. Save `recurrent_state` and `step` to continue in another process.
    """

    def __init__(self, transport: AsyncTransport, common: pb.ActRequest, seed: int | None, recurrent_state: bytes) -> None:
        super().__init__(transport)
        self._common = common
        self.policy = common.policy
        """NAME, NAME@ALIAS or NAME:VERSION. The episode keeps the version of its slot 0."""
        self.seed = seed
        """Seed of the random choices of the policy."""
        self.recurrent_state = recurrent_state
        """The memory of the fleet after the last slot; empty before slot 0."""

    def _begin(self) -> pb.ActRequest:
        seed = None if self.recurrent_state else self.seed
        request = made(pb.ActRequest, recurrent_state=self.recurrent_state, seed=seed)
        request.MergeFrom(self._common)
        return request

    def accept(self, response: pb.ActResponse) -> Decision:
        """Takes the answer of this slot and goes on to the next slot."""
        self.recurrent_state = response.recurrent_state
        return super().accept(response)

    def restart(self, seed: int | None = None) -> None:
        """Starts again at slot 0.

        Args:
            seed: a new seed. Default: the same seed.
        """
        self.recurrent_state = b""
        self.step = 0
        if seed is not None:
            self.seed = seed

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.policy}, step {self.step}>"


class AsyncActStream:
    """Slots of many fleets on one stream. Requests can be sent before earlier ones are answered; answers keep their order.

    When the connection ends, the stream opens again and sends what has no answer yet. A stream is used by one task or thread.

    Example:
        >>> async with client.stream() as stream:
        ...     for fleet, scene in zip(fleets, scenes):
        ...         await stream.send(fleet, scene)
        ...     decisions = [await stream.receive() for _ in fleets]
    """

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport
        self._raw: RawStream | None = None
        self._pending: deque[tuple[AsyncFleet, pb.ActRequest]] = deque()

    @property
    def pending(self) -> int:
        """Number of requests without an answer."""
        return len(self._pending)

    async def act(
        self, fleet: AsyncFleet, observation: Observation, *, q_values: bool = False, motion: bool = False
    ) -> Decision:
        """Sends one slot and returns its answer. As `act` of the fleet.

        Raises:
            FailedPrecondition: other requests wait for their answers.
        """
        if self._pending:
            raise out_of_order("requests wait for their answers; receive them first")
        await self.send(fleet, observation, q_values=q_values, motion=motion)
        return await self.receive()

    async def send(self, fleet: AsyncFleet, observation: Observation, *, q_values: bool = False, motion: bool = False) -> None:
        """Sends the slot of a fleet without waiting for the answer.

        Raises:
            FailedPrecondition: the fleet waits for an answer, or is a session that was never opened.
        """
        if any(waiting is fleet for waiting, _ in self._pending):
            raise out_of_order(f"{fleet!r} waits for an answer; receive it first")
        request = fleet.request(observation, q_values=q_values, motion=motion)
        self._pending.append((fleet, request))
        if self._raw is None:
            self._raw = self._transport.open_stream(ACT_STREAM)
        await self._raw.write(request)

    async def receive(self, timeout: float | None = None) -> Decision:
        """Returns the answer to the oldest request without one.

        Args:
            timeout: seconds for all attempts. Default: that of the client.

        Raises:
            FailedPrecondition: there is no request without an answer.
            QedgixError: as `act` of the fleet. The stream goes on with the next request. After DeadlineExceeded, Unavailable
                or ResourceExhausted the fleet is still in its slot.
        """
        if not self._pending:
            raise out_of_order("there is no request without an answer")
        settings = self._transport.settings
        deadline = settings.deadline(timeout)
        attempt = 1
        while True:
            failure: QedgixError
            broken = True
            try:
                if self._raw is None:
                    await self._resend()
                assert self._raw is not None
                result = await self._raw.read(settings.retry.limit(deadline - monotonic()))
            except TimeoutError:
                failure = DeadlineExceeded(f"{settings.grpc_peer}: no answer in time", code="deadline_exceeded")
            except EOFError:
                failure = Unavailable(f"{settings.grpc_peer}: the stream has ended", code="unavailable")
            except grpc.RpcError as error:
                failure = await self._transport.failure(error)
            else:
                if result.WhichOneof("result") == "response":
                    fleet, _ = self._pending.popleft()
                    return fleet.accept(result.response)
                failure, broken = from_act_error(result.error), False
            wait = settings.retry.wait(failure, attempt, deadline - monotonic())
            # A request that was refused is sent again on a new stream, because later ones keep their order.
            if broken or wait is not None:
                await self._drop()
            if wait is None:
                self._pending.popleft()
                raise failure
            await sleep(wait)
            attempt += 1

    async def _resend(self) -> None:
        self._raw = self._transport.open_stream(ACT_STREAM)
        for _, request in self._pending:
            await self._raw.write(request)

    async def _drop(self) -> None:
        if self._raw is not None:
            await self._raw.close()
        self._raw = None

    async def close(self) -> None:
        """Ends the stream. Requests without an answer are forgotten; their fleets are still in their slots."""
        await self._drop()
        self._pending.clear()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()


async def act_batch(
    transport: AsyncTransport,
    slots: list[tuple[AsyncFleet, Observation]],
    q_values: bool,
    timeout: float | None,
) -> list[Decision | QedgixError]:
    """See `AsyncClient.act_batch`."""
    for i, slot in enumerate(slots):
        if not isinstance(slot, (tuple, list)) or len(slot) != 2 or not isinstance(slot[0], AsyncFleet):
            raise invalid(f"slots[{i}]", repr(slot), "a session and what its fleet observes")
    if len({id(fleet) for fleet, _ in slots}) < len(slots):
        raise InvalidArgument("a fleet has several slots in one batch", code="invalid_argument", field="slots")
    deadline = transport.settings.deadline(timeout)
    requests = [fleet.request(observation, q_values=q_values) for fleet, observation in slots]
    results: list[Decision | QedgixError | None] = [None] * len(slots)
    open_slots = list(range(len(slots)))
    attempt = 1
    while open_slots:
        batch = pb.ActBatchRequest(requests=[requests[i] for i in open_slots])
        response = await transport.call(ACT_BATCH, batch, deadline - monotonic())
        again: list[int] = []
        wait = 0.0
        for i, result in zip(open_slots, response.results):
            if result.WhichOneof("result") == "response":
                results[i] = slots[i][0].accept(result.response)
                continue
            failure = results[i] = from_act_error(result.error)
            pause = transport.settings.retry.wait(failure, attempt, deadline - monotonic())
            if pause is not None:
                again.append(i)
                wait = max(wait, pause)
        if again:
            await sleep(wait)
        open_slots = again
        attempt += 1
    return [result for result in results if result is not None]
