"""Policies as ONNX models: whole episodes with onnxruntime have the headings of Act, and its Q-values to 1e-5.

QEDGIX_ONNX_LAYOUTS is the number of layouts per policy (6; 256 for the long form).
"""

import os
import subprocess

import httpx
import numpy as np
import onnxruntime
import pytest
from world import HTTP

BINARY = os.environ["QEDGIX_BIN"]
LAYOUTS = int(os.environ.get("QEDGIX_ONNX_LAYOUTS", "6"))
# Fleets that are flown in turn: most as trained, others of any size.
SIZES = [(3, 5), (3, 5), (2, 4), (3, 5), (5, 12), (1, 3), (6, 20), (3, 1), (8, 10)]
# Architectures that no bundled policy has, trained for a moment, and fleets that they fit.
TRAINED = {
    "agggnn": ["--algorithm", "agggnn", "--set", "training.advice=none"],
    "rgcn-hover": ["--algorithm", "rgcn", "--set", "environment.hover=true"],
    "paper": ["--algorithm", "qedgix", "--preset", "paper"],
    "authors": ["--algorithm", "qedgix", "--preset", "authors"],
    "onehot": ["--algorithm", "qmix", "--set", "training.identity=onehot", "--set", "training.memory=own"],
    "token": ["--algorithm", "vdn", "--set", "training.identity=token", "--set", "training.self_loops=true"],
    "apart": ["--algorithm", "qedgix", "--set", "environment.communication_range=0.5", "--set", "training.memory=shared"],
}


def command(*arguments):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("QEDGIX_")}
    return subprocess.run([BINARY, *map(str, arguments)], capture_output=True, text=True, env=environment, timeout=300)


def exported(policy, folder):
    file = folder / f"{policy}.onnx"
    told = command("policies", "export", policy, "--onnx", file, "--server", HTTP)
    assert told.returncode == 0, told.stderr
    return Model(file)


class Model:
    """A model with the memory of a fleet, which flies without a server."""

    def __init__(self, file):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(file, options)
        self.inputs = {tensor.name for tensor in self.session.get_inputs()}
        self.outputs = [tensor.name for tensor in self.session.get_outputs()]
        meta = self.session.get_modelmeta().custom_metadata_map
        self.world = {name: float(value) for name, value in meta.items() if name != "policy"}

    def begin(self, uavs, users):
        state = {"hidden": (uavs, 64), "ground": (uavs, 20, 20), "users": (uavs, users, 5)}
        self.state = {name: np.zeros(shape, np.float32) for name, shape in state.items()}
        self.heading = np.full(uavs, -1)
        self.place = np.stack([np.arange(uavs), np.full(uavs, uavs)], axis=1)

    def act(self, slot, uavs, users, aoi, token=None):
        nodes, is_uav = np.concatenate([uavs, users]), np.arange(len(uavs) + len(users)) < len(uavs)
        relative = nodes[None] - nodes[:, None]
        reach = np.where(is_uav[:, None] & is_uav, self.world["communication_range"], self.world["detection_range"])
        near = ((relative**2).sum(-1) <= reach**2) & ~np.eye(len(nodes), dtype=bool)
        inputs = {
            "edge_index": np.argwhere(near),
            "edge_relative": relative[near].astype(np.float32),
            "user_aoi": aoi.astype(np.float32),
            "uav_positions": uavs,
            "place": self.place,
            "last_heading": self.heading,
            "slot": np.array(slot),
            "identity_token": token,
            **self.state,
        }
        inputs = {name: value for name, value in inputs.items() if name in self.inputs}
        outputs = dict(zip(self.outputs, self.session.run(None, inputs)))
        self.heading = outputs["heading_index"]
        self.state = {name: outputs.get(f"{name}_out", before) for name, before in self.state.items()}
        return outputs


def act(client, session, slot, uavs, users, aoi):
    """Headings and Q-values of Act."""
    scene = {
        "uavs": [{"id": f"uav-{i:02}", "x": x, "y": y} for i, (x, y) in enumerate(uavs.tolist())],
        "users": [{"id": f"user-{j:02}", "x": x, "y": y, "aoi": a} for j, ((x, y), a) in enumerate(zip(users.tolist(), aoi.tolist()))],
    }
    answer = client.post("/v1/act", json={"session_id": session, "step": slot, "scene": scene, "return_q_values": True})
    assert answer.status_code == 200, answer.text
    actions = answer.json()["actions"]
    return np.array([a["heading_index"] for a in actions]), np.array([a["q_values"] for a in actions], np.float32)


