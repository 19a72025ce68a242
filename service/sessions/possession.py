"""Calls for which a stolen token must not be enough: where the vehicle registered a key, they need its proof."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from robosac.answers import Reason
from robosac.possession import HEADER, Call, ProofError, check_proof
from robosac.signatures import read_public_key
from service.errors import Kind, Refused
from service.keeping.store import Store
from service.sessions.journal import Journal
from service.sessions.live import Caller


@dataclass(frozen=True)
class Possession:
    """Checks proofs that a caller has its vehicle's key. Which were used is in the store: each counts once, after a
    restart and for all gateways on one store.
    """

    store: Store
    journal: Journal
    clock: Callable[[], float]
    """Unix time, seconds."""
    public_url: str | None = None
    """The gateway's address as proofs have to name it, if not any will do."""

    async def check(self, caller: Caller, call: Call, proofs: Sequence[str]) -> None:
        """Refuse a caller that does not prove that it has the key that its vehicle registered, if it registered one.

        Raises
        ------
        Refused
            With the kind ``bad-proof``; this goes on record. Or ``too-many-proofs``.
        """
        key = caller.record.public_keys.get(caller.vehicle_id)
        if key is None:
            return
        try:
            await self._check(caller, key, call, proofs)
        except ProofError as error:
            detail = f"{caller.vehicle_id} registered a key, and this call needs its proof ({HEADER}): {error}"
            await self.journal.refusal(caller, Reason.UNAUTHENTICATED, detail, None, HEADER)
            raise Refused(Kind.BAD_PROOF, detail, HEADER) from error

    async def _check(self, caller: Caller, key: str, call: Call, proofs: Sequence[str]) -> None:
        if len(proofs) != 1:
            raise ProofError("there are several" if proofs else "there is none")
        now = self.clock()
        proof = check_proof(proofs[0], read_public_key(key), call, now, self.public_url)
        session_id, vehicle_id = caller.record.session_id, caller.vehicle_id
        if not await self.store.use_proof(session_id, vehicle_id, proof.proof_id, proof.ends_at, now):
            raise ProofError("it was used before; make one for each request")
