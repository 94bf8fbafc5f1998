"""A simulator in metres: an area of 3 km by 2 km, UAVs of 12, 15 and 20 m/s, errors of 5 m in every measurement, a UAV that is
lost, a user that appears and one that leaves. It lists only what a UAV detects.

python metric_simulator.py 127.0.0.1:50051 --policy qedgix
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import qedgix

Point = NDArray[np.float64]

AREA, SLOT = np.array([3000.0, 2000.0]), 8.0  # metres, seconds
TRANSMISSION_RANGE, DETECTION_RANGE = 360.0, 840.0
FRAME = qedgix.Frame(width=AREA[0], height=AREA[1])
WORLD = qedgix.World(slot_seconds=SLOT, speed=15.0, transmission_range=TRANSMISSION_RANGE, detection_range=DETECTION_RANGE)


@dataclass
class Uav:
    """A UAV; in metres and metres per second."""

    at: Point
    speed: float


@dataclass
class Sensor:
    """A user, whose data was collected last at the time `last`, in seconds."""

    at: Point
    last: float = 0.0


def observe(uavs: dict[str, Uav], sensors: dict[str, Sensor], time: float, noisy: Callable[[Point], Point]) -> qedgix.Graph:
    """What the UAVs detect; nobody knows of other sensors."""
    targets: dict[str, Uav | Sensor] = {**uavs, **sensors}
    detections: dict[str, dict[str, tuple[float, ...]]] = {}
    for name, uav in uavs.items():
        seen = detections[name] = {}
        for other, target in targets.items():
            if other == name or np.linalg.norm(target.at - uav.at) > DETECTION_RANGE:
                continue
            x, y = noisy(target.at - uav.at)
            seen[other] = (x, y, (time - target.last) / SLOT) if isinstance(target, Sensor) else (x, y)
    positions = {name: tuple(noisy(uav.at)) for name, uav in uavs.items()}
    return qedgix.Graph(detections, positions=positions, speeds={name: uav.speed for name, uav in uavs.items()})


def fly(session: qedgix.Fleet, seed: int = 1) -> float:
    """Flies 80 slots and returns the mean AoI in seconds."""
    draw = np.random.default_rng(seed)
    uavs = {f"drone-{i}": Uav(AREA / 2, speed) for i, speed in enumerate([12.0, 15.0, 20.0])}
    sensors = {f"sensor-{i}": Sensor(draw.uniform(0, AREA)) for i in range(5)}
    ages = []
    for step in range(80):
        time = step * SLOT
        if time == 200:
            sensors["sensor-late"] = Sensor(np.array([400.0, 400.0]), time)
        if time == 304:
            del uavs["drone-1"]
        if time == 504:
            del sensors["sensor-2"]
        decision = session.act(observe(uavs, sensors, time, lambda at: at + draw.normal(0, 5, 2)), motion=True)
        assert decision.velocities is not None
        for name, velocity in zip(decision.uav_ids, decision.velocities):
            uavs[name].at = np.clip(uavs[name].at + SLOT * velocity, 0, AREA)
        for sensor in sensors.values():
            if any(np.linalg.norm(uav.at - sensor.at) <= TRANSMISSION_RANGE for uav in uavs.values()):
                sensor.last = time + SLOT
        ages.append(np.mean([time + SLOT - sensor.last for sensor in sensors.values()]))
    return float(np.mean(ages))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("address", nargs="?", default="127.0.0.1:50051")
    parser.add_argument("--policy", default="qedgix")
    arguments = parser.parse_args()
    with qedgix.Client(arguments.address) as client, client.session(arguments.policy, frame=FRAME, world=WORLD) as session:
        for warning in session.warnings:
            print(f"{warning.field}: {warning.message}")
        print(f"{arguments.policy}: 80 of 80 slots answered, mean AoI {fly(session):.1f} s")
