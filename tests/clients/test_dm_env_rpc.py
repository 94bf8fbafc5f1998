"""Hosted environments as worlds of dm_env_rpc: its compliance suites, unmodified, and episodes that are those of EnvironmentService."""

import functools
import json

import dm_env
import grpc
import httpx
import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils
from dm_env_rpc.v1 import compliance, connection, dm_env_adaptor, dm_env_rpc_pb2, error, tensor_utils
from dm_env_rpc.v1.extensions import properties
from world import GRPC, HTTP

WORLD = {"uavs": 3, "users": 5, "slots": 6, "seed": 4}


def packed(settings):
    return {name: tensor_utils.pack_tensor(value) for name, value in settings.items()}


class Stream:
    """A stream of its own, and the world that it has made."""

    def __init__(self, settings=None):
        self.channel = grpc.insecure_channel(GRPC)
        self.connection = connection.Connection(self.channel)
        self.world_name = None
        if settings is not None:
            self.world_name = self.send(dm_env_rpc_pb2.CreateWorldRequest(settings=packed(settings))).world_name

    def send(self, request):
        return self.connection.send(request)

    def join(self):
        return self.send(dm_env_rpc_pb2.JoinWorldRequest(world_name=self.world_name)).specs

    def close(self):
        if self.world_name is not None:
            self.send(dm_env_rpc_pb2.LeaveWorldRequest())
            self.send(dm_env_rpc_pb2.DestroyWorldRequest(world_name=self.world_name))
        self.connection.close()
        self.channel.close()


class OnStream:
    """A suite on a stream of its own. `SETTINGS` are those of its world."""

    SETTINGS = None

    def setUp(self):
        self.stream = Stream(self.SETTINGS)
        super().setUp()

    def tearDown(self):
        super().tearDown()
        self.stream.close()

    @property
    def connection(self):
        return self.stream.connection

    @property
    def world_name(self):
        return self.stream.world_name


class TestCreateDestroyWorld(OnStream, compliance.CreateDestroyWorld):
    required_world_settings = {}
    invalid_world_settings = packed({"invalid_setting": 123, "uavs": 0, "users": "many", "seed": -1, "speed": 5.5})
    has_multiple_world_support = True


class TestJoinLeaveWorld(OnStream, compliance.JoinLeaveWorld):
    SETTINGS = WORLD
    invalid_join_settings = packed({"invalid_setting": 123})


class TestReset(OnStream, compliance.Reset):
    SETTINGS = WORLD

    def join_world(self):
        return self.stream.join()


class TestResetWorld(OnStream, compliance.ResetWorld):
    SETTINGS = WORLD


class Step(OnStream):
    @functools.cached_property
    def specs(self):
        return self.stream.join()

    def setUp(self):
        super().setUp()
        assert self.specs.actions


class TestStep(Step, compliance.Step):
    SETTINGS = WORLD


class TestStepOfOneUav(Step, compliance.Step):
    SETTINGS = {"uavs": 1, "users": 1, "slots": 40, "hover": True}


class TestDmEnv(Step, test_utils.EnvironmentTestMixin, absltest.TestCase):
    SETTINGS = WORLD

    def make_object_under_test(self):
        return dm_env_adaptor.DmEnvAdaptor(self.connection, self.specs)


del Step


@pytest.fixture
def stream():
    opened = Stream(WORLD)
    yield opened
    opened.close()


