"""Calls with retries, over gRPC and REST."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import replace
from time import monotonic
from typing import TYPE_CHECKING, Any, cast

import grpc

from .._settings import Retry, Settings
from .._values import plain, whole
from ..errors import DeadlineExceeded, NotFound, QedgixError, Unavailable, from_grpc, from_http, invalid
from ._platform import Channel, HttpClient, RawStream, open_channel, sleep

if TYPE_CHECKING:
    import httpx


class Method:
    """A method of gRPC."""

    def __init__(self, path: str, request: Any, response: Any) -> None:
        self.path = path
        self.request = request
        self.response = response


class AsyncTransport:
    """The connections of a client. Both are opened when they are first used."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._retry: Retry = settings.retry
        self._metadata = settings.metadata
        self._channel: Channel | None = None
        self._calls: dict[Method, Any] = {}
        self._http: HttpClient | None = None
        # Threads that use a client for the first time at once open one connection. Nothing waits while it is held.
        self._opening = threading.Lock()

    async def call(
        self,
        method: Method,
        request: Any,
        timeout: float | None = None,
        *,
        gone: type[NotFound] | None = None,
    ) -> Any:
        """Calls a method, and again while `Retry` says so. With `gone`, a repeated call that finds nothing returns None.

        Raises:
            QedgixError: the last failure.
        """
        call = self._calls.get(method) or self._bind(method)
        deadline = self.settings.deadline(timeout)
        attempt = 1
        while True:
            remaining = deadline - monotonic()
            if remaining <= 0:
                raise DeadlineExceeded(f"{self.settings.grpc_peer}: the deadline has passed", code="deadline_exceeded")
            try:
                return await call(request, timeout=self._retry.limit(remaining), metadata=self._metadata)
            except grpc.RpcError as error:
                failure = await self.failure(error)
            if attempt > 1 and gone and isinstance(failure, gone):
                return None
            wait = self._retry.wait(failure, attempt, deadline - monotonic())
            if wait is None:
                raise failure
            await sleep(wait)
            attempt += 1

    async def failure(self, error: grpc.RpcError) -> QedgixError:
        """The exception of a call that failed."""
        failure = from_grpc(error, self.settings.grpc_peer)
        # There was no connection of HTTP/2; a server of REST has one of HTTP/1.1.
        if "failed to connect to all addresses" in failure.message and await self._is_rest():
            expected = "the address of gRPC (`--grpc-addr` of `qedgix serve`); this is that of REST"
            return invalid("grpc", self.settings.target, expected)
        return failure

    async def _is_rest(self) -> bool:
        """Whether the address of gRPC is that of REST."""
        import httpx

        url = self.settings.grpc_url
        tls = self.settings.tls() if url.startswith("https:") else False
        try:
            async with HttpClient(base_url=url, verify=tls, timeout=3.0, trust_env=False) as http:
                response = await http.get("/livez")
        except (httpx.TransportError, OSError):
            return False
        return bool(response.is_success)

    async def _is_grpc(self) -> bool:
        """Whether the address of REST is that of gRPC."""
        channel = open_channel(replace(self.settings, grpc_url=self.settings.http_url))
        check: Any = channel.unary_unary("/grpc.health.v1.Health/Check")
        try:
            await check(b"", timeout=3.0, metadata=self._metadata)
        except grpc.RpcError as error:
            # A server that requires a key may say so.
            return from_grpc(error, "").code == "unauthenticated"
        finally:
            await channel.close()
        return True

    async def http_failure(self, error: Exception) -> QedgixError:
        """The exception of a request of REST to which there was no response."""
        import httpx

        if isinstance(error, httpx.TimeoutException):
            message = f"{self.settings.http_peer}: {str(error) or 'no answer in time'}"
            return DeadlineExceeded(message, code="deadline_exceeded")
        # The first line of a response of HTTP/2 is none of HTTP/1.1, as that of TLS.
        illegal = isinstance(error, httpx.RemoteProtocolError) and "illegal" in str(error)
        if illegal and await self._is_grpc():
            expected = "the address of REST (`--http-addr` of `qedgix serve`); this is that of gRPC"
            return invalid("http", self.settings.http_target, expected)
        return Unavailable(f"{self.settings.http_peer}: {str(error) or type(error).__name__}", code="unavailable")

    def _bind(self, method: Method) -> Any:
        call = self._open_channel().unary_unary(
            method.path,
            request_serializer=method.request.SerializeToString,
            response_deserializer=method.response.FromString,
        )
        self._calls[method] = call
        return call

    def _open_channel(self) -> Channel:
        with self._opening:
            if self._channel is None:
                self._channel = open_channel(self.settings)
            return self._channel

    def open_stream(self, method: Method) -> RawStream:
        """Opens a bidirectional call."""
        call = self._calls.get(method)
        if call is None:
            call = self._calls[method] = self._open_channel().stream_stream(
                method.path,
                request_serializer=method.request.SerializeToString,
                response_deserializer=method.response.FromString,
            )
        return RawStream(call, self._metadata)

    @property
    def http(self) -> HttpClient:
        """The client of REST."""
        with self._opening:
            if self._http is None:
                self._http = HttpClient(
                    base_url=self.settings.http_url,
                    headers=dict(self._metadata),
                    verify=self.settings.tls(),
                    timeout=self.settings.timeout,
                )
            return self._http

    async def request(
        self,
        method: str,
        path: str,
        *,
        repeatable: bool = True,
        timeout: float | None = None,
        headers: Mapping[str, str] | None = None,
        params: Mapping[str, Any] | None = None,
        json: Any = None,
        content: Callable[[], AsyncIterator[bytes]] | None = None,
    ) -> httpx.Response:
        """Sends a request, and again while `Retry` says so. A request that is not `repeatable` is sent again only if the
        server cannot have seen it, or says that it has done nothing. `content` makes the body of an attempt.

        Raises:
            QedgixError: the last failure.
        """
        import httpx

        deadline = self.settings.deadline(timeout)
        body = plain("", json)
        given = {name: value for name, value in (params or {}).items() if value is not None}
        attempt = 1
        while True:
            limit = self._retry.limit(deadline - monotonic())
            failure: QedgixError
            again = True
            try:
                response = await self.http.request(
                    method,
                    path,
                    params=given,
                    headers=headers,
                    json=body,
                    content=content() if content else None,
                    timeout=max(limit, 0.001),
                )
            except httpx.TimeoutException as error:
                failure = await self.http_failure(error)
                again = repeatable or isinstance(error, httpx.ConnectTimeout)
            except (httpx.TransportError, OSError) as error:
                failure = await self.http_failure(error)
                again = repeatable or isinstance(error, httpx.ConnectError)
            else:
                if response.is_success or (attempt > 1 and method == "DELETE" and response.status_code == 404):
                    return response
                failure = from_http(response)
                again = repeatable or response.status_code in (429, 503, 507)
            wait = self._retry.wait(failure, attempt, deadline - monotonic()) if again else None
            if wait is None:
                raise failure
            await sleep(wait)
            attempt += 1

    async def json(self, method: str, path: str, **options: Any) -> dict[str, Any]:
        """The JSON object that a request returns."""
        response = await self.request(method, path, **options)
        return cast("dict[str, Any]", response.json())

    async def pages(self, path: str, items: str, *, limit: int | None = None, **params: Any) -> list[dict[str, Any]]:
        """All items of a list, or the first `limit` (from 1), page by page."""
        if limit is not None:
            limit = whole("limit", limit, 1, 2**63 - 1)
            params["page_size"] = min(limit, 1000)
        found: list[dict[str, Any]] = []
        token = None
        while True:
            page = await self.json("GET", path, params={**params, "page_token": token})
            found += page[items]
            token = page["next_page_token"]
            if not token or (limit is not None and len(found) >= limit):
                return found[:limit]

    async def close(self) -> None:
        """Closes the connections."""
        if self._channel is not None:
            await self._channel.close()
        if self._http is not None:
            await self._http.aclose()
        self._channel = self._http = None
        self._calls.clear()
