"""What a client knows of its server: addresses, certificates, API key, deadline and retries. `_client` makes it of arguments."""

from __future__ import annotations

import random
import ssl
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from urllib.parse import urlsplit

import grpc

from .errors import DeadlineExceeded, QedgixError, ResourceExhausted, Unavailable, invalid


@dataclass(frozen=True)
class Retry:
    """When a call that failed is sent again.

    A call is repeated if there was no connection, if the server was busy or shutting down, or if one attempt took too long,
    and only if repeating it is safe: steps, resets and submissions are numbered or named, so the server does nothing twice. All
    attempts share the deadline of the call.

    Attributes:
        attempts: maximum number of attempts, at least 1.
        initial: seconds to wait before the second attempt. The wait doubles with every attempt.
        maximum: longest wait in seconds. A longer wait that the server asks for is respected.
        attempt_timeout: seconds for one attempt; None: until the deadline. Set it on networks that lose packets.
    """

    attempts: int = 8
    initial: float = 0.05
    maximum: float = 2.0
    attempt_timeout: float | None = None

    def wait(self, failure: QedgixError, attempt: int, remaining: float) -> float | None:
        """Seconds to wait after attempt number `attempt` (from 1) failed; None: give up."""
        if attempt >= self.attempts or not isinstance(failure, (Unavailable, ResourceExhausted, DeadlineExceeded)):
            return None
        backoff = min(self.initial * 2.0 ** min(attempt - 1, 32), self.maximum) * random.uniform(0.5, 1.0)
        wait = max(backoff, failure.retry_after or 0.0)
        return wait if wait < remaining else None

    def limit(self, remaining: float) -> float:
        """Seconds for the next attempt."""
        return remaining if self.attempt_timeout is None else min(remaining, self.attempt_timeout)


@dataclass(frozen=True)
class Settings:
    """Everything that determines the connections of a client."""

    grpc_url: str
    http_url: str
    api_key: str | None
    ca_cert: Path | None
    client_cert: Path | None
    client_key: Path | None
    timeout: float
    retry: Retry

    @property
    def metadata(self) -> tuple[tuple[str, str], ...]:
        """Metadata of every gRPC call; headers of every REST request."""
        return (("authorization", f"Bearer {self.api_key}"),) if self.api_key else ()

    @property
    def grpc_peer(self) -> str:
        """Where gRPC goes, for messages."""
        return f"gRPC at {self.target} (`grpc` of the client)"

    @property
    def http_peer(self) -> str:
        """Where REST goes, for messages."""
        return f"REST at {self.http_target} (`http` of the client)"

    @property
    def http_target(self) -> str:
        """HOST:PORT of REST, for messages."""
        return urlsplit(self.http_url).netloc.rpartition("@")[2]

    def deadline(self, timeout: float | None) -> float:
        """When a call with this timeout (None: that of the client) ends, as `monotonic` counts.

        Raises:
            InvalidArgument: the timeout is no number.
        """
        seconds = self.timeout if timeout is None else timeout
        try:
            return monotonic() + seconds
        except TypeError:
            raise invalid("timeout", repr(seconds), "a number of seconds, or None") from None

    @property
    def target(self) -> str:
        """The gRPC target: HOST:PORT."""
        return urlsplit(self.grpc_url).netloc

    def credentials(self) -> grpc.ChannelCredentials | None:
        """The TLS credentials of gRPC; None: no TLS."""
        if not self.grpc_url.startswith("https:"):
            return None
        ca, key, certificate = (
            path.read_bytes() if path else None for path in (self.ca_cert, self.client_key, self.client_cert)
        )
        return grpc.ssl_channel_credentials(ca, key, certificate)

    def tls(self) -> ssl.SSLContext | bool:
        """The TLS context of REST; True: that of the machine."""
        if not (self.ca_cert or self.client_cert):
            return True
        context = ssl.create_default_context(cafile=str(self.ca_cert) if self.ca_cert else None)
        if self.client_cert:
            context.load_cert_chain(self.client_cert, self.client_key)
        return context


# Responses may be large (batches, many environments). Retries are those of `Retry`. A connection whose peer is gone is
# noticed within 40 s, also while a stream waits. A server that starts again is found within 2 s.
CHANNEL_OPTIONS: tuple[tuple[str, int], ...] = (
    ("grpc.max_receive_message_length", -1),
    ("grpc.enable_retries", 0),
    ("grpc.keepalive_time_ms", 30_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 2_000),
)
