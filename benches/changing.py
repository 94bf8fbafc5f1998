#!/usr/bin/env python3
"""Flies fleets whose users come and go, and reports the mean AoI of policies over sessions.

    qedgix serve &
    benches/changing.py --server 127.0.0.1:8080 --policy qedgix --policy sweep-shared

Three UAVs start in the middle of the unit square. There are always five users. After every `--every` slots, the oldest user leaves and a
new user appears at a random place; with `--every 0`, all users stay. Each request lists the UAVs, and only those users that a UAV detects
in this slot; with `--scene`, all users. Mean AoI in slots, with a 95 % interval over worlds (1.96 standard errors)."""

import argparse
import http.client
import json
import math
import random
import statistics

TRANSMISSION, DETECTION = 0.12, 0.28


class Server:
    """The REST interface of a server, over one connection."""

    def __init__(self, address):
        self.connection = http.client.HTTPConnection(address, timeout=60)

    def call(self, method, path, body=None):
        self.connection.request(method, f"/v1{path}", body and json.dumps(body), {"content-type": "application/json"})
        answer = self.connection.getresponse()
        text = answer.read()
        if answer.status >= 300:
            raise SystemExit(f"{method} {path}: {text.decode()}")
        return json.loads(text) if text else None


class World:
    """Three UAVs and five users. `speed`: distance that a UAV flies per slot."""

    def __init__(self, seed, speed):
        self.speed = speed
        self.random = random.Random(seed)
        self.uavs = [[0.5, 0.5] for _ in range(3)]
        self.users, self.born = {}, 0
        for _ in range(5):
            self.add_user(0)

    def add_user(self, slot):
        """A new user, whose data was collected in `slot`."""
        self.users[f"user-{self.born:04}"] = ((self.random.random(), self.random.random()), slot)
        self.born += 1

    def graph(self, slot):
        """What the UAVs detect."""
        nodes, seen = [], set()
        for i, at in enumerate(self.uavs):
            others = [(f"uav-{j}", to, {}) for j, to in enumerate(self.uavs) if j != i]
            others += [(name, to, {"aoi": slot - last}) for name, (to, last) in self.users.items()]
            near = [(name, to, more) for name, to, more in others if math.dist(at, to) <= DETECTION]
            seen.update(name for name, _, more in near if more)
            detections = [{"target_id": name, "rel_x": to[0] - at[0], "rel_y": to[1] - at[1], **more} for name, to, more in near]
            nodes.append({"id": f"uav-{i}", "kind": "uav", "position": {"x": at[0], "y": at[1]}, "detections": detections})
        return {"nodes": nodes + [{"id": name, "kind": "user"} for name in sorted(seen)]}

    def scene(self, slot):
        """Where all UAVs and users are."""
        uavs = [{"id": f"uav-{i}", "x": x, "y": y} for i, (x, y) in enumerate(self.uavs)]
        users = [{"id": name, "x": x, "y": y, "aoi": slot - last} for name, ((x, y), last) in sorted(self.users.items())]
        return {"uavs": uavs, "users": users}

    def move(self, actions, slot):
        """Flies the headings; users in range are collected."""
        for at, action in zip(self.uavs, actions):
            if action.get("heading_deg") is not None:
                angle = math.radians(action["heading_deg"])
                move = (self.speed * math.cos(angle), self.speed * math.sin(angle))
                at[:] = [min(max(x + step, 0.0), 1.0) for x, step in zip(at, move)]
        for name, (to, _) in self.users.items():
            if any(math.dist(at, to) <= TRANSMISSION for at in self.uavs):
                self.users[name] = (to, slot + 1)

    def mean_aoi(self, slot):
        return statistics.fmean(slot + 1 - last for _, last in self.users.values())


def fly(server, policy, seed, args):
    """Mean AoI over one session."""
    world, ages, every = World(seed, args.speed), [], args.every
    ranges = {"transmission_range": TRANSMISSION, "detection_range": DETECTION}
    options = {"policy": policy, "seed": seed, "world": {"speed": args.speed, "slots": 80, **ranges}}
    session = server.call("POST", "/sessions", options)["session_id"]
    for slot in range(args.slots):
        if every and slot and slot % every == 0:
            del world.users[min(world.users)]
            world.add_user(slot)
        observation = {"scene": world.scene(slot)} if args.scene else {"graph": world.graph(slot)}
        answer = server.call("POST", "/act", {"session_id": session, "step": slot, **observation})
        world.move(answer["actions"], slot)
        ages.append(world.mean_aoi(slot))
    server.call("DELETE", f"/sessions/{session}")
    return statistics.fmean(ages)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--server", default="127.0.0.1:8080", help="HTTP address of the server [default: 127.0.0.1:8080]")
    parser.add_argument("--policy", action="append", required=True, help="name of a policy; may be repeated")
    parser.add_argument("--slots", type=int, default=400, help="slots per session [default: 400]")
    parser.add_argument("--speed", type=float, default=0.04, help="distance that a UAV flies per slot [default: 0.04]")
    parser.add_argument("--every", type=int, default=40, help="slots between two changes; 0: none [default: 40]")
    parser.add_argument("--scene", action="store_true", help="requests list all users")
    parser.add_argument("--worlds", type=int, default=64, help="number of sessions, each in another world [default: 64]")
    args = parser.parse_args()
    if args.worlds < 2:
        parser.error("--worlds: an interval needs at least 2 worlds")
    server = Server(args.server)
    print("| policy | mean AoI | 95 % interval |\n| --- | --- | --- |")
    for policy in args.policy:
        means = [fly(server, policy, seed, args) for seed in range(args.worlds)]
        mean, half = statistics.fmean(means), 1.96 * statistics.stdev(means) / len(means) ** 0.5
        print(f"| `{policy}` | {mean:.2f} | {mean - half:.2f} to {mean + half:.2f} |", flush=True)


if __name__ == "__main__":
    main()
