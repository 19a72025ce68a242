"""Who asks, as far as turns are concerned: known before anything is looked up, and not by what anybody can make up."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable

from starlette.datastructures import Headers
from starlette.types import Scope

from service.arriving.giving_way import Party
from service.arriving.pacing import OTHERS
from service.keeping.record import SessionRecord
from service.sessions.identity import ApiKeys, Claimed, claimed
from service.sessions.viewers import ViewerTokens

_KEY = "key "


class Parties:
    """Tells the parties of requests apart: whoever shows a credential that counts by the API key behind it, the viewers
    together, and all others by their addresses. Else each made-up credential would have turns of its own.

    Parameters
    ----------
    api_keys : ApiKeys
    viewer_tokens : ViewerTokens
    seen : callable
        Gives a session by its id, as it is remembered here, or None.
    signed : callable
        As `service.sessions.identity.Tokens.signed`.
    """

    def __init__(
        self,
        api_keys: ApiKeys,
        viewer_tokens: ViewerTokens,
        seen: Callable[[str], SessionRecord | None],
        signed: Callable[[str, str], bool],
    ) -> None:
        self._api_keys = api_keys
        self._viewer_tokens = viewer_tokens
        self._seen = seen
        self._signed = signed

    def __call__(self, scope: Scope) -> Party:
        """The party of a request."""
        known = self._known(_credential(scope))
        return known or (_address(scope), "")

    def of_loop(self, scope: Scope) -> Party:
        """The party of a request, as `service.arriving.pacing` has it: addresses are members of one."""
        return self._known(_credential(scope)) or (OTHERS, _address(scope))

    @staticmethod
    def of_token(record: SessionRecord, vehicle_id: str) -> Party:
        """As `of_loop`, of whoever shows a vehicle's token, the present one or one before it."""
        return *Parties.of_session(record.key_id, record.session_id), vehicle_id

    @staticmethod
    def of_session(key_id: str, session_id: str) -> Party:
        """How the parties of a session's vehicles begin: with its key's, by the id of that."""
        return f"{_KEY}{key_id}", session_id

    def is_vehicle(self, scope: Scope, session_id: str) -> bool:
        """Whether a request shows a token of a session, one that counts or one that this gateway signed."""
        credential = _credential(scope)
        record = self._session_of(claimed(credential))
        return (record is not None and record.session_id == session_id) or self._signed(session_id, credential)

    def _known(self, credential: str) -> Party | None:
        if not credential:
            return None
        key_id = self._api_keys.id_of(credential)
        if key_id is not None:
            return f"{_KEY}{key_id}", ""
        if self._viewer_tokens.has(credential):
            return "viewers", credential
        named = claimed(credential)
        record = self._session_of(named)
        return None if named is None or record is None else self.of_token(record, named.vehicle_id)

    def _session_of(self, named: Claimed | None) -> SessionRecord | None:
        """The session in which a token counts, as it is remembered here."""
        record = None if named is None else self._seen(named.session_id)
        # The id of a token that counts is a secret that only the token tells: no signature needs to be verified here.
        if named is None or record is None or record.token_ids.get(named.vehicle_id) != named.token_id:
            return None
        return record


def _credential(scope: Scope) -> str:
    return Headers(scope=scope).get("authorization", "").partition(" ")[2].strip()


def _address(scope: Scope) -> str:
    return f"address {_place((scope.get('client') or ('',))[0])}"


def _place(address: str) -> str:
    """Where somebody is: of IPv6 the network, since whoever has one address has 2**64 of them."""
    if ":" not in address:
        return address
    try:
        found = ipaddress.IPv6Address(address)
    except ValueError:
        return address
    return str(found.ipv4_mapped or f"{int(found) >> 64:x}::/64")
