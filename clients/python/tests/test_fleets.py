"""Fleets in coordinates of their own, in other worlds, and fleets that change."""

from __future__ import annotations

import numpy as np
import pytest
from test_act import SLOTS, Fleet, expected

import qedgix

SIDE = 1000.0
ORIGIN = np.array([50.0, -20.0])


def in_metres(points: np.ndarray, degrees: float) -> np.ndarray:
    """Points of the unit square in an area of one kilometre that is turned."""
    angle = np.deg2rad(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return ORIGIN + SIDE * points @ turn.T


@pytest.mark.parametrize("degrees", [0.0, 30.0])
@pytest.mark.parametrize("local", [False, True])
def test_a_frame_is_the_same_flight_in_other_coordinates(client, degrees, local):
    frame = qedgix.Frame(side=SIDE, origin=tuple(ORIGIN), rotation_deg=degrees)
    wanted = expected(client, "sweep")
    fleet = client.local_session if local else client.open_session
    session = fleet("sweep", seed=7, frame=frame)
    for step in range(SLOTS):
        slot = Fleet(step)
        uavs = in_metres(slot.uavs, degrees)
        decision = session.act(qedgix.Scene(uavs, in_metres(slot.users, degrees), slot.aoi), motion=True)
        assert decision.headings.tolist() == wanted[step]
        assert np.allclose(decision.degrees % 360, (45 * decision.headings + degrees) % 360)
        assert np.allclose(decision.velocities, 0.04 * SIDE * decision.directions)
        # Waypoints stay in the area.
        moved = uavs + decision.velocities
        inside = ((slot.uavs > 0.05) & (slot.uavs < 0.95)).all(axis=1)
        assert inside.any() and np.allclose(decision.waypoints[inside], moved[inside])
    if not local:
        session.close()


def test_motion_is_returned_only_when_it_is_asked_for(client):
    scene = Fleet(0).scene()
    assert client.act(scene, policy="sweep").velocities is None
    decision = client.act(scene, policy="sweep", motion=True)
    assert decision.velocities.shape == decision.waypoints.shape == (3, 2)
    graph = qedgix.Graph({"a": {}, "b": {}}, {"u": 1})
    decision = client.act(graph, policy="random", motion=True)
    assert decision.velocities.shape == (2, 2) and decision.waypoints is None
    with client.stream() as stream, client.session("sweep") as session:
        assert stream.act(session, scene, motion=True).velocities is not None


def test_a_world_that_differs_is_warned_of(client):
    with client.session("qedgix", world=qedgix.World(speed=0.02)) as session:
        assert [warning.field for warning in session.warnings] == ["world.speed"]
        assert session.warnings[0].message
        decision = session.act(Fleet(0).scene(), motion=True)
        assert np.allclose(decision.velocities, 0.02 * decision.directions)
    with client.session("qedgix") as session:
        assert session.warnings == ()


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"frame": qedgix.Frame()}, "frame.side"),
        ({"frame": qedgix.Frame(width=-1, height=1)}, "frame.width"),
        ({"frame": qedgix.Frame(width=1)}, "frame.height"),
        ({"frame": qedgix.Frame(side="wide")}, "frame"),
        ({"frame": qedgix.Frame(side=1, origin=(0,))}, "frame"),
        ({"world": qedgix.World(speed=-1)}, "world.speed"),
        ({"world": qedgix.World(slots=1.5)}, "world"),
        ({"world": qedgix.World(boundary="open")}, "world.boundary"),
        ({"constraints": qedgix.Constraints(min_separation=-1)}, "constraints.min_separation"),
        ({"constraints": qedgix.Constraints(home=(0, 0, 0, 0))}, "constraints"),
        ({"constraints": qedgix.Constraints(no_fly=[(0, 0)])}, "constraints"),
        ({"constraints": qedgix.Constraints(no_fly=[qedgix.Zone(corners=[(0,)])])}, "constraints.no_fly"),
    ],
)
def test_what_is_not_accepted_is_named(client, options, field):
    with pytest.raises(qedgix.InvalidArgument) as refused, client.session("sweep", **options):
        pass
    assert refused.value.field == field


def test_constraints_overrule_headings(client):
    scene = qedgix.Scene(
        {"a": (0.5, 0.5), "b": (0.52, 0.5)}, {"u": (0.9, 0.5), "v": (0.1, 0.5)}, endurance={"a": 900, "b": 900}
    )
    free = client.act(scene, policy="greedy-global")
    assert free.overruled == {}
    around = [(0.51, 0.3), (0.51, 0.7), (0.7, 0.7), (0.7, 0.3)]
    walls = [qedgix.Zone(corners=around), qedgix.Zone(center=(0.45, 0.5), radius=0.02)]
    constraints = qedgix.Constraints(no_fly=walls, min_separation=0.01, home=(0.5, 0.5), max_distance=0.4, return_in_time=True)
    local = client.local_session("greedy-global", constraints=constraints)
    with client.session("greedy-global", constraints=constraints) as session:
        for fleet in (session, local):
            decision = fleet.act(scene)
            assert set(decision.overruled) <= {"a", "b"} and decision.overruled
            for name, overruled in decision.overruled.items():
                assert overruled.preferred_heading == free.by_id[name]
                assert "no_fly" in overruled.because + overruled.violates


def test_every_uav_has_its_speed(client):
    slot = Fleet(0)
    speeds = {"uav-0": 0.01, "uav-1": 0.02, "uav-2": 0.04}
    for given in (speeds, list(speeds.values())):
        uavs = dict(zip(speeds, slot.uavs)) if given is speeds else slot.uavs
        decision = client.act(qedgix.Scene(uavs, slot.users, slot.aoi, speeds=given), policy="sweep", motion=True)
        assert np.allclose(np.linalg.norm(decision.velocities, axis=1), list(speeds.values()))
    graph = qedgix.Graph({"a": {}, "b": {}}, {}, {"a": (0.5, 0.5), "b": (0.4, 0.4)}, speeds={"a": 0.01}, endurance={"b": 60})
    decision = client.act(graph, policy="sweep", motion=True)
    assert np.allclose(np.linalg.norm(decision.velocities, axis=1), [0.01, 0.04])


@pytest.mark.parametrize("policy", ["sweep", "nearest"])
def test_uavs_and_users_come_and_go(client, policy):
    slot = Fleet(1)
    uavs = dict(zip("abc", slot.uavs))
    users = dict(zip("uvwxy", slot.users))
    with client.session(policy) as session:
        for present in ("abc", "ab", "abcd", "d", "abc"):
            scene = qedgix.Scene({name: uavs.get(name, (0.5, 0.5)) for name in present}, users)
            assert session.act(scene).uav_ids == list(present)
            users.pop(next(iter(users)))


def test_a_report_of_one_node_need_not_be_one_of_both(client):
    graph = qedgix.Graph({"a": {"b": (0.1, 0.0)}, "b": {}}, {"u": 0}, {"a": (0.4, 0.5), "b": (0.5, 0.5)})
    for symmetric in (True, False):
        assert client.act(graph, policy="sweep", symmetric=symmetric).headings.shape == (2,)
