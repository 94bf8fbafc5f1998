"""The whole REST interface against its own description: schemathesis with all checks and all phases.

By default this is a gate: the same requests in every run, to a server whose queue of jobs stands still. With QEDGIX_EXPLORE
set it is a search: schemathesis learns from answers, jobs run, and no two runs are alike (`tests/explore`).

QEDGIX_EXAMPLES (15) is the number of examples per operation, QEDGIX_SEED (1) the seed of the generator. Without pytest,
`QEDGIX_REST=127.0.0.1:8080 python test_openapi.py` tests any server.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

HERE = Path(__file__).resolve().parent
EXPLORE = bool(os.environ.get("QEDGIX_EXPLORE"))
ENDED = ("succeeded", "failed", "cancelled")


def address():
    given = os.environ.get("QEDGIX_REST")
    if given is None:
        given = json.loads(Path(os.environ["QEDGIX_ENDPOINTS"]).read_text())["http"]
    return given.rstrip("/") if "://" in given else f"http://{given}"


def call(method, url, body=None):
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, data, {"content-type": "application/json"}, method=method)
    with urllib.request.urlopen(request, timeout=300) as answer:
        return json.load(answer)


def submit(rest, **job):
    return call("POST", f"{rest}/v1/jobs", {"algorithm": "vdn", **job})["id"]


def wait_for(rest, job, states):
    """Returns the job once it is in one of `states`."""
    deadline = time.monotonic() + 600
    while (found := call("GET", f"{rest}/v1/jobs/{job}"))["state"] not in states:
        assert time.monotonic() < deadline, f"job {job} is still {found['state']}"
        time.sleep(0.1)
    return found


def prepare(rest):
    """Makes jobs and a checkpoint to ask about, and returns the dictionaries of their ids."""
    ended = submit(rest, name="trained", environment={"uavs": 1, "users": 1, "slots": 4}, training={"steps": 400, "eval_every": 200})
    found = wait_for(rest, ended, ENDED)
    assert found["state"] == "succeeded", found
    checkpoints = [one["id"] for one in call("GET", f"{rest}/v1/jobs/{ended}/checkpoints")["checkpoints"]]
    if not EXPLORE:
        # One job runs for long, and the next in line has to wait for its core: no job behind them starts, so that what
        # requests find does not depend on how fast jobs run.
        wait_for(rest, submit(rest, threads=1, training={"steps": 100_000_000}), ["running"])
        submit(rest, threads=2, priority=100)
    queued = submit(rest)
    return {"ended_jobs": [ended], "queued_jobs": [queued], "jobs": [ended, queued], "checkpoints": checkpoints}


def configuration(dictionaries):
    parts = [(HERE / "schemathesis.toml").read_text()]
    if not EXPLORE:
        parts.append((HERE / "gate.toml").read_text())
    parts += [f"[dictionaries.{name}]\nvalues = {json.dumps(values)}\n" for name, values in dictionaries.items()]
    return "\n".join(parts)


def run():
    rest = address()
    with tempfile.TemporaryDirectory() as elsewhere:
        config = Path(elsewhere) / "schemathesis.toml"
        config.write_text(configuration(prepare(rest)))
        environment = {
            **os.environ,
            "QEDGIX_REST": rest,
            "SCHEMATHESIS_HOOKS": "schemathesis_hooks",
            "PYTHONPATH": str(HERE),
            # The order of sets has a say in what is generated.
            "PYTHONHASHSEED": "0",
            # What is found is printed, not kept.
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        command = [
            str(Path(sys.executable).with_name("schemathesis")),
            f"--config-file={config}",
            "run",
            f"{rest}/openapi.json",
            f"--max-examples={os.environ.get('QEDGIX_EXAMPLES', '15')}",
            f"--seed={os.environ.get('QEDGIX_SEED', '1')}",
            "--generation-database=none",
            "--workers=1",
            "--no-color",
        ]
        code = subprocess.run(command, env=environment, cwd=elsewhere, check=False).returncode
    cancel_jobs(rest)
    return code


def cancel_jobs(rest):
    """Leaves the server idle: every body that is a job became one."""
    for state in ("queued", "paused", "running"):
        while True:
            jobs = call("GET", f"{rest}/v1/jobs?state={state}")["jobs"]
            jobs = [job["id"] for job in jobs if job["wanted"] != "cancel"]
            for job in jobs:
                call("POST", f"{rest}/v1/jobs/{job}/cancel")
            if not jobs:
                break


def test_openapi():
    assert run() == 0


if __name__ == "__main__":
    sys.exit(run())
