"""Connections, streams and sleep with asyncio. `_sync/_platform.py` is the same without."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from typing import Any

import grpc
import grpc.aio
import httpx

from .._settings import CHANNEL_OPTIONS, Settings

Channel = grpc.aio.Channel
HttpClient = httpx.AsyncClient
sleep = asyncio.sleep


def open_channel(settings: Settings) -> Channel:
    """Opens a gRPC channel, which connects at its first call."""
    credentials = settings.credentials()
    if credentials is None:
        return grpc.aio.insecure_channel(settings.target, options=CHANNEL_OPTIONS)
    return grpc.aio.secure_channel(settings.target, credentials, options=CHANNEL_OPTIONS)


class RawStream:
    """A bidirectional call: messages go out and come in on their own."""

    def __init__(self, call: Any, metadata: Sequence[tuple[str, str]]) -> None:
        self._call = call(metadata=metadata)

    async def write(self, message: Any) -> None:
        """Sends a message. If the stream has failed, `read` tells."""
        with contextlib.suppress(grpc.RpcError, asyncio.InvalidStateError):
            await self._call.write(message)

    async def read(self, timeout: float) -> Any:
        """Waits for the next message for at most `timeout` seconds.

        Raises:
            grpc.RpcError: the stream has failed.
            EOFError: the stream has ended.
            TimeoutError: there was no message.
        """
        try:
            message = await asyncio.wait_for(self._call.read(), timeout)
        except asyncio.TimeoutError:
            raise TimeoutError from None
        if message is grpc.aio.EOF:
            raise EOFError
        return message

    async def close(self) -> None:
        """Ends the stream."""
        self._call.cancel()
