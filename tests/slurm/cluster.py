"""Trains on a Slurm cluster of one machine: to the same bits as without it, through kills of slurmd and of the server.

Started by tests/slurm/run. Prints one line per thing that holds; ends with an error at the first that does not."""

import contextlib
import json
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

QEDGIX = os.environ["QEDGIX_BIN"]
TIMEOUT = 120.0


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def until(what: str, condition: Callable[[], Any]) -> Any:
    """The first true value of the condition."""
    end = time.monotonic() + TIMEOUT
    while not (value := condition()):
        assert time.monotonic() < end, f"not within {TIMEOUT:.0f} s: {what}"
        time.sleep(0.05)
    return value


class Cluster:
    """munged, slurmctld and slurmd in a directory, on free ports of loopback."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.daemons: dict[str, subprocess.Popen] = {}
        for name in ["state", "spool", "munge"]:
            (directory / name).mkdir(mode=0o700)
        key = directory / "munge" / "key"
        key.touch(mode=0o400)
        key.write_bytes(secrets.token_bytes(1024))
        host = socket.gethostname().split(".")[0]
        self.conf = directory / "slurm.conf"
        self.conf.write_text(
            f"""ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={free_port()}
SlurmdPort={free_port()}
AuthType=auth/munge
AuthInfo=socket={directory}/munge/socket
CredType=cred/munge
SlurmUser=root
StateSaveLocation={directory}/state
SlurmdSpoolDir={directory}/spool
SlurmctldPidFile={directory}/slurmctld.pid
SlurmdPidFile={directory}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SwitchType=switch/none
MpiDefault=none
ReturnToService=2
SlurmdTimeout=300
SlurmdParameters=config_overrides
KillWait=5
SchedulerParameters=sched_interval=1
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 RealMemory=1000000
PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""
        )
        self.environment = os.environ | {"SLURM_CONF": str(self.conf)}

    def start(self) -> None:
        munge = self.directory / "munge"
        paths = [f"--key-file={munge}/key", f"--socket={munge}/socket", f"--pid-file={munge}/pid", f"--seed-file={munge}/seed"]
        self.spawn("munged", "--foreground", "--force", *paths)
        until("munged answers", (munge / "socket").exists)
        self.spawn("slurmctld", "-D", "-f", str(self.conf))
        self.spawn("slurmd", "-D", "-f", str(self.conf))
        until("the node is idle", lambda: "idle" in self.ask("sinfo", "--noheader", "--format=%T"))

    def spawn(self, name: str, *arguments: str) -> None:
        with (self.directory / f"{name}.log").open("ab") as log:
            self.daemons[name] = subprocess.Popen(
                [name, *arguments], stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=self.environment, start_new_session=True
            )

    def ask(self, *command: str) -> str:
        return subprocess.run(command, env=self.environment, capture_output=True, text=True, timeout=30, check=False).stdout

    def workers(self, states: str) -> list[str]:
        """The names of jobs in these states."""
        return self.ask("squeue", "--noheader", f"--states={states}", "--format=%j").split()

    def stop(self) -> None:
        self.ask("scancel", "--signal=KILL", "--full", "--user=0")
        self.ask("scancel", "--user=0")
        for name in ["slurmd", "slurmctld", "munged"]:
            if daemon := self.daemons.get(name):
                daemon.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    daemon.wait(10)
                daemon.kill()
                daemon.wait()


class Server:
    """A server on a data directory that survives it."""

    def __init__(self, data: Path, environment: dict[str, str], *flags: str) -> None:
        self.data, self.environment = data, environment
        self.command = [QEDGIX, "serve", "--grpc-addr", "127.0.0.1:0", "--http-addr", "127.0.0.1:0", "--data-dir", str(data)]
        self.command += ["--snapshot-every", "1s", "--heartbeat-timeout", "20s", *flags]
        self.start()

    def start(self) -> None:
        endpoints = self.data / "endpoints.json"
        endpoints.unlink(missing_ok=True)
        with (self.data.parent / f"{self.data.name}.log").open("ab") as log:
            self.process = subprocess.Popen(self.command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=self.environment)
        until("the server serves", lambda: endpoints.exists() or self.process.poll() is not None)
        assert self.process.poll() is None, "the server ended"
        self.url = "http://" + json.loads(endpoints.read_text())["http"]

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def call(self, method: str, path: str, body: object = None) -> dict:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.url + path, data, {"content-type": "application/json"}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=30) as response:
                return json.load(response)
        except urllib.error.HTTPError as error:
            raise AssertionError(f"{method} {path}: {error.code} {error.read().decode()}") from error

    def submit(self, name: str, steps: int) -> str:
        training = {"steps": steps, "envs": 4, "batch": 8, "buffer": 60, "eval_every": 6000, "eval_episodes": 4}
        environment = {"uavs": 2, "users": 3, "slots": 20}
        config = {"algorithm": "vdn", "preset": "practical", "seed": 7, "environment": environment, "training": training}
        return self.call("POST", "/v1/jobs", {"name": name, "threads": 1, **config})["id"]

    def job(self, job: str) -> dict:
        return self.call("GET", f"/v1/jobs/{job}")

    def ended(self, job: str) -> dict:
        return until("the job ends", lambda: (found := self.job(job))["state"] in ("succeeded", "failed", "cancelled") and found)

    def digest(self, job: str) -> str:
        best = [c for c in self.call("GET", f"/v1/jobs/{job}/checkpoints")["checkpoints"] if c["kind"] == "best"]
        return best[0]["sha256"]


