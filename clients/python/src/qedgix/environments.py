"""Hosted environments in the forms that learners expect. Requires the extra `environments` (PettingZoo and Gymnasium).

All forms share what they observe (docs/model.md of the server, "Observations"): lengths in units of the side of the square, AoI
divided by K, the slots per episode. Episodes end by truncation after K slots: a time limit, so learners bootstrap from the last
observation. Configuration, seed and actions determine every observation and reward, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ._sync.client import Client

if TYPE_CHECKING:
    from ._gymnasium import QedgixFleetEnv, QedgixVectorEnv
    from ._pettingzoo import QedgixParallelEnv

__all__ = ["QedgixFleetEnv", "QedgixParallelEnv", "QedgixVectorEnv", "fleet_env", "parallel_env", "vector_env"]


def __getattr__(name: str) -> Any:
    """The classes, which need PettingZoo and Gymnasium."""
    if name == "QedgixParallelEnv":
        from ._pettingzoo import QedgixParallelEnv

        return QedgixParallelEnv
    if name in ("QedgixFleetEnv", "QedgixVectorEnv"):
        from . import _gymnasium

        return getattr(_gymnasium, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def parallel_env(
    server: str | Client = "127.0.0.1:50051",
    environment: Mapping[str, Any] | None = None,
    *,
    max_cycles: int | None = None,
    seed: int | None = None,
    render_mode: str | None = None,
    own_position: bool = True,
) -> QedgixParallelEnv:
    """A parallel environment of PettingZoo: one agent per UAV (uav_0, uav_1, ...), which observes what the UAV detects.

    An observation has the own position (2), the relative position of each UAV (2M) and the relative position and AoI/K of
    each user (3N); what the UAV does not detect is 0. `state()` has everything: x, y of each UAV, x, y, AoI/K of each user.
    All agents get the reward of the fleet. `infos` have `aoi` (N,) and `mean_aoi` in slots, and in the last slot `episode`:
    the metrics of the episode and its seed.

    Args:
        server: address of gRPC, with the API key and certificates of the environment variables of `Client`; or a client, which
            the environment does not close.
        environment: the configuration, such as `{"uavs": 3, "users": 5, "hover": True}`. Every field has a default.
        max_cycles: K, the slots per episode. Default: that of `environment`, or 80.
        seed: seed of the first episode, if `reset` is not given one. Default: a random one.
        render_mode: `rgb_array`, or None.
        own_position: whether observations begin with the own position.

    Raises:
        InvalidArgument: the configuration is not accepted; `field` says why.
        ImportError: PettingZoo is not installed.
    """
    from ._pettingzoo import QedgixParallelEnv

    return QedgixParallelEnv(
        server, environment, max_cycles=max_cycles, seed=seed, render_mode=render_mode, own_position=own_position
    )


def vector_env(
    server: str | Client = "127.0.0.1:50051",
    environment: Mapping[str, Any] | None = None,
    *,
    count: int = 16,
    max_cycles: int | None = None,
    seed: int | None = None,
    render_mode: str | None = None,
    own_position: bool = True,
) -> QedgixVectorEnv:
    """A vector environment of Gymnasium: B fleets in one call per slot.

    Observations are (B, M, width), with the observations of `parallel_env`; actions are (B, M). The last step of an episode
    also starts the next one (`AutoresetMode.SAME_STEP`): `infos["final_obs"][b]` has the last observations (M, width) of
    copy b, and `infos["final_info"]` its last `state`, `aoi`, `mean_aoi`, and the metrics of its `episode`. Every step has
    `infos["state"]` (B, 2M + 3N), `infos["aoi"]` (B, N) and `infos["mean_aoi"]` (B,).

    Args:
        server: as for `parallel_env`.
        environment: as for `parallel_env`.
        count: B, the number of copies, 1 to 1024.
        max_cycles: as for `parallel_env`.
        seed: as for `parallel_env`; copy b gets `seed` + b.
        render_mode: `rgb_array`, or None.
        own_position: as for `parallel_env`.

    Raises:
        InvalidArgument: the configuration is not accepted; `field` says why.
        ImportError: Gymnasium is not installed.
    """
    from ._gymnasium import QedgixVectorEnv

    return QedgixVectorEnv(
        server,
        environment,
        count=count,
        max_cycles=max_cycles,
        seed=seed,
        render_mode=render_mode,
        own_position=own_position,
    )


def fleet_env(
    server: str | Client = "127.0.0.1:50051",
    environment: Mapping[str, Any] | None = None,
    *,
    max_cycles: int | None = None,
    seed: int | None = None,
    render_mode: str | None = None,
) -> QedgixFleetEnv:
    """An environment of Gymnasium for learners with one agent, such as those of Stable-Baselines3: the agent sees the state of
    the fleet, (2M + 3N,), and selects the headings of all UAVs, `MultiDiscrete` of length M.

    `info` has `aoi` (N,) and `mean_aoi` in slots, and in the last slot `metrics`: those of the episode, and its seed.

    Args:
        server: as for `parallel_env`.
        environment: as for `parallel_env`.
        max_cycles: as for `parallel_env`.
        seed: as for `parallel_env`.
        render_mode: `rgb_array`, or None.

    Raises:
        InvalidArgument: the configuration is not accepted; `field` says why.
        ImportError: Gymnasium is not installed.
    """
    from ._gymnasium import QedgixFleetEnv

    return QedgixFleetEnv(server, environment, max_cycles=max_cycles, seed=seed, render_mode=render_mode)
