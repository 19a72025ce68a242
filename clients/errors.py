"""What can go wrong between a client and the gateway.

::

    GatewayError
    ├── GatewayUnreachable      no connection, or no answer in time
    ├── ProtocolError           an answer that is not what the contract says
    └── RequestRefused          the gateway answered with a problem
        ├── AccessDenied        401, 403: no or the wrong token
        ├── SessionNotFound     404
        ├── FrameConflict       409: a stale frame or a second message for it
        ├── InvalidRequest      other 4xx: the request itself is wrong
        └── GatewayUnavailable  5xx: try again later
"""

from __future__ import annotations

NO_TYPE = "about:blank"
"""``type`` of a problem that is nothing but its status (RFC 9457), and of what is no problem at all."""


class GatewayError(Exception):
    """Base of everything this package raises."""


class GatewayUnreachable(GatewayError):
    """No connection to the gateway, or no answer in time."""


class ProtocolError(GatewayError):
    """The answer is not what the contract says."""


class RequestRefused(GatewayError):
    """The gateway answered with a problem.

    Attributes
    ----------
    status : int
    type : str
        The problem's ``type``.
    detail : str
    field : str or None
        The part of the request that is to blame.
    retry_after_s : float or None
    """

    def __init__(
        self, status: int, type_: str, detail: str, field: str | None = None, retry_after_s: float | None = None
    ) -> None:
        named = "" if type_ == NO_TYPE else f" {type_.rsplit(':', 1)[-1]}"
        super().__init__(f"{status}{named}: {f'{field}: ' if field else ''}{detail}")
        self.status = status
        self.type = type_
        self.detail = detail
        self.field = field
        self.retry_after_s = retry_after_s


class AccessDenied(RequestRefused):
    """No token, or not one that may do this."""


class SessionNotFound(RequestRefused):
    """The session does not exist, or no longer."""


class FrameConflict(RequestRefused):
    """The frame is answered already, or the message for it is in."""


class InvalidRequest(RequestRefused):
    """The request itself is wrong."""


class GatewayUnavailable(RequestRefused):
    """The gateway cannot serve now."""


def refusal(status: int) -> type[RequestRefused]:
    """The exception for a status."""
    if status in (401, 403):
        return AccessDenied
    if status >= 500:
        return GatewayUnavailable
    return {404: SessionNotFound, 409: FrameConflict}.get(status, InvalidRequest)
