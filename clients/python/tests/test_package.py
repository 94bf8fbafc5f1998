"""The package itself: generated files are current, types are sound, and every public name is documented."""

from __future__ import annotations

import inspect
import subprocess
import sys
from pathlib import Path

import qedgix

HERE = Path(__file__).resolve().parents[1]


def test_generated_files_are_current():
    subprocess.run([sys.executable, HERE / "generate", "--check"], check=True)


def test_types():
    # The cache makes later runs short.
    command = [sys.executable, "-m", "mypy", "--cache-dir", str(Path(sys.prefix) / "mypy")]
    checked = subprocess.run(command, cwd=HERE, capture_output=True, text=True)
    assert checked.returncode == 0, checked.stdout


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
