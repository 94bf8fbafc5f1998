"""Servers to test against, and every client in both forms."""

from __future__ import annotations

import asyncio
import inspect
import json
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import qedgix

ROOT = Path(__file__).resolve().parents[3]
BINARY = Path(os.environ.get("QEDGIX_BIN", ROOT / "target" / "release" / "qedgix")).resolve()


class Server:
    """A server on free ports, with its data in a directory. `start` again uses the same ports."""

    def __init__(self, data_dir: Path, *flags: str) -> None:
        self.data_dir = data_dir
        self.flags = flags
        self.grpc = self.http = "127.0.0.1:0"
        self.process: subprocess.Popen[bytes] | None = None

    def qedgix(self, *arguments: str) -> str:
        """Runs a command on the data directory and returns its output."""
        command = [str(BINARY), *arguments, "--data-dir", str(self.data_dir)]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    def start(self) -> Server:
        endpoints = self.data_dir / "endpoints.json"
        endpoints.unlink(missing_ok=True)
        addresses = ["--grpc-addr", self.grpc, "--http-addr", self.http]
        with open(self.data_dir.parent / f"{self.data_dir.name}.log", "ab") as log:
            command = [str(BINARY), "serve", *addresses, "--data-dir", str(self.data_dir), *self.flags]
            self.process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self.data_dir.parent)
        while not endpoints.exists() or not endpoints.read_text():
            assert self.process.poll() is None, Path(log.name).read_text()
            time.sleep(0.02)
        addresses = json.loads(endpoints.read_text())
        self.grpc, self.http = addresses["grpc"], addresses["http"]
        return self

    def kill(self) -> None:
        """As the system does when memory runs out."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()

    def stop(self) -> None:
        if self.process is not None:
            self.process.terminate()
            self.process.wait()


@pytest.fixture
def make_server(tmp_path: Path) -> Iterator[type[Server]]:
    """Makes servers of this test alone."""
    made: list[Server] = []

    def make(*flags: str) -> Server:
        data_dir = tmp_path / f"server-{len(made)}"
        data_dir.mkdir(mode=0o700)
        made.append(Server(data_dir, *flags))
        return made[-1]

    yield make  # type: ignore[misc]
    for server in made:
        server.stop()


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server for all tests."""
    data_dir = tmp_path_factory.mktemp("server") / "data"
    data_dir.mkdir(mode=0o700)
    server = Server(data_dir, "--cpu-budget", "2").start()
    yield server
    server.stop()


class Blocking:
    """An object of the asynchronous client, used like its synchronous twin."""

    def __init__(self, loop: asyncio.AbstractEventLoop, target: object) -> None:
        self.__dict__.update(_loop=loop, _target=target)

    def _wrap(self, value: object) -> object:
        if isinstance(value, (list, tuple)) and type(value) in (list, tuple):
            return type(value)(map(self._wrap, value))
        return Blocking(self._loop, value) if type(value).__name__.startswith("Async") else value

    @staticmethod
    def _unwrap(value: object) -> object:
        if isinstance(value, (list, tuple)) and type(value) in (list, tuple):
            return type(value)(map(Blocking._unwrap, value))
        return value._target if isinstance(value, Blocking) else value

    def _run(self, value: object) -> object:
        if inspect.isasyncgen(value):
            return self._iterate(value)
        return self._wrap(self._loop.run_until_complete(value) if inspect.isawaitable(value) else value)

    def _iterate(self, generator: object) -> Iterator[object]:
        while True:
            try:
                yield self._loop.run_until_complete(generator.__anext__())  # type: ignore[attr-defined]
            except StopAsyncIteration:
                return

    def __getattr__(self, name: str) -> object:
        value = getattr(self._target, name)
        if not callable(value):
            return self._wrap(value)
        unwrap = self._unwrap
        return lambda *args, **named: self._run(value(*map(unwrap, args), **{key: unwrap(one) for key, one in named.items()}))

    def __setattr__(self, name: str, value: object) -> None:
        setattr(self._target, name, value)

    def __enter__(self) -> object:
        return self._run(self._target.__aenter__())

    def __exit__(self, *error: object) -> object:
        return self._run(self._target.__aexit__(*error))


@pytest.fixture(params=["sync", "async"])
def connect(request: pytest.FixtureRequest) -> Iterator[object]:
    """Makes clients: `connect(server)` or `connect(grpc, http)`, with the options of the class."""
    loop = asyncio.new_event_loop()
    made = []

    def make(server: Server | str, http: str = "127.0.0.1:1", **options: object) -> object:
        addresses = (server, http) if isinstance(server, str) else (server.grpc, server.http)
        if request.param == "sync":
            made.append(qedgix.Client(*addresses, **options))
        else:
            made.append(Blocking(loop, qedgix.AsyncClient(*addresses, **options)))
        return made[-1]

    yield make
    for client in made:
        client.close()
    loop.close()


@pytest.fixture
def client(connect, server: Server) -> object:
    """A client of the server of all tests."""
    return connect(server)
