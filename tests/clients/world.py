"""Where the server is, fleets to fly, and what Act says about them."""

import json
import os
import urllib.request

import numpy as np

with open(os.environ["QEDGIX_ENDPOINTS"]) as file:
    ENDPOINTS = json.load(file)
GRPC = ENDPOINTS["grpc"]
HTTP = ENDPOINTS["http"]


def rest(path, body):
    """POST of a JSON document; a refusal raises."""
    request = urllib.request.Request(f"http://{HTTP}{path}", json.dumps(body).encode(), {"content-type": "application/json"})
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)


class Slot:
    """What a fleet sees in one slot: `uavs` and `users` in a unit square, every number drawn from `seed`."""

    def __init__(self, seed, uavs=3, users=5):
        draw = np.random.default_rng(seed)
        self.uavs = draw.random((uavs, 2), dtype=np.float32)
        self.users = draw.random((users, 2), dtype=np.float32)
        self.aoi = draw.integers(0, 80, users).astype(np.float32)

    def scene(self):
        """The message of Act."""
        point = lambda at: {"x": float(at[0]), "y": float(at[1])}
        uavs = [{"id": f"uav-{i}", **point(at)} for i, at in enumerate(self.uavs)]
        users = [{"id": f"user-{j}", "aoi": float(self.aoi[j]), **point(at)} for j, at in enumerate(self.users)]
        return {"uavs": uavs, "users": users}

    def scene_tensors(self):
        return {"uav_positions": self.uavs, "user_positions": self.users, "user_aoi": self.aoi}

    def edges(self, detection_range=0.28):
        """Who of the UAVs detects whom, and where; what users detect is left to the server."""
        nodes = np.concatenate([self.uavs, self.users]).astype(np.float64)
        relative = nodes[None] - nodes[:, None]
        near = (relative**2).sum(-1) <= detection_range**2
        np.fill_diagonal(near, False)
        near[len(self.uavs) :] = False
        index = np.argwhere(near)
        return index, relative[index[:, 0], index[:, 1]]

    def graph(self):
        """The other message of Act."""
        scene = self.scene()
        uavs = [{"id": uav["id"], "kind": "uav", "position": {"x": uav["x"], "y": uav["y"]}} for uav in scene["uavs"]]
        users = [{"id": user["id"], "kind": "user", "aoi": user["aoi"]} for user in scene["users"]]
        nodes = [{**node, "detections": []} for node in uavs + users]
        for (source, target), (x, y) in zip(*self.edges()):
            seen = {"target_id": nodes[target]["id"], "rel_x": float(x), "rel_y": float(y)}
            if "aoi" in nodes[target]:
                seen["aoi"] = nodes[target]["aoi"]
            nodes[source]["detections"].append(seen)
        return {"nodes": nodes}

    def graph_tensors(self):
        index, relative = self.edges()
        return {"uav_positions": self.uavs, "user_aoi": self.aoi, "edge_index": index.astype(np.int64), "edge_relative": relative}


def act_headings(policy, slots, seed=7, form="scene"):
    """What a session of Act answers to `slots`, one after another: heading indices and Q-values of each slot."""
    session = rest("/v1/sessions", {"policy": policy, "seed": seed})["session_id"]
    answers = []
    for step, slot in enumerate(slots):
        seen = slot.scene() if form == "scene" else slot.graph()
        body = {"session_id": session, "step": step, form: seen, "return_q_values": True}
        answers.append(rest("/v1/act", body)["actions"])
    indices = [[action["heading_index"] for action in actions] for actions in answers]
    values = [[action.get("q_values", []) for action in actions] for actions in answers]
    return indices, values
