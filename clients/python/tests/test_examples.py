"""Every example runs as its reader would run it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import qedgix

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def run(name: str, *arguments: str, cwd: Path) -> str:
    done = subprocess.run([sys.executable, EXAMPLES / name, *arguments], cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"mean AoI (\d+\.\d+)", text)]


def test_every_example_is_tested():
    text = Path(__file__).read_text()
    assert [path.name for path in EXAMPLES.glob("*.py") if f'"{path.name}"' not in text] == []


def test_simulator(server, tmp_path):
    learned = numbers(run("simulator.py", server.grpc, cwd=tmp_path))
    random = numbers(run("simulator.py", server.grpc, "--policy", "random", cwd=tmp_path))
    assert len(learned) == len(random) == 5
    assert sum(learned) < sum(random) / 2
    assert (EXAMPLES / "simulator.py").read_text().count("\n") <= 42


def test_metric_simulator(server, tmp_path):
    for policy in ["qedgix", "sweep"]:
        (mean,) = numbers(run("metric_simulator.py", server.grpc, "--policy", policy, cwd=tmp_path))
        assert mean < 320, policy


@pytest.mark.parametrize("policy", ["qedgix", "qmix", "qedgix-paper", "sweep-shared"])
def test_decentral(server, tmp_path, policy):
    arguments = [server.grpc, "--policy", policy, "--layouts", "2", "--slots", "30", "--kill"]
    assert run("decentral.py", *arguments, cwd=tmp_path).startswith("60 of 60 slots as the joint Act, bit for bit; 6 processes")


def test_training_job(server, tmp_path):
    arguments = [server.grpc, server.http, "--name", "example", "--steps", "4000"]
    told = run("training_job.py", *arguments, cwd=tmp_path)
    assert len(numbers(told)) >= 3 and "example:" in told
    assert (tmp_path / "my-policy.safetensors").stat().st_size > 0
    with qedgix.Client(server.grpc, server.http) as client:
        assert client.policies.aliases("example") == {"live": 1}


def test_learner(server, tmp_path):
    before, after = numbers(run("learner.py", server.grpc, "--iterations", "8", "--candidates", "64", cwd=tmp_path))[-2:]
    assert after < before / 2


@pytest.fixture(autouse=True)
def _no_bytecode(monkeypatch):
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
