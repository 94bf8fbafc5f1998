"""Policies, their versions and their aliases."""

from __future__ import annotations

import builtins
import os
from collections.abc import AsyncIterator
from pathlib import Path
from urllib.parse import quote

from .._files import replace_file
from .._progress import UploadBar
from .._values import text
from ..errors import invalid
from ..results import AliasMove, Policy, PolicyRef, PolicyVersion, given_instant
from .transport import AsyncTransport

# Bytes that are sent at once.
_PART = 64 * 1024


class AsyncPolicies:
    """The policies of a server, as `client.policies`.

    A policy is named NAME (its newest version), NAME@ALIAS or NAME:VERSION. Every method raises NotFound if there is no such
    policy, version or alias, and PermissionDenied if the API key does not allow the operation.
    """

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport

    async def list(self) -> list[Policy]:
        """All policies by name, each in its newest version."""
        return [Policy.of(one) for one in await self._transport.pages("/v1/policies", "policies")]

    async def get(self, policy: str) -> Policy:
        """A policy version."""
        return Policy.of(await self._transport.json("GET", _path(policy)))

    async def versions(self, name: str) -> builtins.list[PolicyVersion]:
        """All versions of a policy, newest first."""
        rows = await self._transport.pages(_path(name, "versions"), "versions")
        return [PolicyVersion(PolicyRef(**row["ref"]), row["loaded"], row["aliases"]) for row in rows]

    async def upload(
        self,
        name: str,
        checkpoint: bytes | str | os.PathLike[str],
        *,
        alias: str | None = None,
        progress: bool = False,
        timeout: float | None = None,
    ) -> Policy:
        """Publishes a checkpoint as the next version of a policy; identical bytes return the existing version.

        Args:
            name: NAME of the policy.
            checkpoint: a safetensors file, or its bytes.
            alias: an alias to point to the version.
            progress: whether to show a bar with tqdm, if tqdm is installed.
            timeout: seconds for all attempts. Default: that of the client.

        Raises:
            InvalidArgument: it is no checkpoint.
            TooLarge: it is larger than the server accepts.
        """
        if not isinstance(checkpoint, (bytes, str, os.PathLike)):
            raise invalid("checkpoint", type(checkpoint).__name__, "bytes, or the path of a file")
        content = checkpoint if isinstance(checkpoint, bytes) else Path(checkpoint).read_bytes()
        with UploadBar(name, len(content), enabled=progress) as bar:
            document = await self._transport.json(
                "POST",
                _path(name, "versions"),
                content=lambda: _parts(content, bar),
                headers={"content-type": "application/octet-stream", "content-length": str(len(content))},
                params={"alias": alias},
                timeout=timeout,
            )
        return Policy.of(document)

    async def publish(self, name: str, checkpoint_id: str, *, alias: str | None = None) -> Policy:
        """Publishes a checkpoint of a job as the next version of a policy."""
        body = {"checkpoint_id": checkpoint_id}
        return Policy.of(await self._transport.json("POST", _path(name, "versions"), json=body, params={"alias": alias}))

    async def export(self, policy: str, path: str | os.PathLike[str], *, timeout: float | None = None) -> Path:
        """Writes the checkpoint of a version to a safetensors file, which appears complete or not at all.

        Raises:
            FailedPrecondition: `no_checkpoint`: the policy is a baseline.
            Internal: the bytes do not have their digest.
        """
        response = await self._transport.request("GET", _path(policy, "export"), timeout=timeout)
        return replace_file(path, response.content, response.headers["etag"].strip('"'))

    async def delete(self, name: str, version: int | None = None) -> None:
        """Deletes a version, or all versions of a policy.

        Raises:
            FailedPrecondition: an alias points to it, a session uses it, or it is bundled with the server.
        """
        path = _path(name) if version is None else _path(name, "versions", str(version))
        await self._transport.request("DELETE", path)

    async def load(self, policy: str) -> Policy:
        """Loads all versions of NAME, or NAME:VERSION."""
        return Policy.of(await self._transport.json("POST", _path(policy, "load")))

    async def unload(self, policy: str) -> Policy:
        """Unloads all versions of NAME, or NAME:VERSION: requests are refused until it is loaded, open sessions continue."""
        return Policy.of(await self._transport.json("POST", _path(policy, "unload")))

    async def aliases(self, name: str) -> dict[str, int]:
        """The version that each alias of a policy points to."""
        rows = await self._transport.pages(_path(name, "aliases"), "aliases")
        return {row["alias"]: row["version"] for row in rows}

    async def set_alias(self, name: str, alias: str, version: int, *, expected: int | None = None) -> int | None:
        """Points an alias to a version, for all requests at once. Returns the version that it pointed to before.

        Args:
            name: NAME of the policy.
            alias: the alias; it is made if it does not exist.
            version: the version.
            expected: move it only if it points to this version now; 0: only if it does not exist.

        Raises:
            FailedPrecondition: `alias_moved`: it points to another version than expected.
        """
        body = {"version": version, "expected": expected}
        # With `expected`, a repetition of a move that has happened would be refused.
        repeatable = expected is None
        moved = await self._transport.json("PUT", _path(name, "aliases", alias), json=body, repeatable=repeatable)
        previous: int | None = moved["previous"]
        return previous

    async def delete_alias(self, name: str, alias: str, *, expected: int | None = None) -> None:
        """Deletes an alias, with `expected` only if it points to this version.

        Raises:
            FailedPrecondition: `alias_moved`: it points to another version than expected.
        """
        await self._transport.request("DELETE", _path(name, "aliases", alias), params={"expected": expected})

    async def history(self, name: str, alias: str | None = None) -> builtins.list[AliasMove]:
        """All moves of the aliases of a policy, or of one alias, newest first."""
        rows = await self._transport.pages(_path(name, "history"), "history", alias=alias)
        return [AliasMove(row["alias"], row["version"], row["previous"], given_instant(row["at"]), row["by"]) for row in rows]


async def _parts(content: bytes, bar: UploadBar) -> AsyncIterator[bytes]:
    """The parts of an upload, for one attempt."""
    bar.restart()
    for start in range(0, len(content), _PART):
        part = content[start : start + _PART]
        yield part
        bar.add(len(part))


def _path(*parts: str) -> str:
    return "/v1/policies/" + "/".join(quote(text("policy", part), safe="@:") for part in parts)
