"""What the client adds to an `Act`: the same messages through a session and through a bare call of grpcio.

    python benchmarks/act.py 127.0.0.1:50051

Rounds of both alternate, because other load on the machine slows down both. "bare" sends a message that is ready and does not
look at the answer; "client" makes the message from arrays, sends it and makes an array of headings from the answer.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from time import perf_counter

import grpc
import numpy as np

import qedgix
from qedgix.v1 import policy_pb2 as pb

PATH = "/qedgix.v1.PolicyService/Act"


def measure(step: Callable[[], object], calls: int) -> float:
    """Median seconds of a call."""
    times = []
    for _ in range(calls):
        begin = perf_counter()
        step()
        times.append(perf_counter() - begin)
    return statistics.median(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address", nargs="?", default="127.0.0.1:50051", help="address of gRPC (default: %(default)s)")
    parser.add_argument("--policy", default="qedgix", help="default: %(default)s")
    parser.add_argument("--rounds", type=int, default=20, help="rounds of each (default: %(default)s)")
    parser.add_argument("--calls", type=int, default=200, help="calls per round (default: %(default)s)")
    arguments = parser.parse_args()

    draw = np.random.default_rng(1)
    uavs, users, aoi = draw.random((3, 2)), draw.random((5, 2)), draw.integers(0, 80, 5)
    with (
        qedgix.Client(arguments.address) as client,
        client.session(arguments.policy) as session,
        client.session(arguments.policy) as other,
        client.session(arguments.policy) as third,
        client.stream() as stream,
        grpc.insecure_channel(arguments.address) as channel,
    ):
        call = channel.unary_unary(
            PATH, request_serializer=pb.ActRequest.SerializeToString, response_deserializer=pb.ActResponse.FromString
        )
        message = session.request(qedgix.Scene(uavs, users, aoi))
        message.ClearField("step")

        def bare() -> object:
            return call(message, timeout=10)

        def through_client() -> object:
            return other.act(qedgix.Scene(uavs, users, aoi)).headings

        def through_stream() -> object:
            return stream.act(third, qedgix.Scene(uavs, users, aoi)).headings

        ways = {"bare": bare, "client": through_client, "stream": through_stream}
        for step in ways.values():
            measure(step, arguments.calls)
        rounds: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(arguments.rounds):
            for name, step in ways.items():
                rounds[name].append(measure(step, arguments.calls))
    for name, times in rounds.items():
        ratios = [time / base for time, base in zip(times, rounds["bare"])]
        print(f"{name:8} {1e6 * statistics.median(times):6.0f} us per Act, {statistics.median(ratios):.2f} times bare")


if __name__ == "__main__":
    main()
