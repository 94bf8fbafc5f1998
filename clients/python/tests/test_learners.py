"""Hosted environments as environments of PettingZoo and Gymnasium, with the tests of both."""

from __future__ import annotations

import functools
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
import supersuit
from gymnasium.utils.env_checker import check_env, data_equivalence
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, render_test, seed_test
from pettingzoo.utils.conversions import parallel_to_aec

import qedgix

CONFIGS = [{}, {"uavs": 2, "users": 3, "hover": True, "boundary": "free", "start": "random", "communication_range": 0.6}]


@pytest.fixture(params=CONFIGS, ids=["default", "options"])
def make(request, server):
    """Makes parallel environments."""
    made = []

    def parallel_env(**options):
        made.append(qedgix.parallel_env(server.grpc, request.param, **options))
        return made[-1]

    yield parallel_env
    for env in made:
        env.close()


def fly(env, seed, draw=None):
    """Everything that an episode returns."""
    draw = np.random.default_rng(seed) if draw is None else draw
    told = [env.reset(seed=seed)]
    while env.agents:
        actions = {agent: draw.integers(env.action_space(agent).n) for agent in env.agents}
        told.append((env.step(actions), env.state()))
    return told


def test_parallel_api(make):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(make(), 1000)


def test_parallel_seed(make):
    parallel_seed_test(make)


def test_aec_api(make):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # What a UAV with nothing near it observes at the start is not wrong.
        warnings.filterwarnings("ignore", message="Observation numpy array is all zeros")
        api_test(parallel_to_aec(make()), 200)


def test_aec_seed(make):
    seed_test(lambda: parallel_to_aec(make()), 20)


def test_render(make):
    env = make(render_mode="rgb_array")
    env.reset(seed=1)
    picture = env.render()
    assert picture.shape == (512, 512, 3) and picture.dtype == np.uint8 and len(np.unique(picture)) > 10
    env.step({agent: 0 for agent in env.agents})
    assert (env.render() != picture).any()
    assert make().render() is None
    # PettingZoo's test opens a window first, which there is none of here.
    render_test(lambda render_mode: parallel_to_aec(make(render_mode=None if render_mode == "human" else render_mode)))


def test_a_whole_episode_is_the_same_in_every_environment(make):
    first, second = make(), make()
    told = fly(first, 10_000)
    assert len(told) == first.max_cycles + 1
    assert data_equivalence(told, fly(second, 10_000), exact=True)
    # Also after other episodes, and not with another seed.
    assert data_equivalence(told, fly(first, 10_000), exact=True)
    assert not data_equivalence(told, fly(second, 10_001, np.random.default_rng(10_000)), exact=True)


def test_observations_are_what_the_server_says(make):
    env = make(seed=5)
    client = env._hosted.client
    draw = np.random.default_rng(2)
    with client.environment(env._hosted._environment_config, seed=5) as hosted:
        observations, infos = env.reset(seed=5)
        state = hosted.reset(graphs=True)
        for _ in range(env.max_cycles):
            check_observations(env, state, observations)
            assert (infos["uav_0"]["aoi"] == state.aoi[0]).all()
            actions = draw.integers(env.action_space("uav_0").n, size=env.max_num_agents)
            observations, rewards, _, truncations, infos = env.step(dict(zip(env.agents, actions)))
            state = hosted.step(actions, graphs=True)
            assert set(rewards.values()) == {float(state.rewards[0])}
        assert all(truncations.values()) and env.agents == []
        assert infos["uav_0"]["episode"] == {**state.finished[0].metrics, "seed": 5}
        assert env.step({}) == ({}, {}, {}, {}, {})


def check_observations(env, state, observations):
    """The graph of the server has the same detections, bit for bit."""
    [graph], uavs, users = state.graphs, env.config["uavs"], env.config["users"]
    for i, node in enumerate(graph.nodes[:uavs]):
        wanted = np.zeros(2 + 2 * uavs + 3 * users, np.float32)
        wanted[:2] = node.position.x, node.position.y
        for detection in node.detections:
            kind, _, j = detection.target_id.partition("-")
            at = 2 + (2 * int(j) if kind == "uav" else 2 * uavs + 3 * int(j))
            wanted[at : at + 2] = detection.rel_x, detection.rel_y
            if kind == "user":
                wanted[at + 2] = np.float32(detection.aoi) / np.float32(env.max_cycles)
        found = observations[f"uav_{i}"]
        assert (found == wanted).all() and env.observation_space(f"uav_{i}").contains(found)
    assert env.state_space.contains(env.state())


