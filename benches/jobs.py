#!/usr/bin/env python3
"""Measures what a server bears of jobs: submission, lists, start, metrics.

    benches/jobs.py --qedgix target/release/qedgix

Prints one line per measurement: the figure, and the bar that it has to meet. Starts servers with a data directory of their own. The
worker of the only job that starts is stopped (SIGSTOP), so that nothing but the server computes. Rows of metrics are reported in the
name of that worker, which needs the package grpcio."""

import argparse
import contextlib
import http.client
import json
import os
import signal
import sqlite3
import statistics
import struct
import subprocess
import tempfile
import threading
import time
from pathlib import Path

NAMES = 20


class Server:
    """A server on free ports, and one connection to it."""

    def __init__(self, program: str, data: Path) -> None:
        endpoints = data / "endpoints.json"
        endpoints.unlink(missing_ok=True)
        begin = time.perf_counter()
        command = [program, "serve", "--grpc-addr", "127.0.0.1:0", "--http-addr", "127.0.0.1:0", "--data-dir", str(data)]
        command += ["--cpu-budget", "1", "--heartbeat-timeout", "1h"]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL)
        while not endpoints.exists():
            assert self.process.poll() is None, "the server ended"
            time.sleep(0.002)
        self.start_seconds = time.perf_counter() - begin
        addresses = json.loads(endpoints.read_text())
        self.grpc = addresses["grpc"]
        host, port = addresses["http"].rsplit(":", 1)
        self.connection = http.client.HTTPConnection(host, int(port))

    def request(self, method: str, path: str, body: object = None) -> bytes:
        data = None if body is None else json.dumps(body)
        self.connection.request(method, path, data, {"content-type": "application/json"} if data else {})
        response = self.connection.getresponse()
        answer = response.read()
        assert response.status < 300, answer
        return answer

    def timed(self, method: str, path: str, body: object = None) -> float:
        begin = time.perf_counter()
        self.request(method, path, body)
        return (time.perf_counter() - begin) * 1000

    def peak_mib(self) -> float:
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / 1024

    def stop_workers(self) -> int:
        """Stops the worker of the first job, which lives until its server ends. Returns its process id."""
        while True:
            children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
            tasks = Path(f"/proc/{self.process.pid}/task").iterdir()
            children += [pid for task in tasks for pid in (task / "children").read_text().split()]
            if children:
                for pid in set(children):
                    os.kill(int(pid), signal.SIGSTOP)
                return int(children[0])
            time.sleep(0.01)

    def kill(self) -> None:
        self.connection.close()
        self.process.kill()
        self.process.wait()


