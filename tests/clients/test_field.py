"""A simulator as people have them, in metres: 5 m of noise on every measurement, three speeds, one UAV lost, one user that appears, one
that leaves, and only what somebody detects is listed. Compared with the same world without noise, and with one in which all UAVs and users
stay, too.

QEDGIX_FIELD_WORLDS is the number of worlds per policy and mode (1; 24 for the long form, which also compares mean AoI).
"""

import os

import httpx
import numpy as np
import pytest
from world import HTTP

WORLDS = int(os.environ.get("QEDGIX_FIELD_WORLDS", "1"))
SIDE, SLOT, AREA = 3000.0, 8.0, np.array([3000.0, 2000.0])
SPEEDS = [12.0, 15.0, 20.0]
DETECTION, TRANSMISSION = 0.28 * SIDE, 0.12 * SIDE


@pytest.fixture(scope="module")
def client():
    with httpx.Client(base_url=f"http://{HTTP}/v1", timeout=60) as opened:
        yield opened


def point(at):
    return {"x": float(at[0]), "y": float(at[1])}


def scene(uavs, users, now, noisy):
    return {
        "scene": {
            "uavs": [{"id": name, **point(noisy(at))} for name, (at, _) in uavs.items()],
            "users": [{"id": name, "aoi": (now - last) / SLOT, **point(noisy(at))} for name, (at, last) in users.items()],
        }
    }


def graph(uavs, users, now, noisy, one_sided):
    """What the UAVs measure: each its own position, and where it detects others. `one_sided`: one UAV of a pair reports it."""
    near = lambda a, b: np.hypot(*(a - b)) <= DETECTION
    nodes, seen = [], set()
    for name, (at, _) in uavs.items():
        found = []
        for other, (to, _) in uavs.items():
            if other != name and near(at, to) and (name < other or not one_sided):
                found.append((other, to, {}))
        for other, (to, last) in users.items():
            if near(at, to):
                found.append((other, to, {"aoi": (now - last) / SLOT}))
                seen.add(other)
        detections = []
        for other, to, more in found:
            x, y = noisy(to - at)
            detections.append({"target_id": other, "rel_x": float(x), "rel_y": float(y), **more})
        nodes.append({"id": name, "kind": "uav", "position": point(noisy(at)), "detections": detections})
    return {"graph": {"nodes": nodes + [{"id": name, "kind": "user"} for name in sorted(seen)]}}


def fly(client, policy, mode, seed, noise, changes):
    """Mean AoI in seconds, over users and slots. Every slot must be answered."""
    rng, errors = np.random.default_rng(seed), np.random.default_rng(seed + 1)
    noisy = (lambda at: at + errors.normal(0, 5, 2)) if noise else (lambda at: at)
    uavs = {f"drone-{i}": [AREA / 2, speed] for i, speed in enumerate(SPEEDS)}
    users = {f"sensor-{j}": [rng.uniform(0, AREA), 0.0] for j in range(5)}
    late = rng.uniform(0, AREA)
    frame = {"width": AREA[0], "height": AREA[1]}
    world = {"slot_seconds": SLOT, "speed": 15.0, "transmission_range": TRANSMISSION, "detection_range": DETECTION, "slots": 80}
    opened = client.post("/sessions", json={"policy": policy, "frame": frame, "world": world})
    assert opened.status_code in (200, 201), opened.text
    session, ages = opened.json()["session_id"], []
    for slot in range(80):
        now = slot * SLOT
        if changes and now == 304:
            uavs.pop("drone-1")
        if changes and now == 200:
            users["sensor-late"] = [late, now]
        if changes and now == 504:
            users.pop("sensor-2")
        seen = scene(uavs, users, now, noisy) if mode == "scene" else graph(uavs, users, now, noisy, mode == "one-sided")
        answer = client.post("/act", json={"session_id": session, **seen})
        assert answer.status_code == 200, f"slot {slot}: {answer.text}"
        for action in answer.json()["actions"]:
            uav, degrees = uavs[action["uav_id"]], action.get("heading_deg")
            if degrees is not None:
                angle = np.deg2rad(degrees)
                uav[0] = np.clip(uav[0] + uav[1] * SLOT * np.array([np.cos(angle), np.sin(angle)]), 0, AREA)
        for user in users.values():
            if any(np.hypot(*(at - user[0])) <= TRANSMISSION for at, _ in uavs.values()):
                user[1] = now + SLOT
        ages.append(np.mean([now + SLOT - last for _, last in users.values()]))
    client.delete(f"/sessions/{session}")
    return np.mean(ages)


@pytest.mark.parametrize("mode", ["graph", "scene", "one-sided"])
@pytest.mark.parametrize("policy", ["qedgix", "qmix", "sweep", "nearest"])
def test_what_flies_is_answered(client, policy, mode):
    flown = [(False, False), (False, True), (True, True)]
    flights = [[fly(client, policy, mode, seed, *how) for how in flown] for seed in range(WORLDS)]
    steady, exact, noisy = np.mean(flights, axis=0)
    print(f"{policy}, {mode}: {noisy:.1f} s; without noise {exact:.1f} s; without changes, too, {steady:.1f} s")
    if WORLDS >= 24:
        assert noisy <= 1.15 * exact
