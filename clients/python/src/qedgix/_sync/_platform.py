"""Connections, streams and sleep with threads. `_async/_platform.py` is the same with asyncio."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Sequence
from typing import Any

import grpc
import httpx

from .._settings import CHANNEL_OPTIONS, Settings

Channel = grpc.Channel
HttpClient = httpx.Client
sleep = time.sleep


def open_channel(settings: Settings) -> Channel:
    """Opens a gRPC channel, which connects at its first call."""
    credentials = settings.credentials()
    if credentials is None:
        return grpc.insecure_channel(settings.target, options=CHANNEL_OPTIONS)
    return grpc.secure_channel(settings.target, credentials, options=CHANNEL_OPTIONS)


class RawStream:
    """A bidirectional call: messages go out and come in on their own."""

    def __init__(self, call: Any, metadata: Sequence[tuple[str, str]]) -> None:
        self._requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._responses: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._call = call(iter(self._requests.get, None), metadata=metadata)
        # Reading a call has no time limit of its own, so a thread reads, and a queue is read with a limit.
        threading.Thread(target=self._receive, name="qedgix-stream", daemon=True).start()

    def _receive(self) -> None:
        try:
            for message in self._call:
                self._responses.put(message)
            self._responses.put(EOFError())
        except grpc.RpcError as error:
            self._responses.put(error)
        # Ends the thread of grpc that waits for requests.
        self._requests.put(None)

    def write(self, message: Any) -> None:
        """Sends a message. If the stream has failed, `read` tells."""
        self._requests.put(message)

    def read(self, timeout: float) -> Any:
        """Waits for the next message for at most `timeout` seconds.

        Raises:
            grpc.RpcError: the stream has failed.
            EOFError: the stream has ended.
            TimeoutError: there was no message.
        """
        try:
            message = self._responses.get(timeout=max(timeout, 0.0))
        except queue.Empty:
            raise TimeoutError from None
        if isinstance(message, BaseException):
            raise message
        return message

    def close(self) -> None:
        """Ends the stream."""
        self._requests.put(None)
        self._call.cancel()