def test_episodes_follow_each_other_and_seeds_are_drawn_if_not_given(server):
    with qedgix.Client(server.grpc) as client:
        env, other = (qedgix.parallel_env(client, max_cycles=3) for _ in range(2))
        assert env.max_cycles == env.config["slots"] == 3

        def seeds(env, count):
            found = []
            for _ in range(count):
                env.reset()
                while env.agents:
                    infos = env.step(dict.fromkeys(env.agents, 0))[4]
                found.append(infos["uav_0"]["episode"]["seed"])
            return found

        assert len({*seeds(env, 3), *seeds(other, 3)}) == 6
        env.reset(seed=3)
        assert seeds(env, 1)[0] != 3
        env.reset(seed=3)
        first = seeds(env, 2)
        env.reset(seed=3)
        assert seeds(env, 2) == first
        env.close()
        other.close()
        # The client was given, so it is still open.
        assert client.act(qedgix.Scene([[0, 0]], [[0, 0]]), policy="sweep").step == 0


def test_an_environment_that_has_expired_is_made_again(make_server):
    server = make_server().start()
    env = qedgix.parallel_env(server.grpc, seed=8)
    first = env.reset()
    server.kill()
    server.start()
    with pytest.raises(qedgix.NotFound):
        env.step(dict.fromkeys(env.agents, 0))
    again = env.reset(seed=8)
    assert data_equivalence(first, again, exact=True)
    env.close()


def test_environments_can_be_copied_to_other_processes(make):
    env = make(seed=4)
    twin = pickle.loads(pickle.dumps(env))
    assert twin.max_cycles == env.max_cycles and data_equivalence(env.reset(), twin.reset(), exact=True)
    twin.close()


def test_ten_thousand_slots_in_the_wrapper_of_trainers(server):
    env = qedgix.parallel_env(server.grpc)
    copies = supersuit.concat_vec_envs_v1(supersuit.pettingzoo_env_to_vec_env_v1(env), 2, num_cpus=0, base_class="gymnasium")
    observations, _ = copies.reset(seed=1)
    copies.action_space.seed(1)
    ended = 0
    for _ in range(5_000):
        actions = [copies.action_space.sample() for _ in range(copies.num_envs)]
        observations, rewards, _, truncations, _ = copies.step(np.array(actions))
        ended += int(truncations.sum())
    assert observations.shape == (copies.num_envs, *copies.observation_space.shape)
    assert np.isfinite(observations).all() and (rewards <= 0).all() and ended == 5_000 // 80 * copies.num_envs
    copies.close()
    env.close()


def test_wrong_arguments_are_named(server):
    for options, field in [
        ({"render_mode": "human"}, "render_mode"),
        ({"environment": {"slots": 5}, "max_cycles": 6}, "max_cycles"),
        ({"environment": {"uavs": 0}}, "environment"),
        ({"environment": 5}, "environment"),
    ]:
        with pytest.raises(qedgix.InvalidArgument) as refused:
            qedgix.parallel_env(server.grpc, **options)
        assert refused.value.field.startswith(field) or refused.value.field == "uavs"
    for make in (qedgix.parallel_env, qedgix.fleet_env, functools.partial(qedgix.vector_env, count=2)):
        with pytest.raises(qedgix.InvalidArgument) as refused:
            make(server.grpc, seed=-1)
        assert refused.value.field == "seed"
        env = make(server.grpc, {"uavs": np.int64(2)}, seed=np.int64(3), max_cycles=np.int64(4))
        for seed in (-1, 0.5, 1 << 60):
            with pytest.raises(qedgix.InvalidArgument) as refused:
                env.reset(seed=seed)
            assert (refused.value.field, refused.value.value) == ("seed", str(seed))
        env.reset(seed=np.int64(3))
        env.close()
    env = qedgix.parallel_env(server.grpc)
    with pytest.raises(qedgix.FailedPrecondition):
        env.state()
    env.reset()
    with pytest.raises(qedgix.InvalidArgument) as refused:
        env.step(dict.fromkeys(env.agents, "north"))
    assert refused.value.field == "actions[uav_0]"
    with pytest.raises(qedgix.InvalidArgument) as refused:
        env.step({"uav_0": 0})
    assert refused.value.field == "actions[uav_1]"
    with pytest.raises(qedgix.InvalidArgument):
        env.step(dict.fromkeys(env.agents, 8))
    env.close()


