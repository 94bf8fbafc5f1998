"""A learner of your own against environments that a server hosts: the cross-entropy method with numpy.

python learner.py 127.0.0.1:50051 --iterations 30

Every copy of the vector environment flies one candidate: twelve weights of twelve directions, such as towards old users or away
from other UAVs. A UAV takes the heading nearest to the weighted sum. The best candidates of an iteration are the centre of the
next one. One iteration is one episode of all candidates: 80 calls.
"""

import argparse

import numpy as np
from numpy.typing import NDArray

import qedgix
from qedgix.environments import QedgixVectorEnv

UAVS, USERS = 3, 5
COMPASS = qedgix.directions(range(8))
Floats = NDArray[np.float64]


def towards(observations: NDArray[np.float32], last: Floats) -> Floats:
    """(B, M, 12, 2) directions: six of what a UAV observes, and the same turned by 90 degrees."""
    own, uavs, users = np.split(observations.astype(np.float64), [2, 2 + 2 * UAVS], axis=-1)
    users = users.reshape(*users.shape[:2], USERS, 3)
    fan = 2 * np.pi * np.arange(UAVS) / UAVS
    parts = [
        (10 * users[..., 2:] * users[..., :2]).sum(axis=2),  # users, the older the stronger
        users[..., :2].sum(axis=2),
        uavs.reshape(*own.shape[:2], UAVS, 2).sum(axis=2),
        0.5 - own,
        last,
        np.broadcast_to(np.stack([np.cos(fan), np.sin(fan)], axis=-1), own.shape),  # UAVs at one point can differ
    ]
    vectors = np.stack(parts, axis=2)
    turned = np.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)
    return np.concatenate([vectors, turned], axis=2)


def fly(env: QedgixVectorEnv, weights: Floats, seed: int) -> Floats:
    """Flies one episode with each candidate, weights (B, 12), and returns their mean AoI in slots (B,)."""
    observations, infos = env.reset(seed=seed)
    last: Floats = np.zeros((len(weights), UAVS, 2))
    while "final_info" not in infos:
        wish = np.einsum("bmfx,bf->bmx", towards(observations, last), weights)
        headings = (wish @ COMPASS.T).argmax(axis=-1)
        last = qedgix.directions(headings)
        observations, _, _, _, infos = env.step(headings)
    mean_aoi: Floats = infos["final_info"]["episode"]["mean_aoi"]
    return mean_aoi


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("address", nargs="?", default="127.0.0.1:50051")
    parser.add_argument("--iterations", type=int, default=30)
    parser.add_argument("--candidates", type=int, default=128)
    arguments = parser.parse_args()
    draw = np.random.default_rng(1)
    count = arguments.candidates

    env = qedgix.vector_env(arguments.address, {"uavs": UAVS, "users": USERS}, count=count)
    mean, spread = np.zeros(12), np.ones(12)
    for iteration in range(arguments.iterations):
        weights = mean + spread * draw.standard_normal((count, 12))
        # No evaluation uses seeds from 2^32. Every copy and every iteration has a layout of its own.
        mean_aoi = fly(env, weights, seed=2**32 + iteration * count)
        elite = weights[np.argsort(mean_aoi)[: count // 8]]
        mean, spread = elite.mean(axis=0), elite.std(axis=0) + 0.05
        print(f"iteration {iteration + 1}: mean AoI {mean_aoi.mean():.2f} slots")
    for name, candidate in [("before", np.zeros(12)), ("after", mean)]:
        mean_aoi = fly(env, np.tile(candidate, (count, 1)), seed=10_000)
        print(f"{name} learning: mean AoI {mean_aoi.mean():.2f} slots on {count} other layouts")
    env.close()


if __name__ == "__main__":
    main()
