"""Positions and AoI as arrays for learners: what each UAV observes, and the state of all.

The flat observation and the flat state are those of docs/model.md. Shapes: B copies, M UAVs, N users.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .results import Arrays

Floats = NDArray[np.float32]


class Observer:
    """Makes observations and states from positions and AoI.

    Args:
        config: the resolved configuration of an environment.
        own_position: whether an observation begins with the position of its UAV.
    """

    def __init__(self, config: Mapping[str, Any], own_position: bool) -> None:
        self.uavs = int(config["uavs"])
        self.users = int(config["users"])
        self.slots = int(config["slots"])
        self.own_position = own_position
        self._detection = float(config["detection_range"])
        communication = config.get("communication_range")
        self._communication = self._detection if communication is None else float(communication)
        reach = self.slots * float(config["speed"]) if config["boundary"] == "free" else 0.0
        self._low, self._high = -reach, 1.0 + reach

    @property
    def width(self) -> int:
        """Length of an observation: 2M + 3N, and 2 more with the own position."""
        return 2 * self.own_position + self.state_width

    @property
    def state_width(self) -> int:
        """Length of a state: 2M + 3N."""
        return 2 * self.uavs + 3 * self.users

    def observation_bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest values of an observation, (width,)."""
        between = min(self._communication, self._high - self._low)
        user = np.array([self._detection, self._detection, 1.0])
        high = np.concatenate([np.full(2 * self.uavs, between), np.tile(user, self.users)])
        low = np.concatenate([np.full(2 * self.uavs, -between), np.tile(user * [-1, -1, 0], self.users)])
        if self.own_position:
            low, high = np.concatenate([[self._low] * 2, low]), np.concatenate([[self._high] * 2, high])
        return low.astype(np.float32), high.astype(np.float32)

    def state_bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest values of a state, (state_width,)."""
        low, high = np.zeros(self.state_width, np.float32), np.ones(self.state_width, np.float32)
        low[: 2 * self.uavs], high[: 2 * self.uavs] = self._low, self._high
        return low, high

    def observe(self, arrays: Arrays) -> Floats:
        """(B, M, width): per UAV its own position, if wanted; the relative position of each UAV; the relative position and
        AoI/K of each user. What a UAV does not detect is 0."""
        uavs, users = arrays.uavs.astype(np.float64), arrays.users.astype(np.float64)
        to_uavs = uavs[:, None] - uavs[:, :, None]
        to_users = users[:, None] - uavs[:, :, None]
        # Ranges are tested in f64, as the server does.
        to_uavs[(to_uavs**2).sum(-1) > self._communication**2] = 0.0
        near = (to_users**2).sum(-1) <= self._detection**2
        age = np.broadcast_to(arrays.aoi[:, None] / np.float32(self.slots), near.shape)
        seen = np.concatenate([to_users, age[..., None]], axis=-1)
        seen[~near] = 0.0
        count = len(uavs)
        parts = [to_uavs.reshape(count, self.uavs, -1), seen.reshape(count, self.uavs, -1)]
        if self.own_position:
            parts.insert(0, uavs)
        return np.concatenate(parts, axis=-1, dtype=np.float32, casting="same_kind")

    def state(self, arrays: Arrays) -> Floats:
        """(B, 2M + 3N): x, y of each UAV, then x, y, AoI/K of each user."""
        count = len(arrays.uavs)
        age = arrays.aoi / np.float32(self.slots)
        users = np.concatenate([arrays.users, age[..., None]], axis=-1)
        return np.concatenate([arrays.uavs.reshape(count, -1), users.reshape(count, -1)], axis=-1, dtype=np.float32)
