"""The package itself: generated files are current, types are sound, and every public name is documented."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path

from conftest import BINARY

import qedgix

HERE = Path(__file__).resolve().parents[1]


def test_generated_files_are_current():
    subprocess.run([sys.executable, HERE / "generate", "--check"], check=True)


def test_types():
    # The cache makes later runs short.
    command = [sys.executable, "-m", "mypy", "--cache-dir", str(Path(sys.prefix) / "mypy")]
    checked = subprocess.run(command, cwd=HERE, capture_output=True, text=True)
    assert checked.returncode == 0, checked.stdout


def test_a_wheel_can_carry_the_server(tmp_path):
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(tmp_path), str(HERE)]
    subprocess.run(pip + build, env={**os.environ, "QEDGIX_WHEEL_SERVER": str(BINARY)}, check=True)
    [wheel] = tmp_path.glob("*.whl")
    assert wheel.name.startswith("qedgix-") and "-py3-none-" in wheel.name and not wheel.name.endswith("-any.whl")
    prefix = tmp_path / "prefix"
    subprocess.run(
        [*pip, "install", "--no-deps", "--no-index", "--ignore-installed", "--prefix", str(prefix), str(wheel)], check=True
    )
    [command] = prefix.rglob("bin/qedgix")
    told = subprocess.run([command, "--version"], check=True, capture_output=True, text=True).stdout
    assert told.startswith("qedgix ")
    assert list(prefix.rglob("qedgix/py.typed"))
    missing = subprocess.run(
        pip + build, env={**os.environ, "QEDGIX_WHEEL_SERVER": "nowhere"}, capture_output=True, check=False
    )
    assert missing.returncode != 0


def public(owner):
    for name in dir(owner) if inspect.isclass(owner) else owner.__all__:
        if not name.startswith("_"):
            yield name, inspect.getattr_static(owner, name) if inspect.isclass(owner) else getattr(owner, name)


def test_every_public_name_has_a_docstring():
    missing = []
    for name, value in public(qedgix):
        if not inspect.isclass(value):
            continue
        missing += [] if value.__doc__ else [name]
        for method, body in public(value):
            body = getattr(body, "func", body)
            written_here = getattr(inspect.unwrap(getattr(body, "fget", None) or body), "__module__", "").startswith("qedgix")
            if written_here and (inspect.isroutine(body) or isinstance(body, property)) and not inspect.getdoc(body):
                missing.append(f"{name}.{method}")
    assert missing == []


def test_the_synchronous_client_has_what_the_asynchronous_one_has():
    for name in [name for name in qedgix.__all__ if name.startswith("Async")]:
        twin = getattr(qedgix, name.removeprefix("Async"))
        assert {one for one, _ in public(getattr(qedgix, name))} == {one for one, _ in public(twin)}
