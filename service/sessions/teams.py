"""Who belongs to a session: teammates that join and leave, and the tokens that they speak with."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from robosac.answers import LogReceipt
from robosac.audit.events import TeamChanged, TokenRenewed
from robosac.budget import DomainError
from robosac.defenses import Defense
from robosac.session import changed_team
from service.errors import Kind, Refused, StoreUnavailable, TokenReplaced
from service.keeping.record import SessionRecord
from service.keeping.store import Store
from service.schemas import ChangedTeam, RenewedToken
from service.sessions.identity import Token, Tokens
from service.sessions.live import RENEWALS, Caller
from service.sessions.sessions import Sessions
from service.settings import Settings

RENEWALS_WITHIN_S = 3600.0
"""In so long a vehicle may take `RENEWALS` tokens, or in a token's lifetime if that is shorter: each leaves a record,
and its ego's log must not be filled.
"""
FINDING_OUT_S = 2.0
"""So long it is asked whether a token is kept of which the store did not say so."""
MAX_CHANGES = 128
"""Changes of a team between two frames: each leaves a record with all that the defence remembers."""


@dataclass(frozen=True)
class Teams:
    """Changes the teams of sessions."""

    settings: Settings
    sessions: Sessions
    store: Store
    tokens: Tokens

    async def enrol(self, caller: Caller, newcomers: Sequence[str], public_keys: Mapping[str, str]) -> ChangedTeam:
        """Let teammates join, from the next frame on; the answer is the only place where their tokens are shown."""
        async with caller.live.lock:
            record = await self.sessions.current(caller)
            caller.check_token(record)
            self.sessions.quota.check(record.key_id)
            for name in newcomers:
                if name == record.ego_id or name in record.teammates:
                    raise Refused(Kind.ALREADY_ENROLLED, f"{name} is in the session already", "teammates")
            check_size((*record.teammates, *newcomers), self.settings.max_teammates)
            tokens = await self.tokens.issue_all(record.session_id, newcomers, record.ego_id)
            token_ids = {**record.token_ids, **{name: token.token_id for name, token in tokens.items()}}
            keys = {**record.public_keys, **public_keys}
            kept = await self._change_team(caller, record, (*record.teammates, *newcomers), token_ids, keys)
            return ChangedTeam(
                teammates=[*record.teammates, *newcomers],
                teammate_tokens={name: token.text for name, token in tokens.items()},
                tokens_expire_at=min(token.expires_at for token in tokens.values()),
                receipt=self.sessions.keys.receipt(kept),
            )

    async def dismiss(self, caller: Caller, leaver: str) -> LogReceipt:
        """Let a teammate leave, from the next frame on; its token is worth nothing any more."""
        async with caller.live.lock:
            record = await self.sessions.current(caller)
            caller.check_token(record)
            if leaver not in record.teammates:
                raise Refused(Kind.UNKNOWN_TEAMMATE, "there is no such teammate in the session")
            token_ids = {name: token_id for name, token_id in record.token_ids.items() if name != leaver}
            keys = {name: key for name, key in record.public_keys.items() if name != leaver}
            team = tuple(name for name in record.teammates if name != leaver)
            kept = await self._change_team(caller, record, team, token_ids, keys)
            return self.sessions.keys.receipt(kept)

    async def renew(self, caller: Caller, key: str | None = None) -> RenewedToken:
        """A fresh token of the caller; the one it came with is worth nothing any more. With a ``key`` of the caller's
        choice the same comes again, as often as it asks with that and with the token before.
        """
        vehicle = caller.vehicle_id
        async with caller.live.lock:  # else a team that changes meanwhile would bring the old token back
            record = await self.sessions.current(caller)
            again = self.tokens.again(record, vehicle, caller.token_id, key)
            if again is not None:
                return self._renewed(again, record)
            caller.check_token(record)
            taken, within_s = caller.live.renewals[vehicle], min(RENEWALS_WITHIN_S, self.settings.token_ttl_s)
            if len(taken) == RENEWALS and time.monotonic() - taken[0] < within_s:
                raise Refused(Kind.TOO_MANY_RENEWALS, f"a vehicle may have {RENEWALS} tokens in {within_s:g} s")
            taken.append(time.monotonic())
            token = self.tokens.renewed(record, vehicle, caller.token_id, key)
            event = TokenRenewed(vehicle_id=vehicle, expires_at=token.expires_at)
            try:
                kept = await self.store.renew_token(record.session_id, caller.token_id, token.token_id, event)
            except StoreUnavailable:
                kept = await self._kept_all_the_same(record.session_id, vehicle, token)
            except TokenReplaced:  # by another process, that may have been asked for the same
                now = await self.store.get(record.session_id)
                again = None if now is None else self.tokens.again(now, vehicle, caller.token_id, key)
                if now is None or again is None:
                    raise
                return self._renewed(again, now)
            caller.live.token_ids = {**caller.live.token_ids, vehicle: token.token_id}  # what it has sent still counts
            return self._renewed(token, kept)

    def _renewed(self, token: Token, record: SessionRecord) -> RenewedToken:
        receipt = self.sessions.keys.receipt(record)
        return RenewedToken(token=token.text, expires_at=token.expires_at, receipt=receipt)

    async def _kept_all_the_same(self, session_id: str, vehicle: str, token: Token) -> SessionRecord:
        """The session with a new token of which the store did not say that it is kept. The vehicle has no other then.

        Raises
        ------
        StoreUnavailable
            If it is not kept, or the store does not tell.
        """
        until = time.monotonic() + FINDING_OUT_S
        while True:
            try:
                record = await self.store.get(session_id)
            except StoreUnavailable:
                if time.monotonic() >= until:
                    raise
                await asyncio.sleep(FINDING_OUT_S / 10)
            else:
                if record is None or record.token_ids.get(vehicle) != token.token_id:
                    raise StoreUnavailable
                return record

    async def _change_team(
        self,
        caller: Caller,
        record: SessionRecord,
        team: Sequence[str],
        token_ids: Mapping[str, str],
        keys: Mapping[str, str],
    ) -> SessionRecord:
        """Keep a new team of the session ``record``; the session with it. The session's lock is held."""
        if caller.live.team_changes >= MAX_CHANGES:
            detail = f"a team may change {MAX_CHANGES} times between two frames; several may join at once"
            raise Refused(Kind.TOO_MANY_CHANGES, detail)
        event = await asyncio.to_thread(_change, caller.live.session.defense, record, team, keys)
        kept = await self.store.change_team(record, event, token_ids)
        caller.live.team_changes += 1
        self.sessions.quota.add(kept, record)
        caller.live.follow(await self.sessions.current(caller))
        return kept


def _change(defense: Defense, record: SessionRecord, team: Sequence[str], keys: Mapping[str, str]) -> TeamChanged:
    """What is put on record of a new team, with what the defence remembers of it."""
    try:
        state = changed_team(defense, record.state, team)
    except DomainError as error:
        raise Refused(Kind.IMPOSSIBLE_DEFENSE, str(error), "teammates") from error
    return TeamChanged(
        joined=tuple(name for name in team if name not in record.teammates),
        left=tuple(name for name in record.teammates if name not in team),
        teammates=tuple(team),
        public_keys=dict(keys),
        state=dict(state),
    )


def check_size(team: Sequence[str], most: int) -> None:
    """Refuse a team of more than so many."""
    if len(team) > most:
        detail = f"ROBOSAC_MAX_TEAMMATES allows at most {most} teammates, got {len(team)}"
        raise Refused(Kind.TOO_MANY_TEAMMATES, detail, "teammates")
