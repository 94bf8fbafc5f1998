"""An external simulator that lets a policy of a server fly its UAVs.

python simulator.py 127.0.0.1:50051 --policy qedgix
"""

import argparse

import numpy as np

import qedgix

UAVS, USERS, SLOTS = 3, 5, 80
SPEED, TRANSMISSION_RANGE = 0.04, 0.12  # in units of the side of the square


def fly(session: qedgix.Fleet, seed: int) -> float:
    """Flies one episode and returns its mean AoI in slots."""
    uavs, users, aoi = np.full((UAVS, 2), 0.5), np.random.default_rng(seed).random((USERS, 2)), np.zeros(USERS)
    total = 0.0
    for _ in range(SLOTS):
        decision = session.act(qedgix.Scene(uavs, users, aoi))
        uavs[:] = np.clip(uavs + SPEED * decision.directions, 0.0, 1.0)
        distances = np.linalg.norm(uavs[:, None] - users[None], axis=-1)
        aoi[:] = np.where((distances <= TRANSMISSION_RANGE).any(axis=0), 0.0, aoi + 1)
        total += aoi.mean()
    return total / SLOTS


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("address", nargs="?", default="127.0.0.1:50051")
    parser.add_argument("--policy", default="qedgix")
    parser.add_argument("--episodes", type=int, default=5)
    arguments = parser.parse_args()
    with qedgix.Client(arguments.address) as client, client.session(arguments.policy, seed=1) as session:
        for episode in range(arguments.episodes):
            print(f"episode {episode}: mean AoI {fly(session, seed=episode):.2f} slots")
            session.restart()
