"""A picture of a scene as an RGB array, without a graphics library."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

SIDE = 512
"""Height and width of a picture in pixels."""

_MARGIN = 0.04
_PAPER, _GRID, _UAV = (250, 250, 250), (222, 222, 222), (30, 30, 30)
# Colours that most people with a colour deficiency can tell apart.
_FRESH, _OLD, _RANGE = (0, 114, 178), (213, 94, 0), (86, 180, 233)

Canvas = NDArray[np.float64]


def render(
    uavs: NDArray[np.float32],
    users: NDArray[np.float32],
    age: NDArray[np.float32],
    transmission_range: float,
    detection_range: float,
) -> NDArray[np.uint8]:
    """(512, 512, 3) pixels: UAVs as dark discs with their transmission range (filled) and detection range (ring), users as
    discs from blue (AoI 0) to orange (AoI K).

    Args:
        uavs: (M, 2) positions.
        users: (N, 2) positions.
        age: (N,) AoI/K.
        transmission_range: in units of the side of the square.
        detection_range: in units of the side of the square.
    """
    canvas = np.empty((SIDE, SIDE, 3), np.float64)
    canvas[:] = _PAPER
    scale = SIDE * (1 - 2 * _MARGIN)
    for i in range(11):
        at = round(SIDE * _MARGIN + scale * i / 10)
        canvas[at - 1 : at + 1] = canvas[:, at - 1 : at + 1] = _GRID

    def pixels(position: NDArray[np.float32]) -> tuple[float, float]:
        return SIDE * _MARGIN + scale * float(position[0]), SIDE * (1 - _MARGIN) - scale * float(position[1])

    for uav in uavs:
        _disc(canvas, pixels(uav), scale * transmission_range, _RANGE, 0.25)
        _ring(canvas, pixels(uav), scale * detection_range, _RANGE)
    for user, old in zip(users, age):
        share = min(max(float(old), 0.0), 1.0)
        colour = tuple((1 - share) * fresh + share * late for fresh, late in zip(_FRESH, _OLD))
        _disc(canvas, pixels(user), 8.0, _PAPER, 1.0)
        _disc(canvas, pixels(user), 6.5, colour, 1.0)
    for uav in uavs:
        _disc(canvas, pixels(uav), 7.0, _PAPER, 1.0)
        _disc(canvas, pixels(uav), 5.5, _UAV, 1.0)
    return canvas.round().astype(np.uint8)


def _disc(canvas: Canvas, centre: tuple[float, float], radius: float, colour: tuple[float, ...], opacity: float) -> None:
    _paint(canvas, centre, radius, colour, lambda distance: opacity * np.clip(radius + 0.5 - distance, 0, 1))


def _ring(canvas: Canvas, centre: tuple[float, float], radius: float, colour: tuple[float, ...]) -> None:
    _paint(canvas, centre, radius + 1, colour, lambda distance: np.clip(1.25 - np.abs(distance - radius), 0, 1))


def _paint(
    canvas: Canvas,
    centre: tuple[float, float],
    reach: float,
    colour: tuple[float, ...],
    opacity: Callable[[Canvas], Canvas],
) -> None:
    """Blends a colour over the pixels within `reach`; `opacity` is a function of the distance."""
    x, y = centre
    left, right = max(int(x - reach) - 1, 0), min(int(x + reach) + 2, SIDE)
    top, bottom = max(int(y - reach) - 1, 0), min(int(y + reach) + 2, SIDE)
    if left >= right or top >= bottom:
        return
    rows, columns = np.mgrid[top:bottom, left:right]
    cover = opacity(np.hypot(columns - x, rows - y))[..., None]
    part = canvas[top:bottom, left:right]
    part += cover * (np.asarray(colour) - part)
