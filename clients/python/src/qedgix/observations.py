"""What a fleet observes in a slot, from arrays or from dicts: a `Scene` or a `Graph`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._values import mapping, several, whole
from .errors import invalid
from .v1 import policy_pb2 as pb

__all__ = ["Graph", "Observation", "Scene"]

Points: TypeAlias = ArrayLike | Mapping[str, Sequence[float]]
Numbers: TypeAlias = ArrayLike | Mapping[str, float]


class Scene:
    """Absolute positions of all UAVs and users, from which the server derives who detects whom.

    Args:
        uavs: positions of the M UAVs in units of the side of the square: an array (M, 2), or a mapping from id to (x, y).
        users: positions of the N users: an array (N, 2), or a mapping from id to (x, y).
        aoi: AoI of the users in slots: an array (N,) in the order of `users`, or a mapping from id. Default: 0.
        uav_ids: ids of the UAVs, if `uavs` is an array. Default: uav-0, uav-1, ... A UAV has the same id in every slot.
        user_ids: ids of the users, if `users` is an array. Default: user-0, user-1, ...
        speeds: speed of each UAV per second: an array (M,), or a mapping from id. Default: that of the world.
        endurance: time in seconds that each UAV can still fly: as `speeds`. For the constraint return_in_time.

    Raises:
        InvalidArgument: an array has another shape, or ids do not fit. The server checks the values.

    Example:
        >>> Scene(uavs={"a": (0.5, 0.5)}, users={"u1": (0.2, 0.3), "u2": (0.6, 0.7)}, aoi={"u1": 4, "u2": 0})
        <Scene: 1 UAVs, 2 users>
    """

    __slots__ = ("_aoi", "_endurance", "_speeds", "_uav_ids", "_uavs", "_user_ids", "_users")

    def __init__(
        self,
        uavs: Points,
        users: Points,
        aoi: Numbers | None = None,
        *,
        uav_ids: Sequence[str] | None = None,
        user_ids: Sequence[str] | None = None,
        speeds: Numbers | None = None,
        endurance: Numbers | None = None,
    ) -> None:
        self._uav_ids, self._uavs = _points("scene.uavs", uavs, uav_ids, "uav")
        self._user_ids, self._users = _points("scene.users", users, user_ids, "user")
        self._aoi = [0.0] * len(self._user_ids) if aoi is None else _numbers("scene.aoi", aoi, self._user_ids)
        self._speeds = None if speeds is None else _numbers("scene.speeds", speeds, self._uav_ids)
        self._endurance = None if endurance is None else _numbers("scene.endurance", endurance, self._uav_ids)

    def fill(self, scene: pb.Scene) -> None:
        """Writes the scene to a message."""
        # A scene without nodes is one, too.
        scene.SetInParent()
        add_uav, add_user = scene.uavs.add, scene.users.add
        for name, (x, y) in zip(self._uav_ids, self._uavs):
            add_uav(id=name, x=x, y=y)
        for name, (x, y), aoi in zip(self._user_ids, self._users, self._aoi):
            add_user(id=name, x=x, y=y, aoi=aoi)
        if self._speeds is not None:
            for uav, speed in zip(scene.uavs, self._speeds):
                uav.speed = speed
        if self._endurance is not None:
            for uav, seconds in zip(scene.uavs, self._endurance):
                uav.endurance_seconds = seconds

    def message(self) -> pb.Scene:
        """The message of the protocol."""
        scene = pb.Scene()
        self.fill(scene)
        return scene

    def __repr__(self) -> str:
        return f"<Scene: {len(self._uavs)} UAVs, {len(self._users)} users>"


class Graph:
    """What each UAV detects. The server derives what users detect.

    Args:
        detections: for each UAV, by id, the nodes that it detects: a mapping from the id of the target to its position
            relative to the UAV, (x, y) in units of the side of the square; (x, y, AoI) of a user, if UAVs know different AoI.
        aoi: AoI of the users of the fleet in slots, by id, also of users that no UAV detects.
        positions: position (x, y) of each UAV by id, for policies that need their own position. Default: none.
        speeds: speed per second of UAVs by id. Default: that of the world.
        endurance: time in seconds that UAVs can still fly, by id. For the constraint return_in_time.

    Raises:
        InvalidArgument: an id is unknown, or a position is not two numbers.

    Example:
        >>> Graph({"a": {"b": (0.1, 0.0), "u1": (0.0, -0.2)}, "b": {}}, aoi={"u1": 3, "u2": 0})
        <Graph: 2 UAVs, 2 users>
    """

    __slots__ = ("_message",)

    def __init__(
        self,
        detections: Mapping[str, Mapping[str, Sequence[float]]],
        aoi: Mapping[str, float] | None = None,
        positions: Mapping[str, Sequence[float]] | None = None,
        *,
        speeds: Mapping[str, float] | None = None,
        endurance: Mapping[str, float] | None = None,
    ) -> None:
        message = pb.Graph()
        _texts("graph.uavs", mapping("graph.detections", detections))
        users = {} if aoi is None else dict(mapping("graph.aoi", aoi))
        _texts("graph.users", users)
        for field, of_uavs in (("positions", positions), ("speeds", speeds), ("endurance", endurance)):
            for name in () if of_uavs is None else mapping(f"graph.{field}", of_uavs):
                if name not in detections:
                    raise invalid(f"graph.{field}[{name}]", name, "a UAV of `detections`")
        for name, targets in detections.items():
            node = message.nodes.add(id=name, kind=pb.NODE_KIND_UAV)
            if positions is not None:
                node.position.x, node.position.y = _pair(f"graph.positions[{name}]", positions.get(name))
            if speeds is not None and name in speeds:
                node.speed = _number(f"graph.speeds[{name}]", speeds[name])
            if endurance is not None and name in endurance:
                node.endurance_seconds = _number(f"graph.endurance[{name}]", endurance[name])
            _texts(f"graph.detections[{name}]", mapping(f"graph.detections[{name}]", targets))
            for target, seen in targets.items():
                field = f"graph.detections[{name}][{target}]"
                if target in detections:
                    x, y = _pair(field, seen)
                    node.detections.add(target_id=target, rel_x=x, rel_y=y)
                    continue
                x, y, age = _sighting(field, seen, users.get(target))
                node.detections.add(target_id=target, rel_x=x, rel_y=y, aoi=age)
                users.setdefault(target, age)
        for name, age in users.items():
            message.nodes.add(id=name, kind=pb.NODE_KIND_USER, aoi=_number(f"graph.aoi[{name}]", age))
        self._message = message

    @classmethod
    def from_arrays(
        cls,
        edge_index: ArrayLike,
        edge_relative: ArrayLike,
        aoi: ArrayLike,
        *,
        uavs: int | None = None,
        positions: ArrayLike | None = None,
        uav_ids: Sequence[str] | None = None,
        user_ids: Sequence[str] | None = None,
    ) -> Graph:
        """A graph of M UAVs and N users from arrays.

        Args:
            edge_index: (E, 2) integers: node `edge_index[e, 0]`, a UAV, detects node `edge_index[e, 1]`. UAVs are nodes 0 to
                M - 1, users are nodes M to M + N - 1.
            edge_relative: (E, 2): position of the target minus position of the UAV, in units of the side of the square.
            aoi: (N,) AoI of every user in slots.
            uavs: M. Default: from `positions` or `uav_ids`, one of which is then required.
            positions: (M, 2) positions of the UAVs, for policies that need their own position.
            uav_ids: default uav-0, uav-1, ...
            user_ids: default user-0, user-1, ...

        Raises:
            InvalidArgument: an array has another shape, an index is no whole number or out of range, or an edge is there twice.
        """
        places = None if positions is None else _rows("graph.positions", positions)
        if uavs is not None:
            given = whole("uavs", uavs, 0, 2**32 - 1)
        else:
            given = len(places) if places is not None else len(uav_ids or ())
        names = _ids("graph.uavs", uav_ids, given, "uav")
        if places is not None and len(places) != given:
            raise invalid("graph.positions", len(places), f"{given} rows, one per UAV")
        ages = _column("graph.aoi", aoi, None)
        users = _ids("graph.users", user_ids, len(ages), "user")
        ids = [*names, *users]
        # No edges are an array without a second dimension.
        index, relative = (
            _rows(field, edges) if np.size(edges) else []
            for field, edges in (("graph.edge_index", edge_index), ("graph.edge_relative", edge_relative))
        )
        if len(index) != len(relative):
            raise invalid("graph.edge_relative", len(relative), f"{len(index)} rows, one per row of edge_index")
        detections: dict[str, dict[str, list[float]]] = {name: {} for name in names}
        for e, (edge, pair) in enumerate(zip(index, relative)):
            field = f"graph.edge_index[{e}]"
            source = _index(field, edge[0], given, "the index of a UAV")
            target = _index(field, edge[1], len(ids), "the index of a node")
            seen = detections[ids[source]]
            if ids[target] in seen:
                raise invalid(field, f"({source}, {target})", "each edge once")
            seen[ids[target]] = pair
        return cls(
            detections,
            dict(zip(users, ages)),
            None if places is None else dict(zip(names, places)),
        )

    def message(self) -> pb.Graph:
        """The message of the protocol."""
        return self._message

    def __repr__(self) -> str:
        uavs = sum(node.kind == pb.NODE_KIND_UAV for node in self._message.nodes)
        return f"<Graph: {uavs} UAVs, {len(self._message.nodes) - uavs} users>"


Observation: TypeAlias = Scene | Graph | pb.Scene | pb.Graph | Mapping[str, Any]
"""What `act` accepts: a `Scene`, a `Graph`, their messages (such as the scenes of a hosted environment), or a dict with the
fields of the message: `{"uavs": [...], "users": [...]}` or `{"nodes": [...]}`, as in JSON."""


def put(observation: Observation, request: pb.ActRequest) -> None:
    """Sets the observation of a request."""
    if isinstance(observation, Scene):
        return observation.fill(request.scene)
    message: pb.Scene | pb.Graph
    if isinstance(observation, Graph):
        message = observation.message()
    elif isinstance(observation, (pb.Scene, pb.Graph)):
        message = observation
    elif isinstance(observation, Mapping):
        message = _from_dict(observation)
    else:
        raise invalid(
            "observation",
            type(observation).__name__,
            "a Scene, a Graph, or a dict with uavs and users, or nodes",
        )
    if isinstance(message, pb.Scene):
        request.scene.CopyFrom(message)
    else:
        request.graph.CopyFrom(message)


def _from_dict(fields: Mapping[str, Any]) -> pb.Scene | pb.Graph:
    try:
        if "nodes" not in fields:
            return pb.Scene(**fields)
        kinds = {"uav": pb.NODE_KIND_UAV, "user": pb.NODE_KIND_USER}
        nodes = [{**node, "kind": kinds.get(node.get("kind", ""), node.get("kind"))} for node in fields["nodes"]]
        return pb.Graph(**{**fields, "nodes": nodes})
    except (TypeError, ValueError, AttributeError) as error:
        name = "graph" if "nodes" in fields else "scene"
        raise invalid(name, error, f"the fields of qedgix.v1.{name.title()}") from None


_DEFAULT_IDS: dict[tuple[str, int], tuple[str, ...]] = {}


def _default_ids(prefix: str, count: int) -> tuple[str, ...]:
    """`prefix`-0, `prefix`-1, ..."""
    known = _DEFAULT_IDS.get((prefix, count))
    if known is None:
        known = tuple(f"{prefix}-{i}" for i in range(count))
        # A fleet has few sizes; a caller with many does not fill the memory.
        if len(_DEFAULT_IDS) < 64:
            _DEFAULT_IDS[prefix, count] = known
    return known


def _ids(field: str, given: Sequence[str] | None, count: int, prefix: str) -> Sequence[str]:
    if given is None:
        return _default_ids(prefix, count)
    ids = several(f"{field}.ids", given)
    if len(ids) != count:
        raise invalid(f"{field}.ids", len(ids), f"{count} ids")
    return _texts(field, ids)


def _texts(field: str, ids: Iterable[str]) -> Sequence[str]:
    for name in ids:
        if not isinstance(name, str):
            raise invalid(f"{field}.ids", repr(name), "a str")
    return tuple(ids)


def _array(values: ArrayLike, field: str) -> NDArray[Any]:
    """An array of numbers. What simulators send is one already."""
    if type(values) is np.ndarray and values.dtype.kind in "fiu":
        return values
    try:
        return np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise invalid(field, values, "numbers") from None


def _rows(field: str, points: ArrayLike) -> list[list[float]]:
    """The rows of an array (n, 2)."""
    array = _array(points, field)
    # No points are an array without a second dimension.
    if array.shape == (0,):
        return []
    if array.ndim != 2 or array.shape[1] != 2:
        raise invalid(field, array.shape, "shape (n, 2)")
    rows: list[list[float]] = array.tolist()
    return rows


def _index(field: str, number: float, count: int, expected: str) -> int:
    # Numbers that are not finite are not within the range.
    if not 0 <= number < count or number != int(number):
        raise invalid(field, number, f"{expected}, 0 to {count - 1}")
    return int(number)


def _column(field: str, numbers: ArrayLike, count: int | None) -> list[float]:
    """The values of an array (count,)."""
    array = _array(numbers, field)
    if array.ndim != 1 or count not in (None, len(array)):
        raise invalid(field, array.shape, f"shape ({'n' if count is None else count},)")
    values: list[float] = array.tolist()
    return values


def _points(field: str, points: Points, ids: Sequence[str] | None, prefix: str) -> tuple[Sequence[str], list[Any]]:
    """Ids, and a pair of numbers for each."""
    if type(points) is not np.ndarray and isinstance(points, Mapping):
        if ids is not None:
            raise invalid(field, "ids", "a mapping, or an array with ids")
        return _texts(field, points), [_pair(f"{field}[{name}]", pair) for name, pair in points.items()]
    rows = _rows(field, cast("ArrayLike", points))
    return _ids(field, ids, len(rows), prefix), rows


def _pair(field: str, pair: Any) -> tuple[float, float]:
    try:
        x, y = pair
        return float(x), float(y)
    except (TypeError, ValueError):
        raise invalid(field, pair, "two numbers (x, y)") from None


def _sighting(field: str, seen: Any, age: float | None) -> tuple[float, float, float]:
    """Relative position and AoI of a user, of which `age` is known already."""
    try:
        x, y, *known = seen
        [found] = known or [age]
        return float(x), float(y), float(found)
    except (TypeError, ValueError):
        raise invalid(field, seen, "two numbers (x, y) and the AoI in `aoi`, or three numbers (x, y, AoI)") from None


def _number(field: str, number: Any) -> float:
    try:
        return float(number)
    except (TypeError, ValueError):
        raise invalid(field, number, "a number") from None


def _numbers(field: str, numbers: Numbers, ids: Sequence[str]) -> list[float]:
    """One number per id."""
    if type(numbers) is not np.ndarray and isinstance(numbers, Mapping):
        if len(numbers) != len(ids) or any(name not in numbers for name in ids):
            raise invalid(field, sorted(map(str, numbers)), f"the ids {sorted(ids)}")
        return [_number(f"{field}[{name}]", numbers[name]) for name in ids]
    return _column(field, cast("ArrayLike", numbers), len(ids))
