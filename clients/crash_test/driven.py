"""One session of the crash test: what was acknowledged in it, and whether the gateway remembers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from clients.client import GatewayClient, OpenedSession, VehicleClient
from clients.errors import AccessDenied, GatewayError
from clients.load_test import EGO, Bodies
from robosac.answers import FrameAnswer
from robosac.audit import GENESIS, commitment, digest, expanded, seal
from robosac.audit.compact import logged
from robosac.audit.packing import state_digest


@dataclass
class Driven:
    """A session, and what is known of it."""

    defense: str
    opened: OpenedSession
    next_frame: int = 0
    """The first that was never sent."""
    acknowledged: dict[int, FrameAnswer] = field(default_factory=dict)
    """Since the last check."""
    seq: int = 0
    head: str = GENESIS
    commitment: str = ""
    """These three are of the last line that was checked: its number, its digest, its commitment to the next seed."""
    answered: int = 0
    last_frame: int = -1
    state_digest: str | None = None
    """These three are what the log says."""

    def ego(self, gateway: GatewayClient) -> VehicleClient:
        """The session's ego at a gateway."""
        return gateway.vehicle(self.opened.session_id, EGO, self.opened.ego_token)

    async def post(self, ego: VehicleClient, bodies: Bodies) -> None:
        """Post the next frame."""
        frame, self.next_frame = self.next_frame, self.next_frame + 1
        self.acknowledged[frame] = await ego.post_frame_body(bodies.numbered(frame))

    def follow(self, line: str) -> Iterator[str]:
        """Check the log's next line; what is wrong with it."""
        record = json.loads(line)
        event = {name: value for name, value in record.items() if name not in ("session_id", "seq", "previous")}
        if line != seal(event, self.opened.session_id, self.seq + 1, self.head):
            yield f"line {self.seq + 1} is not sealed to the one before"
        self.seq, self.head = self.seq + 1, digest(line)
        if record["event"] == "frame_answered":
            if commitment(record["seed"]) != self.commitment:
                yield f"frame {record['frame']} used another seed than was committed to"
            if record["frame"] <= self.last_frame:
                yield f"frame {record['frame']} was decided after frame {self.last_frame}"
            answer = self.acknowledged.pop(record["frame"], None)
            if answer is not None and _recorded(answer) != _recorded(FrameAnswer.model_validate(expanded(record))):
                yield f"frame {record['frame']} is in the log with another result than was acknowledged"
            self.answered, self.last_frame = self.answered + 1, record["frame"]
        self.commitment = record.get("next_seed_commitment", self.commitment)
        known = expanded(record)
        own = state_digest(known["state"]) if "state" in known else self.state_digest
        self.state_digest = known.get("state_digest", own)

    async def check(self, gateway: GatewayClient, bodies: Bodies) -> list[str]:
        """What is wrong with the session after a restart; posts its next frame."""
        ego, before = self.ego(gateway), self.last_frame
        wrong = [complaint for line in await ego.audit_lines(self.seq) for complaint in self.follow(line)]
        wrong += [f"frame {frame} was acknowledged and is not in the log" for frame in self.acknowledged]
        self.acknowledged.clear()
        state = await ego.state()
        expected = {
            "audit_seq": self.seq,
            "audit_head": self.head,
            "next_seed_commitment": self.commitment,
            "frames_answered": self.answered,
            "last_frame": self.last_frame if self.answered else None,
            "state_digest": self.state_digest,
        }
        state = {**state, "state_digest": state_digest(state["state"])}
        wrong += [f"{name} is {state[name]!r}, not {due!r}" for name, due in expected.items() if state[name] != due]
        if not before <= self.last_frame < self.next_frame:
            wrong.append(f"the last frame is {self.last_frame}")
        for name in self.opened.teammate_tokens:
            wrong += await self._check_token(name, gateway)
        try:
            await self.post(ego, bodies)
        except GatewayError as error:
            wrong.append(f"the next frame was not answered: {error}")
        return wrong

    async def _check_token(self, name: str, gateway: GatewayClient) -> list[str]:
        """A teammate's token is known if what only the ego may do is forbidden, rather than unauthenticated."""
        try:
            await gateway.vehicle(self.opened.session_id, name, self.opened.teammate_tokens[name]).state()
        except AccessDenied as error:
            return [] if error.status == 403 else [f"the token of {name} is worth nothing any more"]
        return [f"{name} was taken for the ego"]


def _recorded(answer: FrameAnswer) -> dict[str, Any]:
    """What a record and an answer say alike: all but the time, which went on after the record was written."""
    return {name: value for name, value in logged(answer).items() if name not in ("deadline_met", "timings_ms")}
