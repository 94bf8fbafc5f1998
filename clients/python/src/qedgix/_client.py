"""What the synchronous and the asynchronous client have in common: how they reach a server."""

from __future__ import annotations

import ipaddress
import json
import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from ._settings import Retry, Settings
from .errors import invalid

if TYPE_CHECKING:
    from typing_extensions import Self


class BaseClient:
    """A client of one server."""

    def __init__(
        self,
        grpc: str = "127.0.0.1:50051",
        http: str = "127.0.0.1:8080",
        *,
        api_key: str | None = None,
        ca_cert: str | os.PathLike[str] | None = None,
        client_cert: str | os.PathLike[str] | None = None,
        client_key: str | os.PathLike[str] | None = None,
        timeout: float = 30.0,
        retry: Retry | None = None,
    ) -> None:
        """Connections are opened when they are first used, and kept.

        Args:
            grpc: address of gRPC, HOST:PORT or a URL: sessions, `act`, environments.
            http: address of REST, HOST:PORT or a URL: `jobs` and `policies`.
            api_key: an API key. Default: the environment variable QEDGIX_API_KEY.
            ca_cert: certificate authorities to trust (PEM), which means TLS. Default: QEDGIX_CA_CERT, or those of the machine for
                addresses that begin with https://.
            client_cert: client certificate (PEM). Default: QEDGIX_CLIENT_CERT.
            client_key: private key of the client certificate (PEM). Default: QEDGIX_CLIENT_KEY.
            timeout: seconds that a call may take with all its attempts. Every call can set its own.
            retry: when calls are repeated.

        Raises:
            InvalidArgument: an address is not one.
        """
        authorities = _file(ca_cert, "QEDGIX_CA_CERT")
        certificate = _file(client_cert, "QEDGIX_CLIENT_CERT")
        key = _file(client_key, "QEDGIX_CLIENT_KEY")
        if (certificate is None) != (key is None):
            raise invalid("client_cert", certificate, "both client_cert and client_key, or neither")
        scheme = "https" if authorities or certificate else "http"
        secret = api_key if api_key is not None else os.environ.get("QEDGIX_API_KEY")
        settings = Settings(
            grpc_url=_url("grpc", grpc, scheme),
            http_url=_url("http", http, scheme),
            api_key=secret.strip() if secret else None,
            ca_cert=authorities,
            client_cert=certificate,
            client_key=key,
            timeout=timeout,
            retry=retry or Retry(),
        )
        if settings.api_key and any(_readable_by_others(url) for url in (settings.grpc_url, settings.http_url)):
            warnings.warn("the API key is sent to another machine without encryption; use https://", stacklevel=2)
        self._begin(settings)

    def _begin(self, settings: Settings) -> None:
        raise NotImplementedError

    @classmethod
    def of_data_dir(cls, data_dir: str | os.PathLike[str] = "qedgix-data", **options: Any) -> Self:
        """A client of the server on this machine that uses a data directory: its addresses are in `endpoints.json`.

        Args:
            data_dir: `--data-dir` of the server.
            options: as for the class.

        Raises:
            FileNotFoundError: no server runs on this directory.
        """
        endpoints = json.loads((Path(data_dir) / "endpoints.json").read_text())
        return cls(endpoints["grpc"], endpoints["http"], **options)


def _file(given: str | os.PathLike[str] | None, variable: str) -> Path | None:
    found = given if given is not None else os.environ.get(variable)
    return Path(found) if found else None


def _url(field: str, address: str, scheme: str) -> str:
    """`http://HOST:PORT` or `https://HOST:PORT`."""
    expected = "HOST:PORT, http://HOST:PORT or https://HOST:PORT"
    if not isinstance(address, str):
        raise invalid(field, repr(address), expected)
    text = address if "://" in address else f"{scheme}://{address}"
    try:
        parts = urlsplit(text)
        complete = parts.port is not None
    except ValueError:
        raise invalid(field, address, expected) from None
    if parts.scheme not in ("http", "https") or not parts.hostname or not complete or parts.path.strip("/"):
        raise invalid(field, address, expected)
    return f"{parts.scheme}://{parts.netloc}"


def _readable_by_others(url: str) -> bool:
    host = urlsplit(url).hostname or ""
    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError:
        local = host == "localhost"
    return url.startswith("http:") and not local
