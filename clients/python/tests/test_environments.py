"""Hosted environments."""

from __future__ import annotations

import numpy as np
import pytest

import qedgix

CONFIG = {"M": 2, "N": 4, "K": 5}


def test_an_episode_of_two_copies(client):
    with client.environment(CONFIG, count=2, seed=10_000) as environment:
        assert environment.count == 2 and environment.headings == 8
        assert (environment.config["uavs"], environment.config["users"], environment.config["slots"]) == (2, 4, 5)
        state = environment.reset()
        assert state.uavs.shape == (2, 2, 2) and state.users.shape == (2, 4, 2) and state.aoi.shape == (2, 4)
        assert (state.uavs == 0.5).all() and not state.aoi.any() and not state.rewards.any()
        assert state.seeds.tolist() == [10_000, 10_001]
        for slot in range(5):
            assert (state.slot, state.step, state.truncated.any()) == (slot, slot, False)
            assert state.finished == [None, None]
            state = environment.step(np.full((2, 2), 2))
            expected = -state.aoi.mean(1) / 5
            assert np.allclose(state.rewards, expected, atol=1e-6)
        assert state.truncated.all()
        assert np.allclose(state.uavs[..., 1], 0.5 + 5 * 0.04)
        for finished, seed in zip(state.finished, (10_000, 10_001)):
            assert finished.seed == seed and finished.scene is None
            assert 0 <= finished.mean_aoi <= finished.peak_aoi and finished.metrics["coverage"] == finished.coverage
        with pytest.raises(qedgix.FailedPrecondition) as refused:
            environment.step(np.zeros((2, 2), int))
        assert refused.value.code == "episode_over"
        assert environment.reset().episode == 1
        assert environment.reset(seed=10_000).users.tolist() == environment.reset(episode=0).users.tolist()
    with pytest.raises(qedgix.NotFound):
        environment.reset()
    environment.delete()


def test_an_automatic_reset_keeps_the_final_scene(client):
    with client.environment(CONFIG, seed=1, auto_reset=True) as environment:
        environment.reset()
        for _ in range(5):
            state = environment.step([0, 4])
        assert (state.episode, state.slot, state.truncated.tolist()) == (1, 0, [True])
        [finished] = state.finished
        assert finished.scene.users[0].aoi > 0 and not state.aoi.any()


def test_scenes_and_graphs_go_to_act_unchanged(client):
    with client.environment({"uavs": 3, "users": 5}, seed=3) as environment:
        by_scene, by_graph = (client.local_session("sweep", seed=1) for _ in range(2))
        state = environment.reset(graphs=True)
        for _ in range(4):
            headings = by_scene.act(state.scenes[0]).headings
            assert by_graph.act(state.graphs[0]).headings.tolist() == headings.tolist()
            state = environment.step(headings, graphs=True)


def test_what_is_not_accepted_is_named(client):
    for config, field in [
        ({"uavs": 0}, "environment.uavs"),
        ({"color": 1}, "environment.color"),
        ({"uavs": {1}}, "environment"),
    ]:
        with pytest.raises(qedgix.InvalidArgument) as refused, client.environment(config):
            pass
        assert refused.value.field.startswith(field.partition(".")[0]), refused.value.field
    for field, number in [("count", -1), ("seed", -1), ("count", "2"), ("environment_id", 5)]:
        with pytest.raises(qedgix.InvalidArgument) as refused:
            client.environment(CONFIG, **{field: number})
        assert (refused.value.field, refused.value.value) == (field, repr(number))
    for config, field in [({"speed": float("nan")}, "environment.speed"), ({"uavs": {1}}, "environment.uavs")]:
        with pytest.raises(qedgix.InvalidArgument) as refused:
            client.environment(config)
        assert refused.value.field == field
    with client.environment(CONFIG) as environment:
        environment.reset()
        for headings in ([0, 8], [0], [[0, 1], [0, 1]]):
            with pytest.raises(qedgix.InvalidArgument) as refused:
                environment.step(headings)
            assert refused.value.field.startswith("actions")
        for reset in ({"seed": -1}, {"episode": -1}, {"seed": 0.5}):
            with pytest.raises(qedgix.InvalidArgument) as refused:
                environment.reset(**reset)
            assert [refused.value.field] == list(reset)
        for headings in ([0.5, 1.0], [-1, 0], 3, [[[0, 1]]], "north", [[0, 1], [0]], [0, 1 << 40]):
            with pytest.raises(qedgix.InvalidArgument) as refused:
                environment.step(headings)
            assert refused.value.field == "headings"
        assert environment.step([0, 1]).step == 1


def test_an_environment_that_was_never_created_says_so(connect):
    # There is no server: nothing is sent.
    environment = connect("127.0.0.1:1").environment(CONFIG)
    for call in (lambda: environment.reset(seed=1), lambda: environment.step([0, 1]), lambda: environment.config):
        with pytest.raises(qedgix.FailedPrecondition, match=r"not open; use `.*with client\.environment") as refused:
            call()
        assert refused.value.code == "not_open"


def test_numbers_of_numpy_configure_an_environment(client):
    config = {"uavs": np.int64(2), "users": np.uint8(3), "speed": np.float32(0.125), "hover": np.bool_(True)}
    with client.environment(config, count=np.int64(2), seed=np.int64(3)) as environment:
        assert (environment.config["speed"], environment.headings, environment.count) == (0.125, 9, 2)
        assert environment.reset(seed=np.int64(5), episode=np.int64(1)).uavs.shape == (2, 2, 2)
