"""A fleet without a centre: one process per UAV. Each UAV knows its own sensors, what it remembers, and the messages that other UAVs
within the range of its radio send it over local sockets. The world moves them, compares their headings with a joint Act, and, with
--kill, kills one of the processes in every tenth slot and starts it again from its saved memory.

python decentral.py 127.0.0.1:50051 --policy qedgix --layouts 4 --kill
"""

import argparse
import multiprocessing
import socket
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import qedgix

Floats = NDArray[np.float64]

SPEED, TRANSMISSION_RANGE, DETECTION_RANGE = 0.04, 0.12, 0.28
UAVS, USERS = [f"uav-{i}" for i in range(3)], [f"user-{j}" for j in range(5)]


def fly_one(address: str, policy: str, uav_id: str, memory: Path, world: Connection) -> None:
    """The process of a UAV."""
    radio = socket.create_server(("127.0.0.1", 0))
    world.send(radio.getsockname()[1])
    with qedgix.Client(address) as client:
        while (slot := world.recv()) is not None:
            episode, step, position, detections, peers = slot
            saved = memory / f"{uav_id}-{episode}-{step}"
            state = saved.read_bytes() if step else b""
            uav = client.uav(policy, uav_id, uav_ids=UAVS, user_ids=USERS, seed=episode, state=state)
            message = uav.encode(detections, position)
            # The world knows which UAVs the radio reaches, as the air does in reality.
            reached = {name: port for name, (port, at) in peers.items() if np.hypot(*at) <= (uav.message_range or 0)}
            for port in reached.values():
                with socket.create_connection(("127.0.0.1", port)) as link:
                    link.sendall(f"{uav_id} {episode} {step}\n".encode() + message)
            heard: dict[str, bytes] = {}
            while len(heard) < len(reached):
                link, _ = radio.accept()
                with link, link.makefile("rb") as stream:
                    sender, *when = stream.readline().decode().split()
                    if when == [str(episode), str(step)]:
                        heard[sender] = stream.read()
            decision = uav.decide(heard.values(), q_values=True)
            saved.with_name(f"{uav_id}-{episode}-{step + 1}").write_bytes(uav.state)
            world.send((decision.headings[0], decision.q_values, sum(map(len, heard.values()))))


class Process:
    """A UAV as the world sees it."""

    def __init__(self, *arguments: object) -> None:
        self.arguments = arguments
        self.start()

    def start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.world, other = context.Pipe()
        self.process = context.Process(target=fly_one, args=(*self.arguments, other), daemon=True)
        self.process.start()
        other.close()
        self.port = self.world.recv()

    def kill(self) -> None:
        self.process.kill()
        self.process.join()


def observe(uavs: Floats, users: Floats, aoi: Floats) -> list[dict[str, tuple[float, ...]]]:
    """What each UAV detects."""
    seen: list[dict[str, tuple[float, ...]]] = []
    for own, at in zip(UAVS, uavs):
        near: dict[str, tuple[float, ...]] = {name: (*(to - at),) for name, to in zip(UAVS, uavs) if name != own}
        near |= {name: (*(to - at), age) for name, to, age in zip(USERS, users, aoi)}
        seen.append({name: to for name, to in near.items() if np.hypot(to[0], to[1]) <= DETECTION_RANGE})
    return seen


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("address", nargs="?", default="127.0.0.1:50051")
    parser.add_argument("--policy", default="qedgix")
    parser.add_argument("--layouts", type=int, default=1)
    parser.add_argument("--slots", type=int, default=80)
    parser.add_argument("--kill", action="store_true")
    arguments = parser.parse_args()
    equal, size, kills, ages = 0, 0, 0, []
    with tempfile.TemporaryDirectory() as memory, qedgix.Client(arguments.address) as client:
        processes = [Process(arguments.address, arguments.policy, name, Path(memory)) for name in UAVS]
        for episode in range(arguments.layouts):
            draw = np.random.default_rng(episode)
            uavs: Floats = np.full((3, 2), 0.5)
            users, aoi = draw.random((5, 2)), np.asarray([0.0] * 5)
            with client.session(arguments.policy, seed=episode) as joint:
                for step in range(arguments.slots):
                    seen = observe(uavs, users, aoi)
                    if arguments.kill and step % 10 == 5:
                        kills += 1
                        victim = processes[kills % 3]
                        victim.kill()
                        victim.start()
                    ports = {name: process.port for name, process in zip(UAVS, processes)}
                    for i, process in enumerate(processes):
                        peers = {name: (ports[name], to - uavs[i]) for name, to in zip(UAVS, uavs) if name != UAVS[i]}
                        process.world.send((episode, step, uavs[i], seen[i], peers))
                    answers = [process.world.recv() for process in processes]
                    headings = np.array([heading for heading, _, _ in answers])
                    graph = qedgix.Graph(dict(zip(UAVS, seen)), dict(zip(USERS, aoi)), dict(zip(UAVS, uavs)))
                    decision = joint.act(graph, q_values=True)
                    bits = b"".join(q.tobytes() for _, q, _ in answers if q is not None)
                    expected = b"" if decision.q_values is None else decision.q_values.tobytes()
                    equal += int((headings == decision.headings).all() and bits == expected)
                    size += sum(size for *_, size in answers)
                    uavs = np.clip(uavs + SPEED * decision.directions, 0, 1)
                    near = np.linalg.norm(uavs[:, None] - users, axis=-1) <= TRANSMISSION_RANGE
                    aoi = np.where(near.any(axis=0), 0, aoi + 1)
                    ages.append(aoi.mean())
        for process in processes:
            process.world.send(None)
            process.process.join()
    slots = arguments.layouts * arguments.slots
    print(f"{equal} of {slots} slots as the joint Act, bit for bit; {kills} processes killed and restarted")
    print(f"mean AoI {np.mean(ages):.2f}, {size / slots / 3:.0f} bytes received per UAV and slot")
    raise SystemExit(equal != slots)


if __name__ == "__main__":
    main()
