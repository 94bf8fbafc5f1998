#!/usr/bin/env python3
"""Compares policies away from the environment that they were trained in: other fleets, ranges, horizons, and disturbances.

    benches/away.py --qedgix target/release/qedgix --policy qedgix --reference sweep-shared

Prints one row per condition: the mean AoI of every policy, and the paired difference of the first policy from the reference with
its 95 % interval, also in percent of the reference's mean AoI. Every row is one call of `qedgix evaluate`."""

import argparse
import json
import subprocess

CONDITIONS = [
    ("3 UAVs, 5 users, d = 0.28", []),
    ("2 UAVs, 4 users", ["--uavs", "2", "--users", "4"]),
    ("3 UAVs, 8 users", ["--users", "8"]),
    ("4 UAVs, 8 users", ["--uavs", "4", "--users", "8"]),
    ("6 UAVs, 12 users", ["--uavs", "6", "--users", "12"]),
    ("2 UAVs, 20 users", ["--uavs", "2", "--users", "20"]),
    ("d = 0.20", ["--detection-range", "0.20"]),
    ("d = 0.36", ["--detection-range", "0.36"]),
    ("K = 160", ["--slots", "160"]),
    ("K = 320", ["--slots", "320"]),
    ("one UAV lost at slot 20", ["--lose-uav", "1@20"]),
    ("position noise 0.05", ["--position-noise", "0.05"]),
    ("communication everywhere", ["--communication-range", "1.5"]),
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--qedgix", default="qedgix", help="the program [default: qedgix]")
    parser.add_argument("--policy", action="append", required=True, help="a checkpoint file or the name of a policy; may be repeated")
    parser.add_argument("--reference", default="sweep-shared", help="the policy to compare the first one with [default: sweep-shared]")
    parser.add_argument("--layouts", default="eval-v2", help="list of layouts [default: eval-v2]")
    parser.add_argument("--episodes", type=int, default=512, help="number of layouts [default: 512]")
    parser.add_argument("--json", metavar="FILE", help="write all answers to this file")
    args = parser.parse_args()
    names = [*args.policy, args.reference]
    print("| condition | " + " | ".join(names) + " | difference | in % |")
    print("| --- " * (len(names) + 3) + "|")
    answers = {}
    for condition, flags in CONDITIONS:
        command = [args.qedgix, "evaluate", "--json", "--layouts", args.layouts, "--episodes", str(args.episodes), *flags]
        command += [word for name in names for word in ("--policy", name)]
        answer = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
        answers[condition] = answer
        mean = {row["policy"]: row["summary"]["mean_aoi"]["mean"] for row in answer["policies"]}
        pair = next(pair for pair in answer["differences"] if {pair["first"], pair["second"]} == {names[0], args.reference})
        sign = 1 if pair["first"] == names[0] else -1
        difference = pair["difference"]["mean_aoi"]
        ends = sorted(sign * difference[end] for end in ("low", "high"))
        middle = sign * difference["mean"]
        percent = [100 * x / mean[args.reference] for x in (middle, *ends)]
        columns = [f"{mean[name]:.2f}" for name in names]
        columns += [f"{middle:+.2f} ({ends[0]:+.2f} to {ends[1]:+.2f})", f"{percent[0]:+.1f} ({percent[1]:+.1f} to {percent[2]:+.1f})"]
        print(f"| {condition} | " + " | ".join(columns) + " |", flush=True)
    if args.json:
        with open(args.json, "w", encoding="utf-8") as file:
            json.dump(answers, file, indent=1)


if __name__ == "__main__":
    main()
