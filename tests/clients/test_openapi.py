"""The whole REST interface against its own description: schemathesis with all checks and all phases.

QEDGIX_EXAMPLES (15) is the number of examples per operation and QEDGIX_SEED (1) where they come from; many examples take long.
By itself, `QEDGIX_REST=127.0.0.1:8080 python test_openapi.py` does the same to any server.
"""

import json
import os
import subprocess
import sys
import tempfile
import urllib.request
from pathlib import Path

HERE = Path(__file__).resolve().parent


def address():
    given = os.environ.get("QEDGIX_REST")
    if given is None:
        given = json.loads(Path(os.environ["QEDGIX_ENDPOINTS"]).read_text())["http"]
    return given.rstrip("/") if "://" in given else f"http://{given}"


def run():
    rest = address()
    environment = {
        **os.environ,
        "QEDGIX_REST": rest,
        "SCHEMATHESIS_HOOKS": "schemathesis_hooks",
        "PYTHONPATH": str(HERE),
        # What is found is printed, not kept.
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    command = [
        str(Path(sys.executable).with_name("schemathesis")),
        f"--config-file={HERE / 'schemathesis.toml'}",
        "run",
        f"{rest}/openapi.json",
        f"--max-examples={os.environ.get('QEDGIX_EXAMPLES', '15')}",
        f"--seed={os.environ.get('QEDGIX_SEED', '1')}",
        "--generation-database=none",
        "--no-color",
    ]
    with tempfile.TemporaryDirectory() as elsewhere:
        code = subprocess.run(command, env=environment, cwd=elsewhere, check=False).returncode
    cancel_jobs(rest)
    return code


def cancel_jobs(rest):
    """Leaves the server idle: every body that is a job became one."""
    for state in ("queued", "paused", "running"):
        while True:
            with urllib.request.urlopen(f"{rest}/v1/jobs?state={state}&page_size=1000") as answer:
                jobs = [job["id"] for job in json.load(answer)["jobs"] if job["wanted"] != "cancel"]
            for job in jobs:
                urllib.request.urlopen(urllib.request.Request(f"{rest}/v1/jobs/{job}/cancel", method="POST")).close()
            if not jobs:
                break


def test_openapi():
    assert run() == 0


if __name__ == "__main__":
    sys.exit(run())