def fly(client, model, policy, seed, size, slots=80, moves=()):
    """An episode, flown as Act decides; one user moves in the slots `moves`. Returns the largest difference of a Q-value, and how many headings
    differ."""
    rng = np.random.default_rng(seed)
    uavs = rng.random((size[0], 2)) if seed % 2 else np.full((size[0], 2), 0.5)
    users, aoi = rng.random((size[1], 2)), np.zeros(size[1])
    model.begin(*size)
    session = client.post("/v1/sessions", json={"policy": policy, "seed": seed}).json()["session_id"]
    worst, other = 0.0, 0
    for slot in range(slots):
        if slot in moves:
            users[0] = rng.random(2)
        headings, values = act(client, session, slot, uavs, users, aoi)
        outputs = model.act(slot, uavs, users, aoi)
        worst = max(worst, np.abs(outputs["q_values"] - values).max())
        assert worst < 1e-5, f"{policy}, layout {seed}, {size}, slot {slot}: differs by {worst}"
        # Of two headings of equal value, either may be chosen.
        chosen = np.take_along_axis(values, outputs["heading_index"][:, None], axis=1)
        assert (values.max(axis=1, keepdims=True) - chosen < 2e-5).all()
        other += int((outputs["heading_index"] != headings).sum())
        assert other == 0 or worst > 0
        model.heading = headings
        angle = np.deg2rad(45.0 * headings)[:, None]
        move = model.world["speed"] * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        uavs = np.clip(uavs + np.where(headings[:, None] < 8, move, 0), 0, 1)
        visited = np.linalg.norm(uavs[:, None] - users, axis=-1).min(axis=0) <= model.world["transmission_range"]
        aoi = np.where(visited, 0, aoi + 1)
    client.delete(f"/v1/sessions/{session}")
    return worst, other


@pytest.fixture(scope="module")
def client():
    with httpx.Client(base_url=f"http://{HTTP}", timeout=60) as opened:
        yield opened


@pytest.mark.parametrize("policy", ["qedgix", "qedgix-onboard", "qedgix-paper", "qmix"])
def test_the_model_decides_as_act_does(client, policy, tmp_path):
    model = exported(policy, tmp_path)
    worst, other = zip(*(fly(client, model, policy, seed, SIZES[seed % len(SIZES)]) for seed in range(LAYOUTS)))
    print(f"{policy}: {LAYOUTS} layouts, Q-values differ by at most {max(worst):.1e}, {sum(other)} headings differ")


@pytest.mark.parametrize("policy", ["qedgix", "qmix"])
def test_the_model_searches_again_for_a_user_that_moved(client, policy, tmp_path):
    model = exported(policy, tmp_path)
    fly(client, model, policy, 3, (3, 5), slots=300, moves=range(0, 300, 20))
    assert model.state["ground"].max() > 200, "1 + the slot in which the search began"


@pytest.mark.parametrize("name", TRAINED)
def test_every_architecture_has_a_model(client, name, tmp_path):
    file = tmp_path / "policy.safetensors"
    size = [("training.batch", 4), ("training.envs", 4), ("training.buffer", 64), ("training.eval_episodes", 4)]
    settings = [argument for field, value in size for argument in ("--set", f"{field}={value}")]
    told = command("train", *TRAINED[name], "--steps", 640, *settings, "--threads", 1, "--out", file, "--seed", 5)
    assert told.returncode == 0, told.stderr
    policy = f"onnx-{name}"
    told = command("policies", "upload", policy, file, "--server", HTTP)
    assert told.returncode == 0, told.stderr
    try:
        model = exported(policy, tmp_path)
        if name == "token":
            # The server draws tokens from its seed, so the model is only run.
            model.begin(4, 2)
            rng = np.random.default_rng(1)
            outputs = model.act(0, rng.random((4, 2)), rng.random((2, 2)), np.zeros(2), rng.random((4, 4)).astype(np.float32))
            assert outputs["q_values"].shape == (4, 8)
            return
        for seed in range(3):
            fly(client, model, policy, seed, (3, 5), slots=30)
    finally:
        command("policies", "delete", policy, "--all-versions", "--server", HTTP)


def test_what_has_no_model_is_refused(tmp_path):
    told = command("policies", "export", "sweep", "--onnx", tmp_path / "sweep.onnx", "--server", HTTP)
    assert told.returncode == 1 and not list(tmp_path.iterdir())
    file = tmp_path / "policy.safetensors"
    told = command("train", "--algorithm", "qmix", "--set", "training.hops=2", "--steps", 320, "--threads", 1, "--out", file)
    assert told.returncode == 0, told.stderr
    told = command("policies", "upload", "onnx-refused", file, "--server", HTTP)
    assert told.returncode == 0, told.stderr
    told = command("policies", "export", "onnx-refused", "--onnx", tmp_path / "refused.onnx", "--server", HTTP)
    command("policies", "delete", "onnx-refused", "--all-versions", "--server", HTTP)
    assert told.returncode == 1 and "training.hops" in told.stderr, told.stderr
    assert not (tmp_path / "refused.onnx").exists()
