"""A hosted environment as a parallel environment of PettingZoo."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.utils import EzPickle
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from ._hosted import Hosted
from ._sync.client import Client
from .errors import invalid
from .results import EnvironmentState

Observations = dict[str, NDArray[np.float32]]
Infos = dict[str, dict[str, Any]]


class QedgixParallelEnv(ParallelEnv, EzPickle):
    """See `qedgix.parallel_env`."""

    metadata = {"name": "qedgix_v1", "render_modes": ["rgb_array"], "render_fps": 10, "is_parallelizable": True}

    def __init__(
        self,
        server: str | Client,
        environment: Mapping[str, Any] | None,
        *,
        max_cycles: int | None,
        seed: int | None,
        render_mode: str | None,
        own_position: bool,
    ) -> None:
        # A copy or an unpickled environment is another one on the server, with the same configuration.
        EzPickle.__init__(
            self,
            server,
            environment,
            max_cycles=max_cycles,
            seed=seed,
            render_mode=render_mode,
            own_position=own_position,
        )
        if render_mode not in (None, "rgb_array"):
            raise invalid("render_mode", render_mode, "None or rgb_array")
        self.render_mode = render_mode
        self._hosted = Hosted(
            server,
            environment,
            max_cycles=max_cycles,
            seed=seed,
            count=1,
            auto_reset=False,
            own_position=own_position,
        )
        observer = self._hosted.observer
        self.config = self._hosted.config
        """The configuration of the environment with all default values."""
        self.max_cycles = observer.slots
        """K, slots per episode."""
        self.possible_agents = [f"uav_{i}" for i in range(observer.uavs)]
        self.agents: list[str] = []
        low, high = observer.observation_bounds()
        self.observation_spaces = {agent: Box(low, high) for agent in self.possible_agents}
        self.action_spaces = {agent: Discrete(self._hosted.headings) for agent in self.possible_agents}
        self.state_space = Box(*observer.state_bounds())

    def observation_space(self, agent: str) -> Box:
        """The space of the observations of a UAV."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete[Any]:
        """The headings: h is the direction 45 h degrees counter-clockwise from +x; 8 is hover, if configured."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observations, Infos]:
        """Starts episode 0 of a new seed (0 to 2^53 - 1), or the next episode. `options` has no effect."""
        state = self._hosted.reset(seed)
        self.agents = list(self.possible_agents)
        return self._observations(state), self._infos(state)

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Moves all UAVs for one slot. The reward is that of the fleet, the same for all UAVs.

        Raises:
            InvalidArgument: a UAV has no action, or one that is no heading.
            NotFound, FailedPrecondition: the server does not have the environment any more; reset makes it again.
        """
        if not self.agents:
            return {}, {}, {}, {}, {}
        missing = [agent for agent in self.agents if agent not in actions]
        if missing:
            raise invalid(f"actions[{missing[0]}]", "nothing", "a heading")
        state = self._hosted.step([[_heading(agent, actions[agent]) for agent in self.agents]])
        agents, truncated = self.agents, bool(state.truncated[0])
        if truncated:
            self.agents = []
        reward = float(state.rewards[0])
        return (
            self._observations(state),
            dict.fromkeys(agents, reward),
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, truncated),
            self._infos(state),
        )

    def _observations(self, state: EnvironmentState) -> Observations:
        return dict(zip(self.possible_agents, self._hosted.observer.observe(state.arrays)[0]))

    def _infos(self, state: EnvironmentState) -> Infos:
        info: dict[str, Any] = {"aoi": state.aoi[0], "mean_aoi": float(state.aoi[0].mean())}
        [finished] = state.finished
        if finished is not None:
            info["episode"] = {**finished.metrics, "seed": finished.seed}
        return {agent: dict(info) for agent in self.possible_agents}

    def state(self) -> NDArray[np.float32]:
        """(2M + 3N,): x, y of each UAV, then x, y, AoI/K of each user."""
        state: NDArray[np.float32] = self._hosted.observer.state(self._hosted.current().arrays)[0]
        return state

    def render(self) -> NDArray[np.uint8] | None:
        """The scene as (512, 512, 3) pixels; None without `render_mode`."""
        return None if self.render_mode is None else self._hosted.picture()

    def close(self) -> None:
        """Deletes the environment on the server."""
        self._hosted.close()


def _heading(agent: str, action: Any) -> int:
    try:
        return int(action)
    except (TypeError, ValueError):
        raise invalid(f"actions[{agent}]", repr(action), "a heading") from None
