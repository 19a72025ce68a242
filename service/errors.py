"""What the gateway refuses, in its own terms. How each is answered over HTTP is for `service.problems` to say."""

from __future__ import annotations

from enum import StrEnum

from robosac.answers import Reason

RENEWED = "the token was renewed, or its vehicle has left"


class Kind(StrEnum):
    """What was wrong: the last part of a problem's ``type``."""

    MALFORMED_JSON = "malformed-json"
    INCOMPLETE_BODY = "incomplete-body"
    HUNG_UP = "hung-up"
    UNAUTHENTICATED = "unauthenticated"
    TOKEN_EXPIRED = "token-expired"
    BAD_SIGNATURE = "bad-signature"
    BAD_PROOF = "bad-proof"
    NOT_ENROLLED = "not-enrolled"
    LOOPBACK_ONLY = "loopback-only"
    FOREIGN_HOST = "foreign-host"
    FOREIGN_ORIGIN = "foreign-origin"
    MISROUTED = "misrouted"
    EGO_ONLY = "ego-only"
    WRONG_VEHICLE = "wrong-vehicle"
    UNKNOWN_SESSION = "unknown-session"
    UNKNOWN_TEAMMATE = "unknown-teammate"
    MESSAGES_NOT_KEPT = "messages-not-kept"
    SLOW_BODY = "slow-body"
    ALREADY_ENROLLED = "already-enrolled"
    STALE_FRAME = "stale-frame"
    DUPLICATE_MESSAGE = "duplicate-message"
    EQUIVOCATION = "equivocation"
    SESSION_CHANGED = "session-changed"
    TOO_FAR_AHEAD = "too-far-ahead"
    TOO_LARGE = "too-large"
    URI_TOO_LONG = "uri-too-long"
    HEADERS_TOO_LARGE = "headers-too-large"
    UNSUPPORTED_MEDIA_TYPE = "unsupported-media-type"
    UNSUPPORTED_ENCODING = "unsupported-encoding"
    IMPLAUSIBLE_POSE = "implausible-pose"
    INVALID_REQUEST = "invalid-request"
    IMPOSSIBLE_DEFENSE = "impossible-defense"
    UNKNOWN_DETECTOR = "unknown-detector"
    TOO_MANY_TEAMMATES = "too-many-teammates"
    TOO_MANY_RENEWALS = "too-many-renewals"
    TOO_MANY_CHANGES = "too-many-changes"
    TOO_MANY_PROOFS = "too-many-proofs"
    INTERNAL_ERROR = "internal-error"
    NOT_READY = "not-ready"
    TOO_MANY_VIEWERS = "too-many-viewers"
    TOO_MANY_SESSIONS = "too-many-sessions"
    OVERLOADED = "overloaded"
    DRAINING = "draining"
    DETECTOR_UNAVAILABLE = "detector-unavailable"
    DEFENSE_UNAVAILABLE = "defense-unavailable"
    AUDIT_FULL = "audit-full"
    KEY_FULL = "key-full"
    STORE_UNAVAILABLE = "store-unavailable"
    STORE_TOO_SLOW = "store-too-slow"


class Refused(Exception):
    """A call that is refused.

    Parameters
    ----------
    kind : Kind
    detail : str
        What was wrong, for a human.
    field : str, optional
        Path of the part of the request that is to blame.
    retry_after_s : int, optional
        When to try again, where that is known better than for others of the kind.
    """

    def __init__(self, kind: Kind, detail: str, field: str | None = None, retry_after_s: int | None = None) -> None:
        super().__init__(detail)
        self.kind = kind
        self.detail = detail
        self.field = field
        self.retry_after_s = retry_after_s


class Unusable(Refused):
    """A vehicle's message that does not count; ``reason`` is what goes on record."""

    def __init__(self, kind: Kind, reason: Reason, detail: str, field: str = "frame") -> None:
        super().__init__(kind, detail, field)
        self.reason = reason


class TokenRefused(Refused):
    """A token that does not count; ``vehicle_id`` is whose it is or was, None unless this gateway signed it."""

    def __init__(self, detail: str, vehicle_id: str | None = None, kind: Kind = Kind.UNAUTHENTICATED) -> None:
        super().__init__(kind, detail)
        self.vehicle_id = vehicle_id


class TokenReplaced(Refused):
    """A token that counted once, and does not any more."""

    def __init__(self) -> None:
        super().__init__(Kind.UNAUTHENTICATED, RENEWED)


class SessionOver(Refused):
    """The session has ended, or was never there."""

    def __init__(self, detail: str = "the session has ended") -> None:
        super().__init__(Kind.UNKNOWN_SESSION, detail)


class SessionLost(SessionOver):
    """The database lost records that were promised of a session."""

    def __init__(self) -> None:
        super().__init__("the database lost what was promised of this session: open another one")


class Draining(Refused):
    """The process is to end: nothing was done."""

    def __init__(self) -> None:
        super().__init__(Kind.DRAINING, "this gateway process is about to end; send it again, and another takes it")


class FrameDecided(Refused):
    """A frame of this number or a higher one is decided already, perhaps by another process."""

    def __init__(self, frame: int) -> None:
        super().__init__(Kind.STALE_FRAME, f"frame {frame} or a later one is answered already", "frame")


class AuditFull(Refused):
    """The session's log holds as many records as it may."""

    def __init__(self, records: int) -> None:
        detail = (
            f"the session's audit log holds {records} records, as many as it may: close the session and open another, "
            "or have the operator raise ROBOSAC_AUDIT_MAX_RECORDS"
        )
        super().__init__(Kind.AUDIT_FULL, detail)


class SessionChanged(Refused):
    """The session is not as it was when the change to it was worked out; perhaps another process changed it."""

    def __init__(self, detail: str = "the session was changed at the same time; try again") -> None:
        super().__init__(Kind.SESSION_CHANGED, detail)


class StoreTooSlow(Refused):
    """The database took longer over a decision than its frame has time."""

    def __init__(self, what: str) -> None:
        super().__init__(Kind.STORE_TOO_SLOW, f"the database {what}")


class SessionInUse(Exception):
    """A session was used meanwhile, so it is not ended for being idle."""


class ShareFull(Exception):
    """Others than the ego have put on record as much as they may; this is only counted."""


class GivenUp(Exception):
    """Nobody waits any more for what was to be kept, so it is not kept."""


class StoreUnavailable(Refused):
    """The database failed; of a change it is unknown whether it is kept."""

    def __init__(self) -> None:
        super().__init__(Kind.STORE_UNAVAILABLE, "the database failed; nothing is acknowledged, try again")
