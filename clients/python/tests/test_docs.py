"""Every code block of the documents about this package is executed."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import BINARY, ROOT

PAGES = ["docs/simulators.md", "docs/learners.md", "clients/python/README.md"]


def blocks(page: str) -> list[tuple[str, str]]:
    return re.findall(r"^```(\w*)\n(.*?)^```$", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)


def test_every_block_has_a_language_that_is_executed():
    assert {language for page in PAGES for language, _ in blocks(page)} == {"python", "sh"}


@pytest.mark.parametrize("page", PAGES)
def test_python(page, server, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "__main__"}
    # The blocks of a page continue each other.
    for language, text in blocks(page):
        if language == "python":
            text = text.replace("127.0.0.1:50051", server.grpc).replace("127.0.0.1:8080", server.http)
            exec(compile(text, page, "exec"), namespace)


@pytest.mark.parametrize("page", PAGES)
def test_shell(page, tmp_path):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "qedgix").symlink_to(BINARY)
    environment = {
        **os.environ,
        "PATH": os.pathsep.join([str(tmp_path / "bin"), str(Path(sys.executable).parent), os.environ["PATH"]]),
        # Installed elsewhere, and built with what is here.
        "PIP_TARGET": str(tmp_path / "site-packages"),
        "PIP_NO_DEPS": "1",
        "PIP_NO_BUILD_ISOLATION": "0",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        # Free ports, and data that nobody else has.
        "QEDGIX_GRPC_ADDR": "127.0.0.1:0",
        "QEDGIX_HTTP_ADDR": "127.0.0.1:0",
        "QEDGIX_DATA_DIR": str(tmp_path / "data"),
    }
    for language, text in blocks(page):
        if language != "sh":
            continue
        # Files of the build go elsewhere, and the server is the one that is tested.
        text = text.replace("target/release/qedgix", str(BINARY)).replace(
            "--wheel-dir dist", f"--wheel-dir {tmp_path / 'dist'}"
        )
        running = subprocess.Popen(["bash", "-ec", text], env=environment, cwd=ROOT, start_new_session=True)
        if text.startswith("qedgix serve"):
            while not (tmp_path / "data" / "endpoints.json").exists():
                assert running.poll() is None
                time.sleep(0.02)
            os.killpg(running.pid, signal.SIGTERM)
        assert running.wait() == 0, text
    installed = Path(environment["PIP_TARGET"]) / "qedgix"
    assert (installed / "py.typed").exists() and (installed / "v1" / "policy_pb2.pyi").exists()
