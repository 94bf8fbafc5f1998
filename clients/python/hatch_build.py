"""Puts the server into the wheel: with QEDGIX_WHEEL_SERVER=PATH, the wheel has this program as the command `qedgix`.

QEDGIX_WHEEL_SERVER=target/release/qedgix pip wheel --no-deps ./clients/python
"""

import os
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ServerHook(BuildHookInterface[Any]):
    """Adds the program, and the platform to the name of the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called by hatchling before it builds a wheel."""
        server = os.environ.get("QEDGIX_WHEEL_SERVER")
        if not server:
            return
        path = Path(server).resolve()
        if not os.access(path, os.X_OK):
            raise FileNotFoundError(f"QEDGIX_WHEEL_SERVER: {server} is no program")
        build_data["shared_scripts"][str(path)] = "qedgix" + path.suffix
        build_data["pure_python"] = False
        # The program needs no Python of a certain version, only the platform.
        build_data["tag"] = f"py3-none-{platform_tag()}"


def platform_tag() -> str:
    """The platform as wheels name it, such as linux_x86_64."""
    from packaging.tags import platform_tags

    return next(platform_tags())
