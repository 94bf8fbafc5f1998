# Generated from _async by `generate`. Do not edit.
"""Environments that the server hosts."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from google.protobuf.json_format import MessageToDict, ParseDict, ParseError
from numpy.typing import ArrayLike

from .._values import made, plain
from ..errors import NotFound, QedgixError, invalid, out_of_order
from ..results import EnvironmentState
from ..v1 import environment_pb2 as pb
from .transport import Transport, Method

if TYPE_CHECKING:
    from typing_extensions import Self

_SERVICE = "/qedgix.v1.EnvironmentService/"
CREATE = Method(_SERVICE + "CreateEnvironment", pb.CreateEnvironmentRequest, pb.Environment)
RESET = Method(_SERVICE + "Reset", pb.ResetRequest, pb.EnvironmentState)
STEP = Method(_SERVICE + "Step", pb.StepRequest, pb.EnvironmentState)
DELETE = Method(_SERVICE + "DeleteEnvironment", pb.DeleteEnvironmentRequest, pb.Environment)


def create_request(
    environment_id: str, environment: Mapping[str, Any] | None, count: int, seed: int, auto_reset: bool
) -> pb.CreateEnvironmentRequest:
    """The request that creates an environment."""
    request = made(pb.CreateEnvironmentRequest, auto_reset=auto_reset, environment_id=environment_id, count=count, seed=seed)
    try:
        ParseDict(plain("environment", dict(environment or {})), request.environment)
    except (ParseError, TypeError, ValueError) as error:
        if isinstance(error, QedgixError):
            raise
        raise invalid("environment", error, "a dict that JSON can hold") from None
    return request


class Environment:
    """B copies of an environment on the server, all in the same slot. Deletes itself at the end of `with`.

    Obtain one from `Client.environment` or `create_environment`. One environment is used by one task or thread at a time.
    """

    def __init__(self, transport: Transport, request: pb.CreateEnvironmentRequest) -> None:
        self._transport = transport
        self._create_request = request
        self._created: pb.Environment | None = None
        self._step = 0

    def create(self, timeout: float | None = None) -> Self:
        """Creates the environment on the server; `with` does this itself.

        Raises:
            InvalidArgument: the configuration is not accepted; `field` says why.
            ResourceExhausted: the server has no room for it.
        """
        self._created = self._transport.call(CREATE, self._create_request, timeout)
        return self

    @property
    def _message(self) -> pb.Environment:
        if self._created is None:
            raise out_of_order(
                "the environment is not open; use `with client.environment(...)`, or `create` it", "not_open"
            )
        return self._created

    @property
    def id(self) -> str:
        """Id of the environment."""
        return self._create_request.environment_id

    @property
    def config(self) -> dict[str, Any]:
        """The configuration with all default values: `uavs` (M), `users` (N), `slots` (K), `speed`, and others."""
        config: dict[str, Any] = MessageToDict(self._message.environment)
        # Numbers of a Struct are doubles.
        return {name: int(value) if name in ("uavs", "users", "slots") else value for name, value in config.items()}

    @property
    def count(self) -> int:
        """B, the number of copies."""
        return self._message.count

    @property
    def headings(self) -> int:
        """A, the number of headings: 8, or 9 with hover."""
        return self._message.headings

    def reset(
        self,
        *,
        seed: int | None = None,
        episode: int | None = None,
        graphs: bool = False,
        timeout: float | None = None,
    ) -> EnvironmentState:
        """Starts an episode in every copy: with neither seed nor episode the next one.

        Args:
            seed: a new seed of the environment, 0 to 2^53 - 1. Episode 0 of copy b has the seed `seed` + b.
            episode: index of the episode. Default with a seed: 0.
            graphs: whether to return the graph of each scene.
            timeout: seconds for all attempts. Default: that of the client.

        Raises:
            NotFound, FailedPrecondition: the server does not have the environment any more (`not_found`,
                `environment_expired`); create another one. `not_open`: it was never created.
        """
        name = self._message.environment_id
        request = made(pb.ResetRequest, environment_id=name, seed=seed, episode=episode, return_graph=graphs)
        state = EnvironmentState(self._transport.call(RESET, request, timeout))
        self._step = state.step
        return state

    def step(self, headings: ArrayLike, *, graphs: bool = False, timeout: float | None = None) -> EnvironmentState:
        """Advances every copy by one slot. A lost answer is asked for again and does not advance it twice.

        Args:
            headings: (B, M) heading indices 0 .. A - 1; (M,) is accepted if B is 1.
            graphs: whether to return the graph of each scene.
            timeout: seconds for all attempts. Default: that of the client.

        Raises:
            InvalidArgument: `headings` has another shape, or a value that is no heading.
            FailedPrecondition: `episode_over`: reset first, or create it with `auto_reset`; `environment_expired`; `not_open`:
                it was never created.
            NotFound: the server does not have the environment any more.
        """
        count = self.count
        try:
            array = np.asarray(headings)
        except ValueError:
            raise invalid("headings", headings, f"rows of one length, ({count}, M)") from None
        if array.ndim == 1:
            array = array[None]
        if array.ndim != 2 or array.dtype.kind not in "iu" or (array.size and array.min() < 0):
            raise invalid(
                "headings",
                f"{array.dtype} {array.shape}",
                f"non-negative integers of shape ({count}, M)",
            )
        request = pb.StepRequest(
            environment_id=self.id,
            actions=[made(pb.Headings, headings=row) for row in array.tolist()],
            step=self._step,
            return_graph=graphs,
        )
        state = EnvironmentState(self._transport.call(STEP, request, timeout))
        self._step = state.step
        return state

    def delete(self, timeout: float | None = None) -> None:
        """Deletes the environment, if the server still has it."""
        request = pb.DeleteEnvironmentRequest(environment_id=self.id)
        try:
            self._transport.call(DELETE, request, timeout, gone=NotFound)
        except QedgixError as error:
            if error.code not in ("not_found", "environment_expired"):
                raise

    def __enter__(self) -> Self:
        return self if self._created else self.create()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.delete()
        except QedgixError:
            # The environment expires by itself. The error of the block, if there is one, matters more.
            if kind is None:
                raise

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.id}>"
