"""What the environments for learners have in common: a hosted environment, its episodes, and its observer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._observer import Observer
from ._render import render
from ._sync.client import Client
from ._sync.environments import Environment
from ._values import instance, mapping, whole
from .errors import FailedPrecondition, NotFound, invalid, out_of_order
from .results import EnvironmentState

MAX_SEED = 2**53 - 1


class Hosted:
    """A hosted environment with episodes that are chosen by (seed, index), so that it can be made again.

    Args:
        server: address of gRPC, or a client.
        environment: its configuration.
        max_cycles: slots per episode; None: as configured.
        seed: seed of episode 0; None: a random one.
        count: number of copies.
        auto_reset: whether the last step of an episode also starts the next one.
        own_position: whether observations begin with the position of the UAV.
    """

    def __init__(
        self,
        server: str | Client,
        environment: Mapping[str, Any] | None,
        *,
        max_cycles: int | None,
        seed: int | None,
        count: int,
        auto_reset: bool,
        own_position: bool,
    ) -> None:
        config = {} if environment is None else dict(mapping("environment", environment))
        if max_cycles is not None:
            given = config.pop("K", config.get("slots", max_cycles))
            if given != max_cycles:
                raise invalid("max_cycles", max_cycles, f"the slots of the environment ({given}), or one of both")
            config["slots"] = max_cycles
        self._environment_config, self._count, self._auto_reset = config, count, auto_reset
        self._own_client = isinstance(server, str)
        self.seed = random_seed() if seed is None else whole("seed", seed, 0, MAX_SEED)
        self.client = Client(server) if isinstance(server, str) else instance("server", server, Client)
        self._next_episode = 0
        try:
            self._environment = self._create()
        except BaseException:
            self._close_client()
            raise
        self.config = self._environment.config
        self.headings = self._environment.headings
        self.observer = Observer(self.config, own_position)
        self.state: EnvironmentState | None = None

    def _create(self) -> Environment:
        return self.client.create_environment(
            self._environment_config, count=self._count, seed=self.seed, auto_reset=self._auto_reset
        )

    def reset(self, seed: int | None) -> EnvironmentState:
        """Starts episode 0 of a new seed, or the next episode. An environment that has expired is made again."""
        if seed is not None:
            self.seed, self._next_episode = whole("seed", seed, 0, MAX_SEED), 0
        try:
            state = self._environment.reset(seed=self.seed, episode=self._next_episode)
        except (NotFound, FailedPrecondition) as error:
            if error.code not in ("not_found", "environment_expired"):
                raise
            self._environment = self._create()
            state = self._environment.reset(seed=self.seed, episode=self._next_episode)
        return self._take(state)

    def step(self, headings: ArrayLike) -> EnvironmentState:
        """Advances all copies by one slot."""
        return self._take(self._environment.step(headings))

    def _take(self, state: EnvironmentState) -> EnvironmentState:
        self._next_episode = state.episode + 1
        self.state = state
        return state

    def current(self) -> EnvironmentState:
        """The state after the last reset or step.

        Raises:
            FailedPrecondition: there was no reset.
        """
        if self.state is None:
            raise out_of_order("reset the environment first")
        return self.state

    def picture(self, copy: int = 0) -> NDArray[np.uint8]:
        """The scene of one copy as (512, 512, 3) pixels."""
        uavs, users, aoi = (array[copy] for array in self.current().arrays)
        ranges = self.config["transmission_range"], self.config["detection_range"]
        return render(uavs, users, aoi / np.float32(self.observer.slots), *ranges)

    def close(self) -> None:
        """Deletes the environment, and closes the connection if it was opened here."""
        try:
            self._environment.delete()
        finally:
            self._close_client()

    def _close_client(self) -> None:
        if self._own_client:
            self.client.close()


def random_seed() -> int:
    """A seed that no one has chosen."""
    return int(np.random.SeedSequence().generate_state(1, np.uint64)[0] & MAX_SEED)
