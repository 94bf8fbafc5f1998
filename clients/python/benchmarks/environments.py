"""Slots per second of hosted environments, with random headings.

    python benchmarks/environments.py 127.0.0.1:50051

"slots" are slots of single fleets: a vector of 64 copies flies 64 of them in one call.
"""

from __future__ import annotations

import argparse
from time import perf_counter

import numpy as np

import qedgix


def parallel(address: str, slots: int) -> float:
    """Seconds of `slots` slots of the environment of PettingZoo."""
    env = qedgix.parallel_env(address, seed=1)
    draw = np.random.default_rng(1)
    env.reset()
    begin = perf_counter()
    for _ in range(slots):
        if not env.agents:
            env.reset()
        env.step(dict(zip(env.agents, draw.integers(8, size=len(env.agents)))))
    seconds = perf_counter() - begin
    env.close()
    return seconds


def vector(address: str, slots: int, count: int) -> float:
    """Seconds of `slots` slots of `count` copies."""
    env = qedgix.vector_env(address, count=count, seed=1)
    draw = np.random.default_rng(1)
    env.reset()
    begin = perf_counter()
    for _ in range(slots // count):
        env.step(draw.integers(8, size=(count, 3)))
    seconds = perf_counter() - begin
    env.close()
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address", nargs="?", default="127.0.0.1:50051", help="address of gRPC (default: %(default)s)")
    parser.add_argument("--slots", type=int, default=20_000, help="slots of each (default: %(default)s)")
    arguments = parser.parse_args()
    slots = arguments.slots
    print(f"parallel_env              {slots / parallel(arguments.address, slots):8.0f} slots/s")
    for count in (16, 64, 256):
        print(f"vector_env, {count:4} copies   {slots / vector(arguments.address, slots, count):8.0f} slots/s")


if __name__ == "__main__":
    main()
