"""Settings of the gateway, each from an environment variable ``ROBOSAC_<NAME>``."""

from __future__ import annotations

import difflib
import os
import re
from collections import Counter
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from robosac.defenses import check_numbers
from robosac.defenses.sampling import MAX_BUDGET
from robosac.detectors import DEFAULT_DETECTOR
from robosac.possession import read_origin
from robosac.wire import MAX_FRAME
from service.keeping.urls import read_url

_HOST = re.compile(r"[A-Za-z0-9_.-]+|\[[0-9A-Fa-f:.]+\]")
_ADDRESS = re.compile(rf"[A-Za-z]+://(?:{_HOST.pattern})(?::[1-9][0-9]*)?(?:/[!-~]*)?")
PREFIX = "ROBOSAC_"
OTHERS = ("ROBOSAC_API_KEY", "ROBOSAC_FUZZ_CASES")
"""Variables of the clients and of the tests."""
_OF_KUBERNETES = re.compile(r"ROBOSAC_(SERVICE_(HOST|PORT\w*)|PORT(_\d+_\w+)?)")
"""What a pod is given where a service is called robosac."""
_YEAR_S = 366 * 86_400.0
_PATHS = ("api_keys_file", "gateway_key_file", "record")
_LISTS = ("extra_detectors", "extra_defenses", "api_keys", "allowed_hosts", "viewer_tokens", "token_secrets")


class SettingsError(ValueError):
    """The environment sets what cannot be; the message names the variables, and shows no values."""