def test_an_episode_is_that_of_the_environment_service(stream):
    world = dm_env_adaptor.DmEnvAdaptor(stream.connection, stream.join())
    rest = httpx.Client(base_url=f"http://{HTTP}/v1")
    config = {name: value for name, value in WORLD.items() if name != "seed"}
    other = rest.post("/environments", json={"environment": config, "seed": WORLD["seed"], "count": 1}).json()["environment_id"]
    assert world.action_spec()["headings"].shape == (3,)
    state = rest.post(f"/environments/{other}/reset", json={"return_graph": True}).json()
    time = world.reset()
    rng = np.random.default_rng(2)
    while True:
        copy, seen = state["copies"][0], time.observation
        at = lambda nodes: np.array([[node["x"], node["y"]] for node in nodes], np.float32)
        assert np.array_equal(seen["uav_positions"], at(copy["scene"]["uavs"]))
        assert np.array_equal(seen["user_positions"], at(copy["scene"]["users"]))
        assert seen["user_aoi"].tolist() == [user["aoi"] for user in copy["scene"]["users"]]
        assert seen["slot"] == state["slot"] and seen["uav_present"].all()
        expected = np.zeros((3, 2 + 2 * 3 + 3 * 5), np.float32)
        ids = [node["id"] for node in copy["graph"]["nodes"]]
        expected[:, :2] = seen["uav_positions"]
        for row, node in zip(expected, copy["graph"]["nodes"][:3]):
            for found in node["detections"]:
                index, relative = ids.index(found["target_id"]), [found["rel_x"], found["rel_y"]]
                cell = 2 + 2 * index if index < 3 else 2 + 2 * 3 + 3 * (index - 3)
                row[cell : cell + 2] = relative
                if index >= 3:
                    row[cell + 2] = np.float32(found["aoi"]) / np.float32(6)
        assert np.array_equal(seen["observations"], expected)
        if time.last():
            break
        headings = rng.integers(0, 8, 3)
        state = rest.post(f"/environments/{other}/step", json={"actions": [{"headings": headings.tolist()}], "return_graph": True}).json()
        time = world.step({"headings": headings.astype(np.int32)})
        assert time.reward == np.float32(state["copies"][0]["reward"])
    assert time.discount == 1.0 and state["copies"][0]["truncated"]
    read = properties.PropertiesExtension(stream.connection)
    assert read["mean_aoi"] == state["copies"][0]["finished"]["metrics"]["mean_aoi"]
    assert read["seed"] == WORLD["seed"]
    assert json.loads(read["configuration"])["uavs"] == 3
    assert set(read.specs()) >= {"mean_aoi", "p95_aoi", "configuration"}
    with pytest.raises(ValueError):
        read["mean_aoi"] = 3.0
    with pytest.raises(ValueError):
        read["colour"]
    assert world.step({}).step_type == dm_env.StepType.FIRST
    rest.delete(f"/environments/{other}")


def test_settings_are_those_of_environments():
    settings = {"uavs": 2, "users": 3, "speed": np.float32(0.05), "hover": True, "layout": "random", "weights": [1.0, 2.0, 3.0]}
    stream = Stream({**settings, "lose_uav": '{"uav": 1, "slot": 1}'})
    specs = stream.join()
    assert list(specs.actions[1].max.int32s.array) == [8]
    config = httpx.get(f"http://{HTTP}/v1/environments/{stream.world_name}").json()["environment"]
    assert (config["speed"], config["weights"], config["lose_uav"]) == (0.05, [1.0, 2.0, 3.0], {"uav": 1, "slot": 1})
    world = dm_env_adaptor.DmEnvAdaptor(stream.connection, specs)
    world.reset()
    seen = world.step({"headings": np.zeros(2, np.int32)}).observation
    assert seen["uav_present"].tolist() == [True, False]
    assert not seen["observations"][1].any()
    stream.close()


def test_a_world_has_one_agent_and_its_reset_interrupts_it(stream):
    specs = stream.join()
    other = Stream()
    with pytest.raises(error.DmEnvRpcError, match="another stream"):
        other.send(dm_env_rpc_pb2.JoinWorldRequest(world_name=stream.world_name))
    with pytest.raises(error.DmEnvRpcError, match="has joined"):
        other.send(dm_env_rpc_pb2.DestroyWorldRequest(world_name=stream.world_name))
    ask = dm_env_rpc_pb2.StepRequest(requested_observations=list(specs.observations))
    states = dm_env_rpc_pb2.EnvironmentStateType
    first = stream.send(ask)
    assert first.state == stream.send(ask).state == states.RUNNING
    other.send(dm_env_rpc_pb2.ResetWorldRequest(world_name=stream.world_name, settings=packed({"seed": 4})))
    assert stream.send(ask).state == states.INTERRUPTED
    assert stream.send(ask) == first
    # A stream that ends leaves its world.
    third = Stream()
    stream.send(dm_env_rpc_pb2.LeaveWorldRequest())
    third.send(dm_env_rpc_pb2.JoinWorldRequest(world_name=stream.world_name))
    third.close()
    for _ in range(600):
        try:
            other.send(dm_env_rpc_pb2.JoinWorldRequest(world_name=stream.world_name))
            break
        except error.DmEnvRpcError as refused:
            assert "another stream" in str(refused)
    other.send(dm_env_rpc_pb2.LeaveWorldRequest())
    other.close()
