"""Hosted environments as environments of Gymnasium: many copies at once, or one for learners that want one agent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import gymnasium
import numpy as np
from gymnasium.spaces import Box, MultiDiscrete
from gymnasium.utils import EzPickle
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ._hosted import MAX_SEED, Hosted
from ._sync.client import Client
from ._values import whole
from .errors import invalid
from .results import Arrays, EnvironmentState

Floats: TypeAlias = NDArray[np.float32]
Headings: TypeAlias = NDArray[np.int64]


class QedgixVectorEnv(VectorEnv[Floats, Headings, NDArray[Any]]):
    """See `qedgix.vector_env`."""

    metadata = {"name": "qedgix_v1", "render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        server: str | Client,
        environment: Mapping[str, Any] | None,
        *,
        count: int,
        max_cycles: int | None,
        seed: int | None,
        render_mode: str | None,
        own_position: bool,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise invalid("render_mode", render_mode, "None or rgb_array")
        self.render_mode = render_mode
        self._hosted = Hosted(
            server,
            environment,
            max_cycles=max_cycles,
            seed=seed,
            count=count,
            auto_reset=True,
            own_position=own_position,
        )
        observer = self._hosted.observer
        self.config = self._hosted.config
        """The configuration of the environment with all default values."""
        self.num_envs = count
        low, high = observer.observation_bounds()
        self.single_observation_space = Box(np.tile(low, (observer.uavs, 1)), np.tile(high, (observer.uavs, 1)))
        self.single_action_space = MultiDiscrete([self._hosted.headings] * observer.uavs)
        self.observation_space = batch_space(self.single_observation_space, count)
        self.action_space = batch_space(self.single_action_space, count)
        self.state_space = Box(*observer.state_bounds())

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Starts an episode in every copy: copy b gets the seed `seed` + b, or the next episode. `options` has no effect.

        Raises:
            InvalidArgument: a list of seeds is not consecutive.
        """
        if isinstance(seed, (Sequence, np.ndarray)):
            seeds = list(seed)
            first = None if not seeds or seeds[0] is None else whole("seed[0]", seeds[0], 0, MAX_SEED)
            if seeds != ([None] * self.num_envs if first is None else list(range(first, first + self.num_envs))):
                raise invalid("seed", seeds, f"a number, or {self.num_envs} consecutive numbers")
            seed = first
        state = self._hosted.reset(seed)
        return self._hosted.observer.observe(state.arrays), self._infos(state.arrays)

    def step(
        self, actions: Headings
    ) -> tuple[Floats, NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Moves all fleets for one slot.

        Args:
            actions: (B, M) headings.

        Returns:
            Observations (B, M, width), rewards (B,), terminations and truncations (B,), and infos. After the last slot of the
            episodes the observations are the first ones of the next episodes; the last ones are in `final_obs`.

        Raises:
            InvalidArgument: the actions have another shape, or a value that is no heading.
        """
        state = self._hosted.step(actions)
        infos = self._infos(state.arrays)
        if state.truncated.all():
            self._add_final(infos, state)
        never = np.zeros(self.num_envs, np.bool_)
        return self._hosted.observer.observe(state.arrays), state.rewards, never, state.truncated, infos

    def _infos(self, arrays: Arrays) -> dict[str, Any]:
        everywhere = np.ones(self.num_envs, np.bool_)
        infos: dict[str, Any] = {
            "state": self._hosted.observer.state(arrays),
            "aoi": arrays.aoi,
            "mean_aoi": arrays.aoi.mean(axis=1),
        }
        return {**infos, **{f"_{name}": everywhere.copy() for name in infos}}

    def _add_final(self, infos: dict[str, Any], state: EnvironmentState) -> None:
        finished = [one for one in state.finished if one is not None]
        arrays = Arrays.of([one.scene for one in finished if one.scene is not None])
        everywhere = np.ones(self.num_envs, np.bool_)
        observations = np.empty(self.num_envs, object)
        observations[:] = list(self._hosted.observer.observe(arrays))
        episode: dict[str, Any] = {name: np.array([one.metrics[name] for one in finished]) for name in finished[0].metrics}
        episode["seed"] = np.array([one.seed for one in finished], np.uint64)
        episode.update({f"_{name}": everywhere.copy() for name in list(episode)})
        final_info = {**self._infos(arrays), "episode": episode, "_episode": everywhere.copy()}
        infos.update(final_obs=observations, _final_obs=everywhere.copy(), final_info=final_info, _final_info=everywhere.copy())

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """The scene of each copy as (512, 512, 3) pixels; None without `render_mode`."""
        if self.render_mode is None:
            return None
        return tuple(self._hosted.picture(copy) for copy in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Deletes the environment on the server."""
        self._hosted.close()


class QedgixFleetEnv(gymnasium.Env[Floats, Headings], EzPickle):
    """See `qedgix.fleet_env`."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        server: str | Client,
        environment: Mapping[str, Any] | None,
        *,
        max_cycles: int | None,
        seed: int | None,
        render_mode: str | None,
    ) -> None:
        EzPickle.__init__(self, server, environment, max_cycles=max_cycles, seed=seed, render_mode=render_mode)
        if render_mode not in (None, "rgb_array"):
            raise invalid("render_mode", render_mode, "None or rgb_array")
        self.render_mode = render_mode
        self._hosted = Hosted(
            server, environment, max_cycles=max_cycles, seed=seed, count=1, auto_reset=False, own_position=False
        )
        self.config = self._hosted.config
        """The configuration of the environment with all default values."""
        self.observation_space = Box(*self._hosted.observer.state_bounds())
        self.action_space = MultiDiscrete([self._hosted.headings] * self._hosted.observer.uavs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Starts episode 0 of a new seed, or the next episode. `options` has no effect."""
        state = self._hosted.reset(seed)
        super().reset(seed=None if seed is None else int(seed))
        return self._result(state)

    def step(self, action: Headings) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Moves all UAVs for one slot.

        Args:
            action: (M,) headings.

        Raises:
            FailedPrecondition: `episode_over`: reset first.
        """
        state = self._hosted.step(action)
        observation, info = self._result(state)
        return observation, float(state.rewards[0]), False, bool(state.truncated[0]), info

    def _result(self, state: EnvironmentState) -> tuple[Floats, dict[str, Any]]:
        info: dict[str, Any] = {"aoi": state.aoi[0], "mean_aoi": float(state.aoi[0].mean())}
        [finished] = state.finished
        if finished is not None:
            info["metrics"] = {**finished.metrics, "seed": finished.seed}
        return self._hosted.observer.state(state.arrays)[0], info

    def render(self) -> NDArray[np.uint8] | None:
        """The scene as (512, 512, 3) pixels; None without `render_mode`."""
        return None if self.render_mode is None else self._hosted.picture()

    def close(self) -> None:
        """Deletes the environment on the server."""
        self._hosted.close()
