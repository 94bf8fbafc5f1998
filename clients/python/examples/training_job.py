"""Trains a policy on a server, looks at its curve, and flies it.

python training_job.py 127.0.0.1:50051 127.0.0.1:8080 --steps 100000
"""

import argparse
from pathlib import Path

from simulator import fly

import qedgix


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("grpc", nargs="?", default="127.0.0.1:50051")
    parser.add_argument("http", nargs="?", default="127.0.0.1:8080")
    parser.add_argument("--name", default="my-policy")
    parser.add_argument("--steps", type=int, default=100_000, help="environment steps")
    parser.add_argument("--out", type=Path, default=Path("my-policy.safetensors"))
    arguments = parser.parse_args()

    with qedgix.Client(arguments.grpc, arguments.http) as client:
        job = client.jobs.submit(
            name=arguments.name,
            algorithm="qmix",
            preset="practical",
            environment={"uavs": 3, "users": 5},
            training={"steps": arguments.steps, "eval_every": arguments.steps // 4},
            seed=1,
        )
        try:
            job.wait(progress=True)
        except qedgix.JobEnded as ended:
            raise SystemExit(f"{ended}; its last words:\n{job.attempts()[-1].log}") from None
        steps, values = job.metrics("eval/mean_aoi").curve("eval/mean_aoi")
        for step, value in zip(steps, values):
            print(f"after {step:8} environment steps: mean AoI {value:.2f} slots")
        print(f"best weights: {job.download(arguments.out)}")
        client.policies.set_alias(arguments.name, "live", client.policies.get(str(job.policy)).ref.version)
        with client.session(f"{arguments.name}@live") as session:
            print(f"{session.policy} flies an episode with mean AoI {fly(session, seed=0):.2f} slots")


if __name__ == "__main__":
    main()
