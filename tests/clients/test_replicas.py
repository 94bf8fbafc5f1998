"""Two replicas behind haproxy, as docs/scaling.md configures it: fleets whose callers keep the memory do not notice a restart."""

import hashlib
import json
import os
import shutil
import signal
import socket
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest
from google.protobuf import json_format
from qedgix.v1 import policy_pb2
from world import Slot

FLEETS, SLOTS = 8, 1250
ROOT = os.path.join(os.path.dirname(__file__), "..", "..")


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def until(condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


class Replica:
    def __init__(self, data):
        self.data = data
        self.grpc = f"127.0.0.1:{free_port()}"
        self.process = None
        self.start()

    def start(self):
        endpoints = self.data / "endpoints.json"
        endpoints.unlink(missing_ok=True)
        command = [os.environ["QEDGIX_BIN"], "serve", "--grpc-addr", self.grpc, "--http-addr", "127.0.0.1:0", "--connection-age", "1s"]
        with (self.data / "log").open("ab") as log:
            self.process = subprocess.Popen([*command, "--data-dir", str(self.data)], stdout=log, stderr=log)
        until(lambda: endpoints.exists() or self.process.poll() is not None)
        assert self.process.poll() is None, (self.data / "log").read_text()
        self.http = json.loads(endpoints.read_text())["http"]

    def stop(self):
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(60) == 0


def documented():
    """The configuration of haproxy in docs/scaling.md: its first block that is not executed."""
    with open(os.path.join(ROOT, "docs", "scaling.md")) as file:
        return file.read().split("\n```\n", 1)[1].split("```", 1)[0]


@pytest.fixture
def replicas(tmp_path):
    haproxy = shutil.which("haproxy", path=os.environ["PATH"] + ":/usr/sbin")
    if haproxy is None:
        pytest.skip("haproxy is not installed")
    servers = []
    for name in ["a", "b"]:
        (tmp_path / name).mkdir()
        servers.append(Replica(tmp_path / name))
    address = f"127.0.0.1:{free_port()}"
    # The addresses of the document, replaced by free ones.
    config = documented().replace(":443 ssl crt /etc/haproxy/qedgix.pem alpn h2", f"{address} proto h2")
    for replica, old in zip(servers, ["10.0.0.1:50051", "10.0.0.2:50051"]):
        assert old in config
        config = config.replace(old, replica.grpc)
    (tmp_path / "haproxy.cfg").write_text(config)
    proxy = subprocess.Popen([haproxy, "-db", "-f", str(tmp_path / "haproxy.cfg")])
    try:
        with grpc.insecure_channel(address) as channel:
            ready = grpc.channel_ready_future(channel)
            until(lambda: ready.done() or proxy.poll() is not None)
        assert proxy.poll() is None, "haproxy refuses its configuration"
        yield address, servers
    finally:
        proxy.kill()
        proxy.wait()
        for server in servers:
            server.process.kill()
            server.process.wait()


class Fleet:
    """A caller that keeps the memory of its fleet, and tries again while no replica answers."""

    def __init__(self, seed, count):
        self.scenes = [json_format.ParseDict(Slot(1000 * seed + i).scene(), policy_pb2.Scene()) for i in range(40)]
        self.count, self.healed = count, 0

    def fly(self, address):
        """A digest of all decisions."""
        decisions, memory = hashlib.sha256(), b""
        with grpc.insecure_channel(address, options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
            act = channel.unary_unary(
                "/qedgix.v1.PolicyService/Act", policy_pb2.ActRequest.SerializeToString, policy_pb2.ActResponse.FromString
            )
            for slot in range(SLOTS):
                request = policy_pb2.ActRequest(policy="qedgix", scene=self.scenes[slot % len(self.scenes)], recurrent_state=memory)
                answer = self.send(act, request)
                memory = answer.recurrent_state
                decisions.update(bytes(action.heading_index for action in answer.actions))
                self.count()
        return decisions.hexdigest()

    def send(self, act, request):
        end = time.monotonic() + 30
        while True:
            try:
                return act(request, timeout=10)
            except grpc.RpcError as error:
                assert error.code() == grpc.StatusCode.UNAVAILABLE and time.monotonic() < end, error
                self.healed += 1
                time.sleep(0.05)


def test_fleets_do_not_notice_the_restart_of_a_replica(replicas):
    address, (first, second) = replicas
    done, lock = [0], threading.Lock()

    def count():
        with lock:
            done[0] += 1

    def flown(where):
        fleets = [Fleet(seed, count) for seed in range(FLEETS)]
        with ThreadPoolExecutor(FLEETS) as pool:
            return [pool.submit(fleet.fly, to) for fleet, to in zip(fleets, where)], fleets

    with ThreadPoolExecutor(1) as restarter:

        def restart():
            until(lambda: done[0] > FLEETS * SLOTS // 4)
            first.stop()
            first.start()

        restarted = restarter.submit(restart)
        flights, fleets = flown([address] * FLEETS)
        restarted.result()
    assert done[0] == FLEETS * SLOTS == 10_000
    print(f"{done[0]} acts, {sum(fleet.healed for fleet in fleets)} tried again")
    # Whichever replica answers, the decisions are the same.
    alone, _ = flown([second.grpc] * FLEETS)
    assert [flight.result() for flight in flights] == [flight.result() for flight in alone]
