"""Who calls, as the routes ask for it: settled from a request's headers, before anything of a body is read."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from fastapi import Depends, Header, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from fastapi.security.http import HTTPBase

from robosac.possession import HEADER, Call
from service.arriving.paths import path_of
from service.gateway import Gateway
from service.sessions.identity import RENEWAL_KEY
from service.sessions.live import Caller

_token_scheme = HTTPBase(scheme="bearer", auto_error=False, scheme_name="Token", description="A vehicle's token.")
_api_key = HTTPBearer(auto_error=False, scheme_name="ApiKey", description="An API key, where the gateway has any.")
_SCHEMES = ("bearer", HEADER.lower())
"""RFC 9449 shows a token in a scheme of its own beside a proof."""
_RENEWAL_KEY = Header(
    alias="Idempotency-Key",
    pattern=RENEWAL_KEY,
    description="Chosen at random for this renewal: whoever asks again with it and the same token gets the same again.",
)
_PROOF = Header(alias=HEADER, description="Proof that the vehicle's key is there, where it registered one (RFC 9449).")


class Renewing(NamedTuple):
    """Who asks for another token, and with which key of its own choice."""

    caller: Caller
    key: str | None


async def _gateway(request: Request) -> Gateway:  # a plain function would be called on another thread
    gateway: Gateway = request.app.state.gateway
    return gateway


GatewayDep = Annotated[Gateway, Depends(_gateway)]


async def _token(credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_token_scheme)]) -> str | None:
    return credentials.credentials if credentials and credentials.scheme.lower() in _SCHEMES else None


Token = Annotated[str | None, Depends(_token)]


async def _opener(
    gateway: GatewayDep, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_api_key)]
) -> str:
    return gateway.api_keys.check(credentials.credentials if credentials else None)


async def _vehicle(sid: str, gateway: GatewayDep, token: Token) -> Caller:
    return await gateway.sessions.authenticate(sid, token)


async def _renewing(
    sid: str, gateway: GatewayDep, token: Token, renewal_key: Annotated[str | None, _RENEWAL_KEY] = None
) -> Renewing:
    return Renewing(await gateway.sessions.authenticate(sid, token, renewal_key), renewal_key)


async def _ego(sid: str, gateway: GatewayDep, token: Token) -> Caller:
    return await gateway.sessions.authenticate_ego(sid, token)


KeyId = Annotated[str, Depends(_opener)]
Vehicle = Annotated[Caller, Depends(_vehicle)]
Ego = Annotated[Caller, Depends(_ego)]


async def _check_possession(request: Request, gateway: GatewayDep, caller: Caller, token: str | None) -> Caller:
    call = Call(request.method, path_of(request.scope), token or "")
    await gateway.possession.check(caller, call, request.headers.getlist(HEADER))
    return caller


async def _proven_renewing(
    request: Request,
    gateway: GatewayDep,
    renewing: Annotated[Renewing, Depends(_renewing)],
    token: Token,
    _: Annotated[str | None, _PROOF] = None,
) -> Renewing:
    await _check_possession(request, gateway, renewing.caller, token)
    return renewing


async def _proven_ego(
    request: Request, gateway: GatewayDep, caller: Ego, token: Token, _: Annotated[str | None, _PROOF] = None
) -> Caller:
    return await _check_possession(request, gateway, caller, token)


ProvenRenewing = Annotated[Renewing, Depends(_proven_renewing)]
"""For another token, for which a stolen one must not be enough."""
ProvenEgo = Annotated[Caller, Depends(_proven_ego)]
"""For what else a stolen token must not be enough for."""