def line(what: str, values: list[float], bar: float) -> None:
    values = sorted(values)
    p99 = values[min(len(values) - 1, len(values) * 99 // 100)]
    verdict = "ok" if p99 < bar else "MISSED"
    print(f"{what:<58} p50 {statistics.median(values):8.2f} ms   p99 {p99:8.2f} ms   bar {bar:6.0f} ms   {verdict}", flush=True)


def add_metrics(data: Path, rows: int) -> str:
    """Gives the first job metrics, as its worker would have reported them. Returns its id."""
    with contextlib.closing(sqlite3.connect(data / "qedgix.sqlite")) as db, db:
        number, job = db.execute("SELECT number, id FROM jobs ORDER BY number LIMIT 1").fetchone()
        steps = rows // NAMES
        values = ((number, f"metric-{i // steps:02}", i % steps, i * 0.1, 0, 0) for i in range(steps * NAMES))
        db.executemany("INSERT INTO metrics (job, name, step, value, at, seq) VALUES (?, ?, ?, ?, ?, ?)", values)
        best = ((n, "eval/mean_aoi", n * 0.1, 0, n * 0.1, 0) for (n,) in db.execute("SELECT number FROM jobs").fetchall())
        db.executemany("INSERT OR IGNORE INTO metric_summaries (job, name, best, best_step, last, last_step) VALUES (?, ?, ?, ?, ?, ?)", best)
    return job


class Reporter:
    """Reports rows of metrics of the first job, as its worker does, at a fixed rate until it is stopped."""

    CALLS = 10  # per second

    def __init__(self, server: Server, worker: int, rate: int) -> None:
        import grpc

        self.environment = dict(
            entry.split("=", 1) for entry in Path(f"/proc/{worker}/environ").read_text().split("\0") if "=" in entry
        )
        self.metadata = [
            ("qedgix-job", self.environment["QEDGIX_JOB"]),
            ("qedgix-attempt", self.environment["QEDGIX_ATTEMPT"]),
            ("authorization", f"Bearer {self.environment['QEDGIX_TOKEN']}"),
        ]
        self.report = grpc.insecure_channel(server.grpc).unary_unary("/qedgix.v1.WorkerService/Report")
        self.rows, self.times, self.stopped = rate // self.CALLS, [], threading.Event()
        self.begin = time.perf_counter()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self) -> None:
        step = 0
        while not self.stopped.wait(max(0.0, self.begin + len(self.times) / self.CALLS - time.perf_counter())):
            rows = []
            for _ in range(self.rows // NAMES):
                step += 1
                rows += [field(1, field(1, f"metric-{i:02}".encode()) + b"\x10" + varint(step) + b"\x19" + struct.pack("<d", i)) for i in range(NAMES)]
            begin = time.perf_counter()
            self.report(b"".join(rows) + b"\x10" + varint(step), metadata=self.metadata, timeout=30)
            self.times.append((time.perf_counter() - begin) * 1000)

    def stop(self) -> float:
        """Returns how many rows per second were stored."""
        self.stopped.set()
        self.thread.join()
        return len(self.times) * self.rows / (time.perf_counter() - self.begin)


def varint(number: int) -> bytes:
    """A number in the encoding of protocol buffers."""
    low, rest = number & 127, number >> 7
    return bytes([low | 128]) + varint(rest) if rest else bytes([low])


def field(number: int, content: bytes) -> bytes:
    """A field with a length, in the encoding of protocol buffers."""
    return bytes([number << 3 | 2]) + varint(len(content)) + content


def act_p99(program: str, server: Server) -> float:
    """p99 of `Act` in ms, 200 per second for five seconds."""
    command = [program, "bench", "act", "--server", server.grpc, "--rate", "200", "--duration", "5s", "--rounds", "1", "--json"]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)["act"]["p99_us"] / 1000


def rows_beside_act(program: str, rate: int) -> None:
    """Measures `Act` alternately without and with rows of metrics that arrive at this rate."""
    with tempfile.TemporaryDirectory() as directory:
        server = Server(program, Path(directory))
        server.request("POST", "/v1/jobs", {"name": "first"})
        worker = server.stop_workers()
        p99, stored, calls = ([], []), [], []
        for _ in range(5):
            p99[0].append(act_p99(program, server))
            reporter = Reporter(server, worker, rate)
            p99[1].append(act_p99(program, server))
            stored.append(reporter.stop())
            calls += reporter.times
        alone, beside = (statistics.median(values) for values in p99)
        verdict = "ok" if beside < 2 * alone and min(stored) > 0.98 * rate else "MISSED"
        print(f"Act at 200 per second: p99 {alone:.2f} ms alone, {beside:.2f} ms beside {min(stored):.0f} rows of metrics per second, "
              f"ratio {beside / alone:.2f}   bar 2   {verdict} (medians of five rounds)")
        line(f"report of {rate // Reporter.CALLS} rows", calls, 1000 / Reporter.CALLS)
        server.kill()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--qedgix", default="target/release/qedgix", help="the program [default: target/release/qedgix]")
    parser.add_argument("--jobs", type=int, default=10_000, help="queued jobs [default: 10000]")
    parser.add_argument("--rows", type=int, default=1_000_000, help="metric rows of one job [default: 1000000]")
    parser.add_argument("--rate", type=int, default=5_000, help="metric rows per second beside Act [default: 5000]")
    args = parser.parse_args()
    rows_beside_act(args.qedgix, args.rate)
    with tempfile.TemporaryDirectory() as directory:
        data = Path(directory)
        server = Server(args.qedgix, data)
        server.request("POST", "/v1/jobs", {"name": "first"})
        server.stop_workers()
        body = {"labels": {"team": "a"}, "algorithm": "qmix", "training": {"steps": 100_000}}
        times = [server.timed("POST", "/v1/jobs", {**body, "name": f"job-{i}", "seed": i}) for i in range(args.jobs)]
        line(f"submit, up to {args.jobs} queued", times[-min(len(times), 2000):], 10)
        server.kill()
        job = add_metrics(data, args.rows)

        starts = []
        for _ in range(3):
            server = Server(args.qedgix, data)
            starts.append(server.start_seconds * 1000)
            server.kill()
        line(f"start with {args.jobs} queued", starts, 1000)

        server = Server(args.qedgix, data)
        server.stop_workers()
        for what, query in [
            ("list of 100", ""),
            ("list, state, oldest first", "&state=queued&sort=created"),
            ("list, label and algorithm, by name", "&labels=team%3Da&algorithm=qmix&sort=name"),
            ("list, by best metric, with metric", "&state=queued&sort=best:eval/mean_aoi&metrics=eval/mean_aoi"),
            ("list, name prefix, by last metric", "&name=job-1*&sort=-last:eval/mean_aoi"),
        ]:
            line(what, [server.timed("GET", f"/v1/jobs?page_size=100{query}") for _ in range(200)], 10)
        line(f"first page of {args.rows} metric rows (1000)", times_of(server, f"/v1/jobs/{job}/metrics?page_size=1000"), 20)
        line(f"first page of {args.rows} metric rows (10000, default)", times_of(server, f"/v1/jobs/{job}/metrics"), 20)
        before = server.peak_mib()
        begin = time.perf_counter()
        server.connection.request("GET", f"/v1/jobs/{job}/metrics?format=csv")
        response, size, lines = server.connection.getresponse(), 0, 0
        while part := response.read(1 << 16):
            size, lines = size + len(part), lines + part.count(b"\n")
        seconds = time.perf_counter() - begin
        print(f"CSV of {lines - 1} rows: {size / 2**20:.1f} MiB in {seconds:.1f} s; the peak memory of the server rose by "
              f"{server.peak_mib() - before:.1f} MiB to {server.peak_mib():.1f} MiB")
        server.kill()


def times_of(server: Server, path: str) -> list[float]:
    return [server.timed("GET", path) for _ in range(50)]


if __name__ == "__main__":
    main()
