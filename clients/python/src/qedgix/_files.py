"""Files that appear complete or not at all."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

from .errors import Internal


def replace_file(path: str | os.PathLike[str], content: bytes, sha256: str) -> Path:
    """Writes a file at once, after a check of its digest.

    Raises:
        Internal: the content does not have the digest.
        OSError: the file cannot be written.
    """
    if hashlib.sha256(content).hexdigest() != sha256:
        raise Internal("the bytes that arrived do not have the digest that the server announced", code="internal")
    target = Path(path)
    handle, part = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            os.fchmod(file.fileno(), 0o644) if hasattr(os, "fchmod") else None
        os.replace(part, target)
    except BaseException:
        os.unlink(part)
        raise
    return target
