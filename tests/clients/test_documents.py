"""Every code block of every document is executed, in a fresh directory, as its reader would: README.md is followed literally.

- `sh` blocks of a page run one after another in one shell, beside a server of their own on free ports. A command that fails, and a
  response of `curl` with an error status, fail the test. `cargo run` and `cargo install` stand for the program that is tested.
- `python` blocks of a page continue each other. `json` blocks are parsed, `toml` blocks are experiments. Blocks without a
  language are output.
- Commands within a line of text, and in tables, name commands and flags that exist.

A comment of HTML before a block, which readers do not see, changes what is executed:

    <!-- test: before COMMAND -->     runs COMMAND before the block
    <!-- test: replace A => B -->     replaces text of the block, such as a number of steps that takes hours
    <!-- test: skip REASON -->        does not execute the block
"""

from __future__ import annotations

import functools
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from documents import ROOT, Block, blocks

BINARY = Path(os.environ.get("QEDGIX_BIN", ROOT / "target" / "release" / "qedgix")).resolve()
PAGES = sorted(
    str(path.relative_to(ROOT))
    for pattern in ("*.md", "docs/*.md", "clients/*/README.md", "packaging/*.md")
    for path in ROOT.glob(pattern)
)
LANGUAGES = {"sh", "python", "json", "toml", ""}


# Programs that the blocks call. They come first on the PATH.
QEDGIX = """#!/usr/bin/env bash
case ${1-} in
    serve) exec serve-once "$@" ;;
    jobs | policies | server) export QEDGIX_SERVER=${QEDGIX_SERVER-$PAGE_HTTP} ;;
esac
exec BINARY "$@"
"""
SERVE = """#!/usr/bin/env bash
# Starts a server with the flags of the block on free ports, waits until it is ready, and stops it.
set -euo pipefail
data=${QEDGIX_DATA_DIR:-qedgix-data}
for ((i = 1; i < $#; i++)); do
    [ "${!i}" != --data-dir ] || { next=$((i + 1)); data=${!next}; }
done
rm -f "$data/endpoints.json"
QEDGIX_GRPC_ADDR=127.0.0.1:0 QEDGIX_HTTP_ADDR=127.0.0.1:0 BINARY "$@" &
server=$!
until [ -s "$data/endpoints.json" ]; do kill -0 $server; sleep 0.05; done
kill $server
wait $server
"""
CARGO = """#!/usr/bin/env bash
# What cargo would build is here already.
case "$1 ${2-} ${3-}" in
    'run --release --') shift 3; exec qedgix "$@" ;;
    'install --locked --path' | 'build --release '*) ;;
    *) echo "cargo $*: not in a document's test" >&2; exit 1 ;;
esac
"""
CURL = """#!/usr/bin/env bash
exec REAL --fail-with-body "$@"
"""


class Desk:
    """A fresh directory with what a checkout has, programs on the PATH, and a running server."""

    def __init__(self, directory: Path) -> None:
        self.here = directory / "qedgix"
        self.here.mkdir()
        for name in ("clients", "experiments", "proto", "packaging"):
            if (ROOT / name).exists():
                ignored = shutil.ignore_patterns("node_modules", "__pycache__", "*.egg-info", "dist")
                shutil.copytree(ROOT / name, self.here / name, ignore=ignored)
        for name in ("README.md", "LICENSE", "Cargo.toml"):
            shutil.copy(ROOT / name, self.here)
        release = self.here / "target" / "release"
        release.mkdir(parents=True)
        (release / "qedgix").symlink_to(BINARY)
        programs = directory / "bin"
        programs.mkdir()
        curl = shutil.which("curl")
        assert curl, "the documents use curl"
        for name, text in {"qedgix": QEDGIX, "serve-once": SERVE, "cargo": CARGO, "curl": CURL.replace("REAL", curl)}.items():
            (programs / name).write_text(text.replace("BINARY", str(BINARY)))
            (programs / name).chmod(0o755)
        tools = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "tools" / "bin"
        self.log = open(directory / "server.log", "wb")
        self.data = directory / "server"
        self.server = subprocess.Popen(
            [BINARY, "serve", "--grpc-addr", "127.0.0.1:0", "--http-addr", "127.0.0.1:0", "--data-dir", self.data, "--cpu-budget", "2"],
            stdout=self.log,
            stderr=self.log,
        )
        while not (self.data / "endpoints.json").exists():
            assert self.server.poll() is None, (directory / "server.log").read_text()
            time.sleep(0.02)
        self.addresses = json.loads((self.data / "endpoints.json").read_text())
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("QEDGIX_")},
            "PATH": os.pathsep.join([str(programs), str(Path(sys.executable).parent), os.environ["PATH"], str(tools)]),
            "PAGE_HTTP": self.addresses["http"],
            # Python packages are installed beside the others, and built with what is here.
            "PIP_TARGET": str(directory / "site-packages"),
            "PIP_NO_DEPS": "1",
            "PIP_NO_BUILD_ISOLATION": "0",
            "PIP_DISABLE_PIP_VERSION_CHECK": "1",
            "NO_COLOR": "1",
        }

    def here_addresses(self, text: str) -> str:
        """The addresses of the documents become those of this server; a server that a block starts takes free ports."""
        text = text.replace("127.0.0.1:50051", self.addresses["grpc"]).replace("127.0.0.1:8080", self.addresses["http"])
        return re.sub(r"\b(0\.0\.0\.0|127\.0\.0\.1):(50051|8080)\b", r"\1:0", text)

    def run(self, script: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["bash", "-c", script], cwd=self.here, env=self.environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )

    def stop(self) -> None:
        self.server.terminate()
        self.server.wait()
        self.log.close()