class Settings(BaseSettings):
    """What an operator can set."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, frozen=True, hide_input_in_errors=True, allow_inf_nan=False)

    detector: str = Field(DEFAULT_DETECTOR, description="Detector of sessions that name none.")
    extra_detectors: Annotated[tuple[str, ...], NoDecode] = Field(
        (), description="Detectors beside those that ship: weights files or module:callable, separated by commas."
    )
    extra_defenses: Annotated[tuple[str, ...], NoDecode] = Field(
        (), description="Defences beside those that ship: module:callable or entry points, separated by commas."
    )
    allow_other_weights: bool = Field(
        False, description="Whether sessions go on after a start with other weights of their detector's name."
    )
    api_keys: Annotated[tuple[SecretStr, ...], NoDecode] = Field(
        (), description="Keys that open sessions, separated by commas; without any, only loopback is served."
    )
    api_keys_file: Path | None = Field(None, description="File of further such keys, one a line.")
    allowed_hosts: Annotated[tuple[str, ...], NoDecode] = Field(
        (),
        description="Names by which the gateway is asked for, beside loopback's, separated by commas; "
        "without any, and without an API key, only loopback's.",
    )
    viewer_tokens: Annotated[tuple[SecretStr, ...], NoDecode] = Field(
        (), description="Tokens of those who may watch sessions, separated by commas; see docs/live.md."
    )
    max_viewers: int = Field(64, ge=0, description="Who may watch sessions at a time; 0 lets nobody.")
    token_secrets: Annotated[tuple[SecretStr, ...], NoDecode] = Field(
        (), description="Secrets of tokens, separated by commas: the first signs, all verify; else the store keeps one."
    )
    gateway_key_file: Path | None = Field(
        None, description="File of the gateway's own keys, one a line: the first signs; else the store keeps one."
    )
    token_ttl_s: float = Field(86_400.0, ge=1, le=10 * _YEAR_S, description="How long a vehicle's token lives.")
    public_url: str | None = Field(
        None,
        description="Address by which clients reach the gateway, as proofs must name it; by default any host does.",
    )
    latency_budget_ms: float = Field(
        200.0, ge=1, le=60_000, description="Budget of sessions that name none: from a frame's head to its answer."
    )
    gather_ms: float = Field(
        100.0,
        ge=0,
        le=60_000,
        description="Longest wait for teammates once the ego's message is in; by default at most half the budget.",
    )
    database_url: str = Field("sqlite:///robosac.db", repr=False, description="Where sessions and audit logs are kept.")
    database_connections: int = Field(
        10, ge=1, le=1000, description="Connections of this process to PostgreSQL, at most."
    )
    database_statement_s: float = Field(
        2.0,
        ge=0.05,
        le=3600,
        description="How long PostgreSQL may take for a statement, or wait for one in a transaction.",
    )
    max_body_bytes: int = Field(32 * 2**20, ge=1024, le=2**40, description="Largest request body.")
    body_timeout_s: float = Field(
        10.0, ge=0.1, le=86_400, description="Time that a body may take from first to last byte."
    )
    max_inflight_bytes: int = Field(
        2**29, ge=2**20, le=2**50, description="Bodies of all requests in hand; beyond, more are refused unread."
    )
    max_inflight_bytes_per_key: int = Field(
        2**28, ge=2**20, le=2**50, description="The same of the sessions of one API key."
    )
    max_budget_ms: float = Field(60_000, ge=1, le=60_000, description="Longest latency budget of a session.")
    max_gather_ms: float = Field(60_000, ge=0, le=60_000, description="Longest wait for teammates of a session.")
    max_hypotheses: int = Field(
        1000, ge=1, le=MAX_BUDGET, description="Hypotheses tested in a frame, whatever its budget."
    )
    max_frame_jump: int = Field(
        1_000_000, ge=1, le=MAX_FRAME, description="By how much a frame's number may exceed the latest answered one."
    )
    max_sessions: int = Field(10_000, ge=1, le=10**9, description="Open sessions at a time.")
    max_sessions_per_key: int = Field(
        2000, ge=1, le=10**9, description="Open sessions of one API key at a time, where one is asked for."
    )
    max_teammates: int = Field(63, ge=1, le=1024, description="Teammates of one session.")
    max_pending_frames: int = Field(
        4, ge=1, le=10_000, description="Messages of a teammate that may wait beside that for the next frame."
    )
    max_pending_bytes: int = Field(
        2**30, ge=2**20, le=2**50, description="Tensors of all teammates' messages that wait; beyond, more are refused."
    )
    max_pending_bytes_per_key: int = Field(
        2**29, ge=2**20, le=2**50, description="The same of the sessions of one API key, where there are several keys."
    )
    max_speed_mps: float = Field(
        70.0, gt=0, le=1e6, description="A vehicle that moved faster from frame to frame is refused."
    )
    max_range_m: float = Field(300.0, gt=0, le=1e6, description="A teammate farther from the ego is left out.")
    keep_frames: int = Field(
        0,
        ge=0,
        le=10_000,
        description="Latest frames of a session, by number, whose messages are kept, to replay decisions.",
    )
    record: Path | None = Field(None, description="Folder that sessions are recorded to; without one, none is.")
    record_sessions: Literal["all", "asked"] = Field(
        "all", description="Which are recorded: all, or those whose opening asks for it."
    )
    record_messages: Literal["whole", "digests"] = Field(
        "whole", description="What is recorded of messages: all, or only what proves what they were."
    )
    record_file_bytes: int = Field(
        2**28, ge=2**20, le=2**40, description="Largest recording; then a session's next one begins."
    )
    record_bytes: int = Field(
        2**33, ge=2**21, le=2**50, description="All recordings in the folder; beyond, those of the key with most go."
    )
    session_idle_s: float = Field(3600.0, ge=0.01, le=10 * _YEAR_S, description="A session unused for longer is ended.")
    audit_retention_s: float = Field(
        7 * 86400.0, gt=0, le=100 * _YEAR_S, description="How long the log of an ended session can be read."
    )
    audit_max_records: int = Field(
        2_000_000,
        ge=2,  # the first says that the session was opened
        le=10**12,
        description="Records of one session's log; beyond, its frames are refused. One has about 2 kB.",
    )
    audit_max_bytes_per_key: int = Field(
        2**38,
        ge=2**20,
        le=2**53 - 1,
        description="Logs of all sessions of one API key, ended ones too; beyond, it opens none and nobody joins.",
    )
    audit_full_every: int = Field(
        200, ge=1, le=100_000, description="Frames from one audit record with the whole state to the next."
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="Least of what is logged.")
    log_format: Literal["json", "console"] = Field("json", description="One JSON object a line, or for the eye.")
    device: str = Field("cpu", description="Where detectors compute, by torch's name: cpu, cuda, cuda:1.")
    torch_threads: int = Field(
        1, ge=1, le=1024, description="Threads of one detector pass; at this size one is fastest."
    )

    @field_validator("*")
    @classmethod
    def _check_numbers(cls, value: object) -> object:
        return check_numbers(value)

    @field_validator("database_url")
    @classmethod
    def _check_url(cls, value: str) -> str:
        read_url(value)
        return value

    @field_validator("public_url")
    @classmethod
    def _check_public_url(cls, value: str | None) -> str | None:
        if value is not None:
            read_origin(value)
            if "?" in value or "#" in value:
                raise ValueError("must have neither query nor fragment: paths are put behind it")
            if _ADDRESS.fullmatch(value) is None:
                raise ValueError("must have a name or an address as its host, and beside it at most a port and a path")
        return value

    @property
    def hosts(self) -> frozenset[str]:
        """Names by which the gateway may be asked for, in lower case, IPv6 addresses without brackets."""
        public = () if self.public_url is None else (read_origin(self.public_url)[1],)
        return frozenset([*(host.strip("[]") for host in self.allowed_hosts), *public])

    @field_validator("allowed_hosts")
    @classmethod
    def _check_hosts(cls, hosts: tuple[str, ...]) -> tuple[str, ...]:
        for host in hosts:
            if _HOST.fullmatch(host) is None:
                raise ValueError("must be names or addresses, without scheme and port, an IPv6 address in brackets")
        return tuple(host.lower() for host in hosts)

    @field_validator(*_PATHS, mode="before")
    @classmethod
    def _none_if_empty(cls, value: object) -> object:
        """A variable that is set to nothing names no path; a Path would make the working directory of it."""
        return None if isinstance(value, str) and not value.strip() else value

    @field_validator(*_LISTS, mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value


def settings_of_environment() -> Settings:
    """The settings that the environment holds.

    Raises
    ------
    SettingsError
        If a value cannot be, or there is no setting of a name that begins with ``ROBOSAC_``.
    """
    wrong = [_misspelt(name) for name in sorted(os.environ) if not _is_known(name)]
    written = Counter(name.upper() for name in os.environ if name.upper().startswith(PREFIX))
    wrong += [
        f"{name}: is set {times} times, in capital and small letters" for name, times in written.items() if times > 1
    ]
    try:
        settings = Settings()
    except ValidationError as error:
        wrong += [_told(".".join(map(str, one["loc"])), one["msg"]) for one in error.errors(include_input=False)]
        raise SettingsError("; ".join(wrong)) from None
    if wrong:
        raise SettingsError("; ".join(wrong))
    return settings


def _is_known(name: str) -> bool:
    name = name.upper()
    ours = name.startswith(PREFIX) and name not in OTHERS and not _OF_KUBERNETES.fullmatch(name)
    return not ours or name.removeprefix(PREFIX).lower() in Settings.model_fields


def _misspelt(name: str) -> str:
    known = [*(field.upper() for field in Settings.model_fields), *(other.removeprefix(PREFIX) for other in OTHERS)]
    near = difflib.get_close_matches(name.upper().removeprefix(PREFIX), known, n=1)
    return f"{name}: there is no such setting" + (f"; do you mean {PREFIX}{near[0]}?" if near else "")


def _told(where: str, what: str) -> str:
    field, _, part = where.partition(".")
    return f"{PREFIX}{field.upper()}: {f'part {part}: ' if part else ''}{what.removeprefix('Value error, ')}"
