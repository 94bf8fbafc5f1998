"""Sessions, local sessions, batches, streams and observations against a server."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import qedgix
from qedgix.v1 import policy_pb2 as pb

SLOTS = 6
RANGE = 0.28


class Fleet:
    """What a fleet of 3 UAVs and 5 users observes in one slot, drawn from a seed."""

    def __init__(self, seed: int) -> None:
        draw = np.random.default_rng(seed)
        # The server computes with f32.
        self.uavs = draw.random((3, 2), np.float32).astype(np.float64)
        self.users = draw.random((5, 2), np.float32).astype(np.float64)
        self.aoi = draw.integers(0, 80, 5)

    def scene(self) -> qedgix.Scene:
        return qedgix.Scene(self.uavs, self.users, self.aoi)

    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        nodes = np.concatenate([self.uavs, self.users])
        relative = nodes[None] - nodes[:, None]
        near = (relative**2).sum(-1) <= RANGE**2
        np.fill_diagonal(near, False)
        near[3:] = False
        index = np.argwhere(near)
        return index, relative[index[:, 0], index[:, 1]]

    def forms(self) -> dict[str, qedgix.Observation]:
        """The same slot in every form."""
        uav_ids, user_ids = [f"uav-{i}" for i in range(3)], [f"user-{j}" for j in range(5)]
        ids = uav_ids + user_ids
        index, relative = self.edges()
        detections: dict[str, dict[str, tuple[float, float]]] = {name: {} for name in uav_ids}
        for (source, target), (x, y) in zip(index, relative):
            detections[ids[source]][ids[target]] = (x, y)
        uavs, users = dict(zip(uav_ids, self.uavs)), dict(zip(user_ids, self.users))
        aoi = dict(zip(user_ids, self.aoi))
        json = {
            "uavs": [{"id": name, "x": x, "y": y} for name, (x, y) in uavs.items()],
            "users": [{"id": name, "x": x, "y": y, "aoi": aoi[name]} for name, (x, y) in users.items()],
        }
        nodes = [
            {
                "id": name,
                "kind": "uav",
                "position": {"x": x, "y": y},
                "detections": [
                    {"target_id": target, "rel_x": dx, "rel_y": dy, **({"aoi": aoi[target]} if target in aoi else {})}
                    for target, (dx, dy) in detections[name].items()
                ],
            }
            for name, (x, y) in uavs.items()
        ]
        nodes += [{"id": name, "kind": "user", "aoi": age} for name, age in aoi.items()]
        return {
            "arrays": self.scene(),
            "mappings": qedgix.Scene(uavs, users, aoi),
            "message": self.scene().message(),
            "json": json,
            "json of a graph": {"nodes": nodes},
            "graph": qedgix.Graph(detections, aoi, uavs),
            "graph of sightings": qedgix.Graph(
                {
                    uav: {node: (*at, aoi[node]) if node in aoi else at for node, at in seen.items()}
                    for uav, seen in detections.items()
                },
                aoi,
                uavs,
            ),
            "graph of arrays": qedgix.Graph.from_arrays(index, relative, self.aoi, positions=self.uavs),
        }


def fly(act, seeds=range(SLOTS)) -> list[list[int]]:
    return [act(Fleet(seed).scene()).headings.tolist() for seed in seeds]


def expected(client, policy: str, seed: int = 7) -> list[list[int]]:
    with client.session(policy, seed=seed) as session:
        return fly(session.act)


def test_a_session_counts_its_steps_and_closes(client):
    with client.session("qedgix", session_id="counts", seed=7) as session:
        assert session.id == "counts" and session.step == 0
        assert session.policy.name == "qedgix" and len(session.policy.digest) == 64
        for step in range(3):
            decision = session.act(Fleet(step).scene(), q_values=True)
            assert decision.step == step and session.step == step + 1
            assert decision.uav_ids == ["uav-0", "uav-1", "uav-2"]
            assert decision.headings.shape == (3,)
            assert decision.q_values.shape == (3, 8)
            assert (decision.q_values.argmax(1) == decision.headings).all()
            assert (decision.degrees == 45.0 * decision.headings).all()
            assert np.allclose(np.hypot(*decision.directions.T), 1)
            assert decision.by_id == dict(zip(decision.uav_ids, decision.headings))
            assert decision.policy == session.policy and decision.recurrent_state == b""
            assert decision.timings.batch_size >= 1 and decision.timings.compute > 0
        assert [info.steps for info in client.list_sessions() if info.session_id == "counts"] == [3]
        again = client.get_session("counts")
        assert again.step == 3 and again.act(Fleet(3).scene()).step == 3
    assert "counts" not in [info.session_id for info in client.list_sessions()]
    with pytest.raises(qedgix.NotFound):
        session.act(Fleet(4).scene())
    session.close()


@pytest.mark.parametrize("policy", ["qedgix", "sweep"])
def test_every_form_of_an_observation_is_the_same_slot(client, policy):
    headings: dict[str, list[list[int]]] = {}
    for form in Fleet(0).forms():
        with client.session(policy, seed=7) as session:
            headings[form] = [session.act(Fleet(seed).forms()[form]).headings.tolist() for seed in range(SLOTS)]
    # A scene tells which users are near each other, also where no UAV sees both. Only learned policies look at that.
    kinds = ["graph", "scene"] if policy == "qedgix" else ["all"]
    for kind in kinds:
        same = [found for form, found in headings.items() if kind == "all" or ("graph" in form) == (kind == "graph")]
        assert len(same) >= 3 and all(found == same[0] for found in same), headings
    assert headings["arrays"] == expected(client, policy)


def test_a_local_session_flies_as_a_session_does_and_can_be_continued(client):
    wanted = expected(client, "qedgix")
    local = client.local_session("qedgix", seed=7)
    assert fly(local.act, range(3)) == wanted[:3]
    other = client.local_session("qedgix", recurrent_state=local.recurrent_state, step=local.step)
    assert other.act(Fleet(3).scene()).step == 3
    assert other.step == 4
    assert fly(other.act, range(4, SLOTS)) == wanted[4:]
    local.restart()
    assert fly(local.act) == wanted
    assert local.step == SLOTS


def test_a_restarted_session_begins_at_slot_0(client):
    wanted = expected(client, "qedgix")
    with client.session("qedgix", seed=7) as session:
        fly(session.act, range(2))
        session.restart()
        assert fly(session.act) == wanted
        session.restart("run-2")
        assert fly(session.act, range(2)) == wanted[:2]


def test_one_observation_needs_no_session(client):
    decision = client.act(Fleet(0).scene(), policy="qedgix", seed=7)
    assert decision.headings.tolist() == expected(client, "qedgix")[0]
    assert decision.recurrent_state


def test_a_batch_answers_each_fleet_on_its_own(client):
    wanted = [expected(client, "qedgix", seed) for seed in range(3)]
    with client.session("qedgix", seed=0) as session:
        fleets = [session, client.local_session("qedgix", seed=1), client.local_session("nobody")]
        for step in range(SLOTS):
            first, second, third = client.act_batch([(fleet, Fleet(step).scene()) for fleet in fleets])
            assert first.headings.tolist() == wanted[0][step]
            assert second.headings.tolist() == wanted[1][step]
            assert isinstance(third, qedgix.NotFound) and third.code == "not_found"
        assert [fleet.step for fleet in fleets] == [SLOTS, SLOTS, 0]
        with pytest.raises(qedgix.InvalidArgument):
            client.act_batch([(session, Fleet(0).scene())] * 2)


def test_a_stream_keeps_the_order_and_goes_on_after_an_error(client):
    wanted = [expected(client, "qedgix", seed) for seed in range(3)]
    fleets = [client.local_session("qedgix", seed=seed) for seed in range(3)]
    nobody = client.local_session("nobody")
    with client.stream() as stream:
        for step in range(SLOTS):
            for fleet in [*fleets, nobody]:
                stream.send(fleet, Fleet(step).scene())
            assert stream.pending == 4
            with pytest.raises(qedgix.FailedPrecondition):
                stream.send(fleets[0], Fleet(step).scene())
            for seed in range(3):
                assert stream.receive().headings.tolist() == wanted[seed][step]
            with pytest.raises(qedgix.NotFound):
                stream.receive()
        with client.session("qedgix", seed=0) as session:
            assert fly(lambda scene: stream.act(session, scene)) == wanted[0]
        with pytest.raises(qedgix.FailedPrecondition):
            stream.receive()


def test_what_is_not_accepted_is_named(client):
    scene = Fleet(0).scene()
    negative = qedgix.Scene(Fleet(0).uavs, Fleet(0).users, -np.ones(5))
    with client.session("qedgix") as session:
        with pytest.raises(qedgix.InvalidArgument) as refused:
            session.act(negative)
        error = refused.value
        assert (error.code, error.field, error.value) == ("invalid_argument", "scene.users[0].aoi", "-1")
        assert error.expected and error.request_id and isinstance(error, ValueError)
        # The session is still in slot 0.
        assert session.act(scene).step == 0
        session.step = 5
        with pytest.raises(qedgix.FailedPrecondition) as refused:
            session.act(scene)
        assert refused.value.code == "wrong_step"
    with pytest.raises(qedgix.NotFound), client.session("nobody"):
        pass
    with client.session("qedgix", session_id="twice") as session:
        session.act(scene)
        with pytest.raises(qedgix.AlreadyExists):
            client.open_session("qedgix", session_id="twice")
        client.open_session("qedgix", session_id="twice", run_id="another").act(scene)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: qedgix.Scene(np.zeros((3, 3)), np.zeros((5, 2))), "scene.uavs"),
        (lambda: qedgix.Scene(np.zeros((3, 2)), [["a", "b"]]), "scene.users"),
        (lambda: qedgix.Scene(np.zeros((3, 2)), np.zeros((5, 2)), np.zeros(4)), "scene.aoi"),
        (lambda: qedgix.Scene(np.zeros((3, 2)), {"u": (0, 0)}, {"v": 1}), "scene.aoi"),
        (lambda: qedgix.Scene(np.zeros((3, 2)), {"u": (0, 0, 0)}), "scene.users[u]"),
        (lambda: qedgix.Scene(np.zeros((3, 2)), np.zeros((5, 2)), uav_ids=["a"]), "scene.uavs.ids"),
        (lambda: qedgix.Scene(np.zeros((1, 2)), np.zeros((1, 2)), user_ids=[7]), "scene.users.ids"),
        (lambda: qedgix.Scene({3: (0, 0)}, np.zeros((1, 2))), "scene.uavs.ids"),
        (lambda: qedgix.Scene(np.zeros((1, 2)), {"u": (0, 0)}, {"u": "old"}), "scene.aoi[u]"),
        (lambda: qedgix.Graph({"a": {}}, {"u": None}), "graph.aoi[u]"),
        (lambda: qedgix.Graph({1: {}}, {}), "graph.uavs.ids"),
        (lambda: qedgix.Graph({"a": {"u": (0, 0)}}, {}), "graph.detections[a][u]"),
        (lambda: qedgix.Graph({"a": {"u": (0, 0, 1, 2)}}), "graph.detections[a][u]"),
        (lambda: qedgix.Graph({"a": {"b": (0, 0, 1)}, "b": {}}), "graph.detections[a][b]"),
        (lambda: qedgix.Graph({"a": {2: (0, 0, 1)}}), "graph.detections[a].ids"),
        (lambda: qedgix.Graph({"a": {"u": (0,)}}, {"u": 1}), "graph.detections[a][u]"),
        (lambda: qedgix.Graph({"a": {}}, {}, {}), "graph.positions[a]"),
        (lambda: qedgix.Graph({"a": {}}, positions={"a": (0, 0), "A": (0, 0)}), "graph.positions[A]"),
        (lambda: qedgix.Graph({"a": {}}, speeds={"A": 1}), "graph.speeds[A]"),
        (lambda: qedgix.Graph({"a": {}}, endurance={"A": 10}), "graph.endurance[A]"),
        (lambda: qedgix.Graph({"a": {}}, positions=np.zeros((1, 2))), "graph.positions"),
        (lambda: qedgix.Graph(["a"]), "graph.detections"),
        (lambda: qedgix.Graph({"a": [("u", 0, 0)]}), "graph.detections[a]"),
        (lambda: qedgix.Graph.from_arrays([[0, 9]], [[0, 0]], [1], uavs=1), "graph.edge_index[0]"),
        (lambda: qedgix.Graph.from_arrays([[1, 0]], [[0, 0]], [1], uavs=1), "graph.edge_index[0]"),
        (lambda: qedgix.Graph.from_arrays([[0, 1.7]], [[0, 0]], [1], uavs=1), "graph.edge_index[0]"),
        (lambda: qedgix.Graph.from_arrays([[0, 1], [0, np.nan]], [[0, 0]] * 2, [1], uavs=1), "graph.edge_index[1]"),
        (lambda: qedgix.Graph.from_arrays([[0, np.inf]], [[0, 0]], [1], uavs=1), "graph.edge_index[0]"),
        (lambda: qedgix.Graph.from_arrays([[0, 1], [0, 1]], [[0, 0]] * 2, [1], uavs=1), "graph.edge_index[1]"),
        (lambda: qedgix.Graph.from_arrays([], [], [1], uavs=1.5), "uavs"),
        (lambda: qedgix.Scene(np.zeros((3, 0)), []), "scene.uavs"),
        (lambda: qedgix.Scene(np.zeros((1, 2)), [], uav_ids="a"), "scene.uavs.ids"),
        (lambda: qedgix.Graph.from_arrays([[0, 1]], [[0, 0]] * 2, [1], uavs=1), "graph.edge_relative"),
        (lambda: qedgix.Graph.from_arrays([], [], [[1]], uavs=1), "graph.aoi"),
        (lambda: qedgix.Graph.from_arrays([], [], [1], uavs=2, positions=[[0, 0]]), "graph.positions"),
    ],
)
def test_observations_are_checked_before_they_are_sent(make, field):
    with pytest.raises(qedgix.InvalidArgument) as refused:
        make()
    assert refused.value.field == field and refused.value.expected


def test_a_fleet_without_users(client):
    uavs = np.full((2, 2), 0.5)
    for observation in (
        qedgix.Scene(uavs, []),
        qedgix.Scene(uavs, [], [], user_ids=[]),
        qedgix.Scene(uavs, {}, {}),
        qedgix.Scene(uavs, np.zeros((0, 2)), np.zeros(0)),
        qedgix.Graph.from_arrays([], [], [], positions=uavs),
        qedgix.Graph.from_arrays(np.zeros((0, 2), int), np.zeros((0, 2)), np.zeros(0), positions=uavs),
    ):
        assert len(client.act(observation, policy="random").headings) == 2
    assert client.act_batch([]) == []
    with pytest.raises(qedgix.InvalidArgument) as refused:
        client.act(qedgix.Scene([], []), policy="random")
    assert refused.value.field == "scene"


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda client: client.session("qedgix", seed=-1), "seed"),
        (lambda client: client.session("qedgix", seed=1 << 64), "seed"),
        (lambda client: client.session("qedgix", session_id=5), "session_id"),
        (lambda client: client.session("qedgix", run_id=5), "run_id"),
        (lambda client: client.session(5), "policy"),
        (lambda client: client.get_session(5), "session_id"),
        (lambda client: client.local_session("qedgix", seed=-1), "seed"),
        (lambda client: client.local_session("qedgix", recurrent_state="text"), "recurrent_state"),
        (lambda client: client.local_session("qedgix", step=-1), "step"),
        (lambda client: client.uav("qedgix", 1, uav_ids=["a"], user_ids=[]), "uav_id"),
        (lambda client: client.uav("qedgix", "a", uav_ids=["a", 1], user_ids=[]), "uav_ids[1]"),
        (lambda client: client.uav("qedgix", "a", uav_ids=["a"], user_ids=5), "user_ids"),
        (lambda client: client.uav("qedgix", "a", uav_ids=["a"], user_ids=[], seed=-1), "seed"),
        (lambda client: client.uav("qedgix", "a", uav_ids=["a"], user_ids=[]).decide(["text"]), "messages"),
        (lambda client: client.act(Fleet(0).scene(), policy="sweep", timeout="soon"), "timeout"),
        (lambda client: client.session("qedgix", frame=1000), "frame"),
        (lambda client: client.session("qedgix", world={"speed": 1}), "world"),
        (lambda client: client.session("qedgix", constraints={}), "constraints"),
        (lambda client: client.act_batch([Fleet(0).scene()]), "slots[0]"),
        (lambda client: client.act_batch(5), "slots"),
        (lambda client: client.uav("qedgix", "a", uav_ids=["a"], user_ids=[]).decide(5), "messages"),
        (lambda client: client.uav("qedgix", "a", uav_ids=["a"], user_ids=[]).encode([]), "detections"),
        (lambda client: client.uav("qedgix", "a", uav_ids=["a"], user_ids=[]).encode({5: (0, 0)}), "detections"),
        (lambda client: client.policies.get(5), "policy"),
        (lambda client: client.policies.upload("name", 5), "checkpoint"),
        (lambda client: client.jobs.submit(idempotency_key="\u00fc"), "idempotency_key"),
        (lambda client: client.jobs.list(labels="team=a"), "labels"),
        (lambda client: client.jobs.list(created_after="today"), "created_after"),
        (lambda client: client.jobs.list(metrics="loss"), "metrics"),
        (lambda client: client.jobs.submit(idempotency_key=5), "idempotency_key"),
    ],
)
def test_arguments_of_another_type_are_named(client, call, field):
    with pytest.raises(qedgix.InvalidArgument) as refused:
        call(client)
    error = refused.value
    assert error.field == field and error.expected and not error.request_id


def test_a_session_that_was_never_opened_says_so(connect):
    # There is no server: nothing is sent.
    client = connect("127.0.0.1:1")
    session = client.session("qedgix")
    scene = Fleet(0).scene()
    stream = client.stream()
    for call in (
        lambda: session.act(scene),
        lambda: client.act_batch([(session, scene)]),
        lambda: stream.send(session, scene),
        lambda: session.policy,
        lambda: session.warnings,
    ):
        with pytest.raises(qedgix.FailedPrecondition, match=r"not open; use `.*with client\.session") as refused:
            call()
        assert refused.value.code == "not_open" and isinstance(refused.value, RuntimeError)
    stream.close()


@pytest.mark.parametrize(
    "observation", [{"uavs": [{"name": "a"}]}, {"nodes": [{"id": 3}]}, {"nodes": 5}, {"users": {"a"}}, 5, None]
)
def test_wrong_dicts_are_refused(client, observation):
    with pytest.raises(qedgix.InvalidArgument) as refused:
        client.act(observation, policy="sweep")
    assert refused.value.field in ("scene", "graph", "observation")


def test_threads_share_a_client(server):
    client = qedgix.Client(server.grpc, server.http)
    wanted = [expected(client, "qedgix", seed) for seed in range(4)]
    client.close()
    with qedgix.Client(server.grpc, server.http) as client, ThreadPoolExecutor(4) as pool:
        # Nothing is connected yet.
        flown = pool.map(lambda seed: fly(client.local_session("qedgix", seed=seed).act), range(4))
        listed = pool.map(lambda _: len(client.policies.list()), range(4))
        assert list(flown) == wanted and len(set(listed)) == 1


def test_hover_has_no_direction():
    actions = [pb.Action(uav_id="a", heading_index=8), pb.Action(uav_id="b", heading_index=2, heading_deg=90)]
    decision = qedgix.Decision(pb.ActResponse(actions=actions))
    assert np.isnan(decision.degrees[0]) and decision.degrees[1] == 90 and decision.q_values is None
    assert np.allclose(decision.directions, [[0, 0], [0, 1]])
    assert np.allclose(qedgix.directions([0, 2, 8]), [[1, 0], [0, 1], [0, 0]])
