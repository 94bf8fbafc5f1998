# Generated from _async by `generate`. Do not edit.
"""One UAV that decides alone, by its own sensors and the messages of other UAVs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from .._values import made, mapping, number, several, text
from ..errors import invalid
from ..results import Decision
from ..v1 import policy_pb2 as pb
from .transport import Transport, Method

_SERVICE = "/qedgix.v1.PolicyService/"
ENCODE = Method(_SERVICE + "Encode", pb.EncodeRequest, pb.EncodeResponse)
DECIDE = Method(_SERVICE + "Decide", pb.DecideRequest, pb.DecideResponse)


class Uav:
    """One UAV of a fleet without a centre. In every slot, `encode` takes what it observes and returns its message to others, and
    `decide` takes the messages of others and returns its heading.

    Obtain one from `Client.uav`. Its whole memory is `state`: save it, and a new object continues from there.
    """

    def __init__(self, transport: Transport, first: pb.EncodeRequest, uav_id: str, state: bytes) -> None:
        self._transport = transport
        self._first = first
        self.uav_id = uav_id
        """Id of the UAV."""
        self.state = state
        """What the UAV remembers: bytes that the next call needs. Empty before the first slot."""
        self.message_links: int | None = None
        """After `encode`: `decide` needs the messages of UAVs within so many links. None: those of all UAVs."""
        self.message_range: float | None = None
        """After `encode`: distance within which all these UAVs are. None: any distance."""
        self.missing: list[str] = []
        """After `decide`: UAVs that this one detects and whose messages were missing."""

    def encode(
        self,
        detections: Mapping[str, Sequence[float]],
        position: Sequence[float] | None = None,
        *,
        speed: float | None = None,
        timeout: float | None = None,
    ) -> bytes:
        """Returns the message to other UAVs, for this slot. A retry with the same state returns the same message.

        Args:
            detections: the nodes that this UAV detects: from the id to the position relative to it, (x, y) of a UAV,
                (x, y, AoI) of a user.
            position: its own position, for policies that need it.
            speed: its speed per second. Default: that of the world.
            timeout: seconds for all attempts. Default: that of the client.

        Raises:
            QedgixError: as `act` of a session. The state has not changed.
        """
        request = pb.EncodeRequest()
        request.CopyFrom(self._first)
        if self.state:
            request.state = self.state
            request.ClearField("uav_ids")
            request.ClearField("user_ids")
            request.ClearField("seed")
        node = request.observation
        node.id, node.kind = self.uav_id, pb.NODE_KIND_UAV
        if position is not None:
            node.position.x, node.position.y = _numbers("position", position, (2,))
        if speed is not None:
            node.speed = number("speed", speed)
        for target, seen in mapping("detections", detections).items():
            text("detections", target)
            x, y, *aoi = _numbers(f"detections[{target}]", seen, (2, 3))
            node.detections.add(target_id=target, rel_x=x, rel_y=y, aoi=aoi[0] if aoi else None)
        response = self._transport.call(ENCODE, request, timeout)
        self.state = response.state
        self.message_links = response.message_links if response.HasField("message_links") else None
        self.message_range = response.message_range if response.HasField("message_range") else None
        message: bytes = response.message
        return message

    def decide(
        self,
        messages: Iterable[bytes] = (),
        *,
        q_values: bool = False,
        motion: bool = False,
        timeout: float | None = None,
    ) -> Decision:
        """Returns the heading of this UAV, as a decision for one UAV, and goes on to the next slot.

        Args:
            messages: the messages of other UAVs for this slot, in any order.
            q_values: whether to return Q-values.
            motion: whether to return velocity and waypoint.
            timeout: seconds for all attempts. Default: that of the client.

        Raises:
            QedgixError: as `act` of a session. The state has not changed.
        """
        request = made(
            pb.DecideRequest,
            policy=self._first.policy,
            state=self.state,
            messages=several("messages", messages),
            return_q_values=q_values,
            return_velocity=motion,
            return_waypoint=motion,
        )
        if self._first.HasField("frame"):
            request.frame.CopyFrom(self._first.frame)
        if self._first.HasField("world"):
            request.world.CopyFrom(self._first.world)
        response = self._transport.call(DECIDE, request, timeout)
        self.state = response.state
        self.missing = list(response.missing_uav_ids)
        return Decision(pb.ActResponse(actions=[response.action], policy=response.policy, step=response.step))


def _numbers(field: str, given: Sequence[float], counts: tuple[int, ...]) -> list[float]:
    try:
        numbers = [float(number) for number in given]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) not in counts:
        raise invalid(field, given, "two numbers (x, y), or of a user three (x, y, AoI)")
    return numbers
