"""Event files of a job, read back with TensorBoard: the values are those of REST, and the curve of a resumed job does not zigzag."""

import json
import os
import signal
import subprocess
import time
import urllib.request

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

JOB = {
    "algorithm": "vdn",
    "environment": {"slots": 10, "uavs": 2, "users": 2},
    "training": {"steps": 20_000, "envs": 2, "batch": 2, "buffer": 20, "eval_every": 5000, "eval_episodes": 2},
}


class Server:
    """A server whose jobs have a snapshot only when they are paused."""

    def __init__(self, data):
        self.data = data
        self.start()

    def start(self):
        endpoints = self.data / "endpoints.json"
        endpoints.unlink(missing_ok=True)
        command = [os.environ["QEDGIX_BIN"], "serve", "--grpc-addr", "127.0.0.1:0", "--http-addr", "127.0.0.1:0", "--snapshot-every", "24h"]
        with (self.data / "log").open("ab") as log:
            self.process = subprocess.Popen([*command, "--data-dir", str(self.data)], stdout=log, stderr=log)
        self.until(endpoints.exists)
        self.url = f"http://{json.loads(endpoints.read_text())['http']}"

    def until(self, condition):
        end = time.monotonic() + 300
        while not condition():
            assert self.process.poll() is None and time.monotonic() < end, (self.data / "log").read_text()
            time.sleep(0.02)

    def rest(self, path, body=None):
        request = urllib.request.Request(self.url + path, body and json.dumps(body).encode(), {"content-type": "application/json"})
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)

    def job(self, job, condition):
        """Waits until the job is as it should be."""
        self.until(lambda: condition(self.rest(f"/v1/jobs/{job}")))
        return self.rest(f"/v1/jobs/{job}")


@pytest.fixture
def server(tmp_path):
    server = Server(tmp_path)
    yield server
    server.process.kill()
    server.process.wait()


def metrics(server, job):
    """All rows of REST: (name, step) to value."""
    rows, token = {}, ""
    while True:
        page = server.rest(f"/v1/jobs/{job}/metrics?page_size=1000&page_token={token}")
        rows.update({(row["name"], row["step"]): row["value"] for row in page["metrics"]})
        token = page["next_page_token"]
        if not token:
            return rows


def scalars(file):
    """The curves in an event file: name to (step, value, time)."""
    events = EventAccumulator(str(file), size_guidance={"scalars": 0})
    events.Reload()
    return {tag: [(e.step, e.value, e.wall_time) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_event_files_have_the_metrics_of_a_job_that_was_resumed(server, tmp_path):
    job = server.rest("/v1/jobs", JOB)["id"]
    server.job(job, lambda job: job["progress"]["step"] > 0)
    server.rest(f"/v1/jobs/{job}/pause", {})
    paused = server.job(job, lambda job: job["state"] == "paused")["progress"]["step"]
    # The second attempt has no snapshot of its own, so the third one computes its steps again, to the same values except for speeds.
    server.rest(f"/v1/jobs/{job}/resume", {})
    server.job(job, lambda job: job["progress"]["step"] > paused)
    server.process.send_signal(signal.SIGKILL)
    server.process.wait()
    server.start()
    ended = server.job(job, lambda job: job["state"] not in ("queued", "running"))
    assert (ended["state"], ended["attempts"]) == ("succeeded", 3), ended

    command = [os.environ["QEDGIX_BIN"], "jobs", "export", job, "--tensorboard", "--out", str(tmp_path / "out"), "--server", server.url]
    subprocess.run(command, check=True, timeout=60)
    files = sorted((tmp_path / "out" / "tensorboard").iterdir())
    assert [file.name.rsplit(".", 1)[1] for file in files] == ["attempt-00001", "attempt-00002", "attempt-00003"]

    expected = metrics(server, job)
    attempts = [scalars(file) for file in files]
    found = {(name, step): value for curves in attempts for name, curve in curves.items() for step, value, _ in curve}
    assert found.keys() == expected.keys() and len(found) > 100
    assert sum(len(curve) for curves in attempts for curve in curves.values()) == len(expected), "each row is in one file"
    for row, value in expected.items():
        same = np.float32("nan") if value is None else np.float32(value)
        assert np.array_equal(np.float32(found[row]), same, equal_nan=True), row
    # TensorBoard reads the directory as one run: steps and times of a metric rise from file to file.
    for name, curve in scalars(tmp_path / "out" / "tensorboard").items():
        steps, times = [step for step, _, _ in curve], [time for _, _, time in curve]
        assert steps == sorted(set(steps)), name
        assert times == sorted(times), name
    assert {step <= paused for curve in attempts[0].values() for step, _, _ in curve} == {True}
