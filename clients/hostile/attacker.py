"""Somebody with a key, and what they have at hand."""

from __future__ import annotations

import asyncio
import json
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import httpx
import msgpack
import numpy as np

from clients.client import MSGPACK
from robosac import wire
from robosac.detectors import Message

STRANGERS = 12
PAUSE_S = 0.05
"""After what failed."""
BROKEN = "broken: "
"""How the name of an answer begins that nobody should have been given."""


@dataclass(frozen=True)
class Target:
    """A gateway to attack, and what for."""

    url: str
    key: str
    database: str
    pid: int
    strange: bytes
    """A whole frame of teammates with nothing in common with the ego (`strange_frame`)."""
    frame: bytes
    """An honest whole frame."""
    session_id: str = ""
    """Of the honest ego."""
    viewer_token: str = ""
    """Lets one watch it."""
    teammate: tuple[str, str] | None = None
    """Who of the honest session's teammates attacks, if one does, and its token."""


def strange_frame(body: bytes) -> bytes:
    """A whole frame, from an honest one, whose teammates all contradict the ego.

    Their maps are those of an honest teammate with the channels in another order: no larger than honest ones are, and
    no two alike.
    """
    frame, rng = msgpack.unpackb(body), np.random.default_rng(0)
    honest = next(iter(frame["teammates"].values()))
    teammates = {}
    for number in range(STRANGERS):
        tensors = {}
        for name, tensor in honest["tensors"].items():
            values = np.frombuffer(tensor["data"], tensor["dtype"]).reshape(tensor["shape"])
            tensors[name] = {**tensor, "data": rng.permutation(values).tobytes()}
        teammates[f"stranger-{number}"] = {**honest, "tensors": tensors}
    return wire.pack({**frame, "teammates": teammates})


def message_of(fields: Mapping[str, Any]) -> Message:
    """A vehicle's part of an unpacked frame."""
    tensors = {
        name: np.frombuffer(tensor["data"], tensor["dtype"]).reshape(tensor["shape"])
        for name, tensor in fields["tensors"].items()
    }
    return Message(np.array(fields["pose"], dtype=float).reshape(4, 4), tensors)


def bearer(credential: str) -> dict[str, str]:
    """The header that shows a credential."""
    return {"Authorization": f"Bearer {credential}"}


@dataclass
class Attacker:
    """Somebody with a key. What is answered is counted by its status."""

    http: httpx.AsyncClient
    target: Target
    answers: Counter[str]

    @cached_property
    def frame(self) -> dict[str, Any]:
        """The honest frame, unpacked."""
        fields: dict[str, Any] = msgpack.unpackb(self.target.frame)
        return fields

    async def open(self, team: Iterable[str], **options: object) -> dict[str, Any]:
        """A new session, as the gateway answers it."""
        body = {"ego_id": "ego", "teammates": list(team), **options}
        response = await self.http.post("/v1/sessions", json=body, headers=bearer(self.target.key))
        response.raise_for_status()
        opened: dict[str, Any] = response.json()
        return opened

    async def as_teammate(self) -> tuple[str, str, str]:
        """A session, who the attacker is in it, and its token: in the honest one, or in a new one of its own."""
        if self.target.teammate is not None:
            return self.target.session_id, *self.target.teammate
        session = await self.open(["mate"])
        return session["session_id"], "mate", session["teammate_tokens"]["mate"]

    async def ask(self, method: str, path: str, credential: str | None = None, **options: Any) -> httpx.Response:
        """One request."""
        headers = options.pop("headers", {}) | (bearer(credential) if credential else {})
        response = await self.http.request(method, path, headers=headers, **options)
        self.answers[str(response.status_code)] += 1
        return response

    async def post(self, sid: str, what: str, token: str, body: bytes) -> int:
        """Post msgpack to a session; the status."""
        headers = {"Content-Type": MSGPACK}
        response = await self.ask("POST", f"/v1/sessions/{sid}/{what}", token, content=body, headers=headers)
        return response.status_code

    async def again_and_again(self, number: int, one: Callable[[], Awaitable[object]]) -> None:
        """Do the same without end, so many at a time, with a pause after what fails for want of an answer."""

        async def for_ever() -> None:
            while True:
                try:
                    await one()
                except (OSError, httpx.TransportError, asyncio.IncompleteReadError, ValueError) as error:
                    self.answers[type(error).__name__] += 1
                    await asyncio.sleep(PAUSE_S)

        await asyncio.gather(*(for_ever() for _ in range(number)))


def as_json(fields: object) -> dict[str, Any]:
    """A body of JSON, for a request."""
    return {"content": json.dumps(fields).encode(), "headers": {"Content-Type": "application/json"}}
