"""Where a fleet flies, if not in the unit square of the policy: frame of coordinates, world and constraints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ._values import instance
from .errors import QedgixError, invalid
from .v1 import policy_pb2 as pb

__all__ = ["Constraints", "Frame", "Surroundings", "World", "Zone"]


@dataclass(frozen=True)
class Frame:
    """The area that a fleet flies in, a rectangle in your coordinates, for example in metres.

    With a frame, all coordinates, lengths and speeds of observations, decisions and of the `World` are yours.

    Attributes:
        side: side of a square area; or None, with width and height.
        width: length along the x axis of the area.
        height: length along the y axis of the area.
        origin: corner of the area with the smallest coordinates along its axes.
        rotation_deg: direction of the x axis of the area, in degrees counter-clockwise from your x axis.
    """

    side: float | None = None
    width: float | None = None
    height: float | None = None
    origin: Sequence[float] = (0.0, 0.0)
    rotation_deg: float = 0.0

    def message(self) -> pb.Frame:
        """The message of the protocol."""
        try:
            return pb.Frame(
                origin=_position(self.origin),
                side=self.side,
                width=self.width,
                height=self.height,
                rotation_deg=self.rotation_deg,
            )
        except (TypeError, ValueError):
            raise invalid("frame", self, "numbers") from None


@dataclass(frozen=True)
class World:
    """What differs from the world of the policy; None: as the policy was trained. Lengths are in units of the frame.

    Attributes:
        slot_seconds: duration of a slot in seconds. Default: 1, so that a speed is a distance per slot.
        speed: speed of the UAVs, per second; at most a side of the square per slot.
        transmission_range: range within which a UAV collects the data of a user.
        detection_range: range within which nodes detect each other; at least the transmission range.
        communication_range: range within which UAVs exchange messages. Default: the detection range, if given.
        slots: how far policies that plan look ahead, in slots.
        boundary: `clamp`: UAVs stay in the area; `free`: they may leave it. Default: clamp.
    """

    slot_seconds: float | None = None
    speed: float | None = None
    transmission_range: float | None = None
    detection_range: float | None = None
    communication_range: float | None = None
    slots: int | None = None
    boundary: str | None = None

    def message(self) -> pb.World:
        """The message of the protocol."""
        boundaries = {None: pb.BOUNDARY_UNSPECIFIED, "clamp": pb.BOUNDARY_CLAMP, "free": pb.BOUNDARY_FREE}
        if self.boundary not in boundaries:
            raise invalid("world.boundary", self.boundary, "clamp or free")
        try:
            return pb.World(
                slot_seconds=self.slot_seconds,
                speed=self.speed,
                transmission_range=self.transmission_range,
                detection_range=self.detection_range,
                communication_range=self.communication_range,
                slots=self.slots,
                boundary=boundaries[self.boundary],
            )
        except (TypeError, ValueError):
            raise invalid("world", self, "numbers, slots a whole one") from None


@dataclass(frozen=True)
class Zone:
    """A zone that no UAV enters: a polygon, or a circle.

    Attributes:
        corners: (n, 2) corners of a polygon in order, 3 to 64.
        center: centre of a circle.
        radius: radius of the circle.
    """

    corners: Sequence[Sequence[float]] = ()
    center: Sequence[float] | None = None
    radius: float | None = None

    def message(self) -> pb.Zone:
        """The message of the protocol."""
        try:
            return pb.Zone(
                corners=[_position(corner) for corner in self.corners],
                center=None if self.center is None else _position(self.center),
                radius=self.radius,
            )
        except (TypeError, ValueError):
            raise invalid("constraints.no_fly", self, "numbers") from None


@dataclass(frozen=True)
class Constraints:
    """What no heading may break; each UAV gets the best heading that keeps them. Requires the position of every UAV.

    If no heading keeps all, a UAV gets the one that breaks least, and `Decision.overruled` says so.

    Attributes:
        no_fly: at most 64 zones that no UAV enters.
        min_separation: minimum distance between two UAVs.
        home: where UAVs return to. Required by max_distance and return_in_time.
        max_distance: maximum distance from home.
        return_in_time: whether every UAV with an `endurance` in the observation flies home in time.
    """

    no_fly: Sequence[Zone] = ()
    min_separation: float | None = None
    home: Sequence[float] | None = None
    max_distance: float | None = None
    return_in_time: bool = False

    def message(self) -> pb.Constraints:
        """The message of the protocol."""
        try:
            return pb.Constraints(
                no_fly=[zone.message() for zone in self.no_fly],
                min_separation=self.min_separation,
                home=None if self.home is None else _position(self.home),
                max_distance=self.max_distance,
                return_in_time=self.return_in_time,
            )
        except (TypeError, ValueError, AttributeError) as error:
            if isinstance(error, QedgixError):
                raise
            raise invalid("constraints", self, "zones and numbers") from None


@dataclass(frozen=True)
class Surroundings:
    """What a fleet keeps for its whole flight; the defaults are those of the policy in the unit square."""

    frame: Frame | None = None
    world: World | None = None
    constraints: Constraints | None = None
    symmetric: bool = True

    def put(self, request: Any) -> None:
        """Writes what is set to a request."""
        if self.frame is not None:
            request.frame.CopyFrom(instance("frame", self.frame, Frame).message())
        if self.world is not None:
            request.world.CopyFrom(instance("world", self.world, World).message())
        if self.constraints is not None:
            request.constraints.CopyFrom(instance("constraints", self.constraints, Constraints).message())
        if not self.symmetric:
            request.symmetric = False


def _position(point: Sequence[float]) -> pb.Position:
    x, y = point
    return pb.Position(x=x, y=y)