def test_a_vector_keeps_the_final_observations(server):
    config, count = {"uavs": 2, "users": 4}, 3
    vector = qedgix.vector_env(server.grpc, config, count=count, max_cycles=6, render_mode="rgb_array")
    singles = [qedgix.parallel_env(server.grpc, config, max_cycles=6) for _ in range(count)]
    observations, infos = vector.reset(seed=10)
    alone = [env.reset(seed=10 + b)[0] for b, env in enumerate(singles)]
    draw = np.random.default_rng(1)
    for slot in range(6):
        assert vector.observation_space.contains(observations)
        assert (observations == np.stack([np.stack(list(one.values())) for one in alone])).all()
        assert (infos["state"] == np.stack([env.state() for env in singles])).all() and infos["_state"].all()
        actions = draw.integers(8, size=(count, 2))
        observations, rewards, terminations, truncations, infos = vector.step(actions)
        steps = [env.step(dict(zip(env.agents, row))) for env, row in zip(singles, actions)]
        alone = [step[0] for step in steps]
        assert rewards.tolist() == [step[1]["uav_0"] for step in steps]
        assert not terminations.any() and (truncations == (slot == 5)).all()
    # The observations are those of the next episode; the last ones are kept.
    assert (observations[..., :2] == 0.5).all() and not infos["aoi"].any()
    final = infos["final_info"]
    for b, (env, step) in enumerate(zip(singles, steps)):
        assert (infos["final_obs"][b] == np.stack(list(step[0].values()))).all() and infos["_final_obs"][b]
        assert (final["state"][b] == env.state()).all()
        episode = {name: values[b] for name, values in final["episode"].items() if not name.startswith("_")}
        assert episode == step[4]["uav_0"]["episode"]
    assert len(vector.render()) == count
    assert vector.reset(seed=[10, 11, 12])[0].shape == (count, 2, vector.single_observation_space.shape[1])
    assert vector.reset(seed=[None] * 3)[0].shape[0] == count
    with pytest.raises(qedgix.InvalidArgument):
        vector.reset(seed=[10, 12, 11])
    for env in [vector, *singles]:
        env.close()


def test_a_vector_goes_through_the_wrappers_of_gymnasium(server):
    vector = qedgix.vector_env(server.grpc, count=2, max_cycles=4)
    assert vector.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    wrapped = gymnasium.wrappers.vector.RecordEpisodeStatistics(vector)
    wrapped.reset(seed=1)
    wrapped.action_space.seed(1)
    total = 0
    for _ in range(4):
        _, rewards, *_, infos = wrapped.step(wrapped.action_space.sample())
        total = total + rewards
    assert np.allclose(infos["episode"]["r"], total) and infos["episode"]["l"].tolist() == [4, 4]
    wrapped.close()


def test_gymnasium_accepts_the_environment_of_one_agent(server):
    env = qedgix.fleet_env(server.grpc, {"uavs": 2, "hover": True}, render_mode="rgb_array")
    assert env.action_space.nvec.tolist() == [9, 9]
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=3)
    assert env.observation_space.contains(observation) and env.render().shape == (512, 512, 3)
    for slot in range(80):
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert reward <= 0 and not terminated and truncated == (slot == 79)
    assert info["metrics"]["seed"] == 3
    with pytest.raises(qedgix.FailedPrecondition):
        env.step(env.action_space.sample())
    env.close()