@pytest.fixture
def desk(tmp_path):
    made = Desk(tmp_path)
    yield made
    made.stop()


def of(page: str, *languages: str) -> list[Block]:
    return [block for block in blocks(page) if block.language in languages and block.skipped is None]


def test_every_block_has_a_language_that_is_executed():
    unknown = [(block.page, block.line) for page in PAGES for block in blocks(page) if block.language not in LANGUAGES]
    assert not unknown


@pytest.mark.parametrize("page", [page for page in PAGES if of(page, "sh", "toml")])
def test_commands(page, desk):
    script = ["set -eEo pipefail", "trap 'echo \"FAILED: $at: $BASH_COMMAND\"' ERR"]
    for number, block in enumerate(of(page, "sh", "toml")):
        script.append(f"at={page}:{block.line}; cd '{desk.here}'")
        script += map(desk.here_addresses, block.before)
        text = desk.here_addresses(block.text)
        if block.language == "toml":
            (desk.here / f"experiment-{number}.toml").write_text(text)
            text = f"qedgix experiment experiment-{number}.toml --dry-run\n"
        script.append(text)
    done = desk.run("\n".join(script))
    assert done.returncode == 0, done.stdout[-6000:]


@pytest.mark.parametrize("page", [page for page in PAGES if of(page, "python")])
def test_python(page, desk):
    before = [desk.here_addresses(command) for block in of(page, "python") for command in block.before]
    done = desk.run("\n".join(["set -eE", f"cd '{desk.here}'", *before]))
    assert done.returncode == 0, done.stdout
    program = "\n".join(desk.here_addresses(block.text) for block in of(page, "python"))
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=desk.here, text=True, capture_output=True, env=dict(desk.environment, PYTHONDONTWRITEBYTECODE="1")
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", [page for page in PAGES if of(page, "json")])
def test_json(page):
    for block in of(page, "json"):
        json.loads(block.text)


@functools.cache
def usage(*command: str) -> str:
    done = subprocess.run([BINARY, *command, "--help"], text=True, capture_output=True)
    return done.stdout if done.returncode == 0 else ""


def commands_within_text(page: str) -> list[str]:
    """What stands between backquotes, outside of blocks, and begins with `qedgix `. A command may go on in the next line."""
    text = re.sub(r"^\s*```.*?^\s*```$", "", (ROOT / page).read_text(), flags=re.MULTILINE | re.DOTALL)
    return [" ".join(found.split()) for found in re.findall(r"`((?:[A-Z_]+=\S+ )*qedgix\s[^`]*)`", text)]


@pytest.mark.parametrize("page", [page for page in PAGES if page != "CHANGELOG.md" and commands_within_text(page)])
def test_commands_within_text(page):
    for line in commands_within_text(page):
        words = line[line.index("qedgix") :].split()[1:]
        command = []
        while words and re.fullmatch(r"[a-z]+", words[0]) and usage(*command, words[0]):
            command.append(words.pop(0))
        assert command or words[0] == "COMMAND" or words[0].startswith("--"), f"{page}: {line}: no such command"
        known = usage(*command)
        for flag in re.findall(r"(?<!\S)--[a-z][a-z0-9-]*", " ".join(words)):
            assert re.search(rf"{flag}\b(?!-)", known), f"{page}: {line}: no flag {flag}"
