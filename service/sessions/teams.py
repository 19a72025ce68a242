"""Who belongs to a session: teammates that join and leave, and the tokens that they speak with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from robosac.audit.events import TeamChanged, TokenRenewed
from robosac.budget import DomainError
from service.keeping.store import SessionChanged, SessionOver, SessionRecord, Store
from service.problems import Problem
from service.schemas import ChangedTeam, RenewedToken
from service.sessions.identity import Tokens, unauthenticated
from service.sessions.live import Caller
from service.sessions.sessions import Sessions, check_size, over
from service.settings import Settings

MAX_RENEWALS = 16
"""Tokens that a vehicle may take between two frames: each leaves a record."""


class Teams:
    """Changes the teams of sessions.

    Parameters
    ----------
    settings : Settings
    sessions : Sessions
    store : Store
    tokens : Tokens
    """

    def __init__(self, settings: Settings, sessions: Sessions, store: Store, tokens: Tokens) -> None:
        self._settings = settings
        self._sessions = sessions
        self._store = store
        self._tokens = tokens

    async def enrol(self, caller: Caller, newcomers: Sequence[str], public_keys: Mapping[str, str]) -> ChangedTeam:
        """Let teammates join, from the next frame on; the answer is the only place where their tokens are shown."""
        async with caller.live.lock:
            record = await self._sessions.current(caller)
            for name in newcomers:
                if name == record.ego_id or name in record.teammates:
                    raise Problem(409, "already-enrolled", f"{name} is in the session already", "teammates")
            tokens = {name: self._tokens.issue(record.session_id, name, is_ego=False) for name in newcomers}
            token_ids = {**record.token_ids, **{name: token.token_id for name, token in tokens.items()}}
            keys = {**record.public_keys, **public_keys}
            await self._change_team(caller, record, (*record.teammates, *newcomers), token_ids, keys)
            return ChangedTeam(
                teammates=[*record.teammates, *newcomers],
                teammate_tokens={name: token.text for name, token in tokens.items()},
                tokens_expire_at=min(token.expires_at for token in tokens.values()),
            )

    async def dismiss(self, caller: Caller, leaver: str) -> None:
        """Let a teammate leave, from the next frame on; its token is worth nothing any more."""
        async with caller.live.lock:
            record = await self._sessions.current(caller)
            if leaver not in record.teammates:
                raise Problem(404, "unknown-teammate", "there is no such teammate in the session")
            token_ids = {name: token_id for name, token_id in record.token_ids.items() if name != leaver}
            keys = {name: key for name, key in record.public_keys.items() if name != leaver}
            team = tuple(name for name in record.teammates if name != leaver)
            await self._change_team(caller, record, team, token_ids, keys)

    async def renew(self, caller: Caller) -> RenewedToken:
        """A fresh token of the caller; the one it came with is worth nothing any more."""
        vehicle = caller.vehicle_id
        async with caller.live.lock:  # else a team that changes meanwhile would bring the old token back
            record = await self._sessions.current(caller)
            if record.token_ids.get(vehicle) != caller.record.token_ids[vehicle]:
                raise unauthenticated("the token was renewed, or its vehicle has left")
            if caller.live.renewals[vehicle] >= MAX_RENEWALS:
                detail = f"a vehicle may have {MAX_RENEWALS} tokens between two frames"
                raise Problem(429, "too-many-renewals", detail, headers={"Retry-After": "1"})
            caller.live.renewals[vehicle] += 1
            token = self._tokens.issue(record.session_id, vehicle, is_ego=caller.is_ego)
            event = TokenRenewed(vehicle_id=vehicle, expires_at=token.expires_at)
            try:
                await self._store.renew_token(record.session_id, vehicle, token.token_id, event.as_json())
            except SessionOver as error:
                raise over() from error
            return RenewedToken(token=token.text, expires_at=token.expires_at)

    async def _change_team(
        self,
        caller: Caller,
        record: SessionRecord,
        team: Sequence[str],
        token_ids: Mapping[str, str],
        keys: Mapping[str, str],
    ) -> None:
        """Keep a new team of the session ``record``. The session's lock is held."""
        check_size(team, self._settings.max_teammates)
        try:
            state = caller.live.session.defense.change_team(record.state, team)
        except DomainError as error:
            raise Problem(422, "impossible-defense", str(error), "teammates") from error
        event = TeamChanged(
            joined=tuple(name for name in team if name not in record.teammates),
            left=tuple(name for name in record.teammates if name not in team),
            teammates=tuple(team),
            public_keys=dict(keys),
            state=dict(state),
        )
        try:
            await self._store.change_team(
                record.session_id, record.revision, tuple(team), token_ids, keys, state, event.as_json()
            )
        except SessionChanged as error:
            raise Problem(409, "session-changed", "the session was changed at the same time; try again") from error
        except SessionOver as error:
            raise over() from error
        caller.live.follow(await self._sessions.current(caller))