def check(cluster: Cluster, directory: Path) -> None:
    steps = 12_000
    (directory / "local").mkdir()
    local = Server(directory / "local", dict(os.environ))
    job = local.submit("local", steps)
    assert local.ended(job)["state"] == "succeeded", local.job(job)
    expected = local.digest(job)
    local.process.terminate()
    local.process.wait()
    print(f"trained by a process of the server: {expected[:16]}")

    (directory / "data").mkdir()
    flags = ["--executor", "slurm", "--worker-addr", f"127.0.0.1:{free_port()}", "--slurm-extra=--nice=1", "--slurm-time", "1h"]
    server = Server(directory / "data", cluster.environment, *flags)
    try:
        follow(cluster, server, steps, expected)
    finally:
        server.process.kill()
        server.process.wait()


def follow(cluster: Cluster, server: Server, steps: int, expected: str) -> None:
    files = server.data / "slurm"

    job = server.submit("slurm", steps)
    until("the worker has called", lambda: server.job(job)["state"] != "queued")
    modes = {oct(path.stat().st_mode & 0o777) for path in files.glob("*.json")}
    assert modes <= {"0o600"}, modes
    found = server.ended(job)
    assert (found["state"], server.digest(job)) == ("succeeded", expected), found
    print("trained in Slurm: the same bits")

    job = server.submit("killed", steps)
    until("it trains", lambda: server.job(job)["state"] == "running" and server.job(job)["progress"]["step"] > 0)
    cluster.daemons["slurmd"].kill()
    cluster.daemons["slurmd"].wait()
    server.kill()
    server.start()
    cluster.spawn("slurmd", "-D", "-f", str(cluster.conf))
    found = server.ended(job)
    assert (found["state"], found["attempts"], server.digest(job)) == ("succeeded", 1, expected), found
    print("kill -9 of slurmd and of the server while it trains: the same worker, one attempt, the same bits")

    until("the cluster is empty", lambda: not cluster.workers("PENDING,RUNNING,COMPLETING"))
    cluster.ask("scontrol", "update", "PartitionName=main", "State=DOWN")
    job = server.submit("waiting", steps)
    until("it waits in Slurm", lambda: "Slurm" in (server.job(job).get("waiting") or {}).get("reason", ""))
    server.kill()
    server.start()
    until("its worker is found again", lambda: "PENDING" in (server.job(job).get("waiting") or {}).get("reason", ""))
    reason = server.job(job)["waiting"]["reason"]
    assert len(cluster.workers("PENDING")) == 1
    cancelled = server.submit("cancelled-early", steps)
    until("both wait in Slurm", lambda: len(cluster.workers("PENDING")) == 2)
    server.call("POST", f"/v1/jobs/{cancelled}/cancel")
    assert server.job(cancelled)["state"] == "cancelled"
    until("its worker leaves Slurm", lambda: len(cluster.workers("PENDING")) == 1)
    cluster.ask("scontrol", "update", "PartitionName=main", "State=UP")
    found = server.ended(job)
    assert (found["state"], found["attempts"], server.digest(job)) == ("succeeded", 1, expected), found
    print(f"waited through a restart of the server ({reason}): one worker, one attempt, the same bits; a second one cancelled")

    job = server.submit("endless", 1_000_000_000)
    until("it trains", lambda: server.job(job)["state"] == "running" and server.job(job)["progress"]["step"] > 0)
    begin = time.monotonic()
    server.call("POST", f"/v1/jobs/{job}/cancel")
    until("it is cancelled", lambda: server.job(job)["state"] == "cancelled")
    seconds = time.monotonic() - begin
    until("its worker is gone", lambda: not cluster.workers("PENDING,RUNNING,COMPLETING"))
    print(f"cancelled while it trains, after {seconds:.1f} s")

    job = server.submit("requeued", steps)
    until("it trains", lambda: server.job(job)["state"] == "running" and server.job(job)["progress"]["step"] > 0)
    name = until("Slurm runs it", lambda: cluster.workers("RUNNING"))[0]
    # As by a person or a failing node. The submission forbids it, and people may change that.
    number = cluster.ask("squeue", "--noheader", f"--name={name}", "--format=%A").strip()
    cluster.ask("scontrol", "update", f"JobId={number}", "Requeue=1")
    cluster.ask("scontrol", "requeue", number)
    found = server.ended(job)
    assert (found["state"], found["failures"], server.digest(job)) == ("succeeded", 0, expected), found
    assert found["attempts"] == 2, found
    print("queued again by Slurm while it trains: a second attempt, no failure, the same bits")
    until("no file is left", lambda: not list(files.iterdir()))

    server.process.send_signal(signal.SIGTERM)
    assert server.process.wait(TIMEOUT) == 0


def main() -> None:
    directory = Path(tempfile.mkdtemp(prefix="qedgix-slurm-"))
    cluster = Cluster(directory)
    begin = time.monotonic()
    try:
        cluster.start()
        print("Slurm runs:", cluster.ask("sinfo", "--version").strip())
        check(cluster, directory)
    except BaseException:
        for log in sorted(directory.glob("*.log")):
            print(f"--- {log.name}", *log.read_text(errors="replace").splitlines()[-40:], sep="\n", file=sys.stderr)
        raise
    finally:
        cluster.stop()
        shutil.rmtree(directory, ignore_errors=True)
    print(f"all of it holds, after {time.monotonic() - begin:.0f} s")


if __name__ == "__main__":
    sys.stdout.reconfigure(line_buffering=True)
    main()
