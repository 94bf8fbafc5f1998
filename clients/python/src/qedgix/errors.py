"""Exceptions. Every error of a server has a stable `code`; each family of codes is one class.

Programs compare `code`, or catch a class. Messages are for people and may change. docs/errors.md of the server describes
every code.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import grpc

if TYPE_CHECKING:
    import httpx

    from .v1.policy_pb2 import ActError

__all__ = [
    "AlreadyExists",
    "DeadlineExceeded",
    "FailedPrecondition",
    "Internal",
    "InvalidArgument",
    "JobEnded",
    "NotFound",
    "PermissionDenied",
    "QedgixError",
    "ResourceExhausted",
    "TooLarge",
    "Unauthenticated",
    "Unavailable",
]


class QedgixError(Exception):
    """An error of a server, or of the way to it.

    Attributes:
        code: stable code, such as `wrong_step`.
        message: description for people.
        field: path of the field that is not accepted, such as `scene.users[2].aoi`; empty if the error is not about a field.
        value: the value received in the field, as text; None if there is none.
        expected: what the field accepts; None if the error is not about a field.
        limit: the limit in bytes that the request exceeds; None if there is none.
        required_scope: the scope that the API key lacks; None if there is none.
        primary: REST address of the server that takes the request, if this one is its replica (`read_only`); None otherwise.
        retry_after: seconds after which the server suggests to retry; None if it suggests nothing.
        request_id: id of the request in the log of the server; empty if the request did not reach a server.
    """

    def __init__(
        self,
        message: str,
        *,
        code: str,
        field: str = "",
        value: str | None = None,
        expected: str | None = None,
        limit: int | None = None,
        required_scope: str | None = None,
        primary: str | None = None,
        retry_after: float | None = None,
        request_id: str = "",
    ) -> None:
        super().__init__(message)
        self.message = message
        self.code = code
        self.field = field
        self.value = value
        self.expected = expected
        self.limit = limit
        self.required_scope = required_scope
        self.primary = primary
        self.retry_after = retry_after
        self.request_id = request_id

    def __str__(self) -> str:
        return f"{self.message} ({self.code})"


class InvalidArgument(QedgixError, ValueError):
    """A value is not accepted: `field`, `value` and `expected` say which and why. Sending it again does not help."""


class TooLarge(QedgixError, ValueError):
    """The request or the response is larger than a limit. `limit` has the limit of the server in bytes."""


class Unauthenticated(QedgixError):
    """The API key is missing, unknown, revoked or expired."""


class PermissionDenied(QedgixError):
    """The API key does not allow the operation. `required_scope` has the scope that it lacks."""


class NotFound(QedgixError, LookupError):
    """The policy, session, environment or job does not exist, or belongs to another owner."""


class AlreadyExists(QedgixError):
    """Something with this name exists and differs from what was asked for."""


class FailedPrecondition(QedgixError, RuntimeError):
    """The state of the resource does not allow the operation: `wrong_step`, `session_expired`, `episode_over`, and others.

    The client itself raises it before a request, with the code `not_open`: the session or the environment was never opened; or
    `failed_precondition`: the calls of a stream or an environment have another order.
    """


class ResourceExhausted(QedgixError):
    """A limit of the server is reached. The client has retried until the deadline; try later, or with less."""


class DeadlineExceeded(QedgixError, TimeoutError):
    """The deadline passed before there was an answer."""


class Unavailable(QedgixError, ConnectionError):
    """There is no connection to a server, or it cannot answer now. The client has retried until the deadline."""


class Internal(QedgixError):
    """The server failed. Its log has the cause, under `request_id`."""


class JobEnded(QedgixError):
    """A job that was waited for has failed or was cancelled.

    The code is `job_failed` or `job_cancelled`; `reason` has the cause.
    """

    def __init__(self, job_id: str, state: str, reason: str) -> None:
        super().__init__(f"job {job_id} is {state}: {reason or 'no reason'}", code=f"job_{state}")
        self.job_id = job_id
        self.state = state
        self.reason = reason


_CODES: Mapping[str, type[QedgixError]] = {
    "invalid_argument": InvalidArgument,
    "invalid_schema": InvalidArgument,
    "unsupported_media_type": InvalidArgument,
    "method_not_allowed": InvalidArgument,
    "too_large": TooLarge,
    "unauthenticated": Unauthenticated,
    "permission_denied": PermissionDenied,
    "cross_site": PermissionDenied,
    "not_found": NotFound,
    "already_exists": AlreadyExists,
    "idempotency_conflict": AlreadyExists,
    "resource_exhausted": ResourceExhausted,
    "storage_full": ResourceExhausted,
    "overloaded": ResourceExhausted,
    "deadline_exceeded": DeadlineExceeded,
    "storage_failed": Unavailable,
    "unavailable": Unavailable,
    "draining": Unavailable,
    "internal": Internal,
}

# The class and the code of a status that comes with no code: from the client's own side, a proxy, or a newer server.
# The server itself always sends a code, so a call that was cancelled or failed inside lost its connection.
_GRPC: Mapping[int, tuple[type[QedgixError], str]] = {
    1: (Unavailable, "unavailable"),
    2: (Unavailable, "unavailable"),
    3: (InvalidArgument, "invalid_argument"),
    4: (DeadlineExceeded, "deadline_exceeded"),
    5: (NotFound, "not_found"),
    6: (AlreadyExists, "already_exists"),
    7: (PermissionDenied, "permission_denied"),
    8: (TooLarge, "too_large"),
    9: (FailedPrecondition, "failed_precondition"),
    12: (InvalidArgument, "unimplemented"),
    13: (Unavailable, "unavailable"),
    14: (Unavailable, "unavailable"),
    16: (Unauthenticated, "unauthenticated"),
}
_HTTP: Mapping[int, int] = {
    400: 3,
    401: 16,
    403: 7,
    404: 5,
    405: 12,
    409: 9,
    413: 8,
    415: 12,
    422: 3,
    429: 14,
    502: 14,
    503: 14,
    504: 4,
    507: 14,
}


def family(code: str, status: int = 13) -> type[QedgixError]:
    """The class of an error code. `status` is the gRPC status, which decides for codes that this version does not know."""
    known = _CODES.get(code)
    return known or (Internal if status == 13 else _GRPC.get(status, (Internal, ""))[0])


def from_grpc(error: grpc.RpcError, peer: str) -> QedgixError:
    """The exception of a call that failed. `peer` says in an error that no server has sent where the call went."""
    # Every error of a call is also the call, which has these methods.
    call: Any = error
    status: int = call.code().value[0]
    metadata = dict(_texts(call.trailing_metadata()))
    code = metadata.get("qedgix-code", "")
    message = call.details() or call.code().name
    details: dict[str, Any] = {"request_id": metadata.get("x-request-id", "")}
    if not code:
        kind, code = _GRPC.get(status, (Internal, "internal"))
        return kind(f"{peer}: {message}", code=code, **details)
    for key, value in call.trailing_metadata() or ():
        if key == "grpc-status-details-bin":
            details.update(_details(value))
    return family(code, status)(message, code=code, **details)


def _texts(metadata: Iterable[tuple[str, str | bytes]] | None) -> Iterable[tuple[str, str]]:
    return ((key, value) for key, value in metadata or () if isinstance(value, str))


def _details(encoded: bytes) -> dict[str, Any]:
    """The fields of `google.rpc` details."""
    from google.rpc import error_details_pb2, status_pb2

    found: dict[str, Any] = {}
    for packed in status_pb2.Status.FromString(encoded).details:
        info, request, retry = (
            error_details_pb2.ErrorInfo(),
            error_details_pb2.BadRequest(),
            error_details_pb2.RetryInfo(),
        )
        if packed.Unpack(info):
            texts = ("value", "expected", "required_scope", "primary")
            found.update({key: info.metadata[key] for key in texts if key in info.metadata})
            if "limit" in info.metadata:
                found["limit"] = int(info.metadata["limit"])
        elif packed.Unpack(request) and request.field_violations:
            found["field"] = request.field_violations[0].field
        elif packed.Unpack(retry):
            found["retry_after"] = retry.retry_delay.ToNanoseconds() / 1e9
    return found


def from_act_error(error: ActError) -> QedgixError:
    """The exception of one request of a batch or a stream."""
    return family(error.code, error.status)(error.message, code=error.code, field=error.field)


def from_http(response: httpx.Response) -> QedgixError:
    """The exception of a response whose status is an error. Its body must have been read."""
    request_id = response.headers.get("x-request-id", "")
    try:
        problem = response.json()
        code, message = problem["code"], problem["detail"]
    except (ValueError, LookupError, TypeError):
        kind, code = _GRPC.get(_HTTP.get(response.status_code, 0), (Internal, "internal"))
        return kind(f"HTTP status {response.status_code}", code=code, request_id=request_id)
    names = ("value", "expected", "limit", "required_scope", "primary", "retry_after")
    return family(code, _HTTP.get(response.status_code, 13))(
        message,
        code=code,
        field=problem.get("field", ""),
        request_id=request_id,
        **{name: problem.get(name) for name in names},
    )


def out_of_order(message: str, code: str = "failed_precondition") -> FailedPrecondition:
    """A call that cannot be made yet."""
    return FailedPrecondition(message, code=code)


def invalid(field: str, value: object, expected: str) -> InvalidArgument:
    """An argument that cannot be sent."""
    text = str(value)[:120]
    return InvalidArgument(
        f"{field}: got {text}, expected {expected}",
        code="invalid_argument",
        field=field,
        value=text,
        expected=expected,
    )
