"""Signed ends of a log, kept by those who were told them: with them a log that was written anew does not verify."""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from pydantic import ValidationError

from robosac.answers import LogReceipt
from robosac.signatures import is_valid_head, key_id, read_public_key


class ReceiptError(ValueError):
    """A receipt that proves nothing."""


def check_receipt(receipt: LogReceipt, keys: Mapping[str, Ed25519PublicKey]) -> None:
    """See that a receipt was signed by one of a gateway's keys.

    Parameters
    ----------
    receipt : LogReceipt
    keys : mapping of key id to Ed25519PublicKey

    Raises
    ------
    ReceiptError
        If it was not.
    """
    key = keys.get(receipt.key_id)
    if key is None:
        raise ReceiptError(f"signed by a key that is not known, {receipt.key_id:.16}")
    try:
        signature = base64.b64decode(receipt.signature, validate=True)
    except (binascii.Error, ValueError) as error:
        raise ReceiptError("its signature is not in base64") from error
    if not is_valid_head(key, receipt.session, receipt.seq, receipt.head, signature):
        raise ReceiptError("its signature is not the gateway's")


def by_id(keys: Iterable[str]) -> dict[str, Ed25519PublicKey]:
    """Public keys (base64) by their ids.

    Raises
    ------
    ValueError
        If one is none.
    """
    read = [read_public_key(text) for text in keys]
    return {key_id(key): key for key in read}


@dataclass
class Receipts:
    """What clients were promised, by session and number of the record: the head, and how often another was promised.

    Parameters
    ----------
    heads : mapping of (session, seq) to head
    doubts : list of str
        Receipts that prove nothing, and why.
    contradicted : mapping of (session, seq) to head
        Where the gateway signed two heads for one place: the other one. This alone convicts it.
    """

    heads: dict[tuple[str, int], str] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)
    contradicted: dict[tuple[str, int], str] = field(default_factory=dict)

    @classmethod
    def read(cls, lines: Iterable[bytes], keys: Mapping[str, Ed25519PublicKey]) -> Receipts:
        """Receipts as JSON Lines, as clients keep them.

        Parameters
        ----------
        lines : iterable of bytes
        keys : mapping of key id to Ed25519PublicKey
            The gateway's, from a source that can be relied on. What none of them signed is in doubt, and not used.
        """
        known = cls()
        for number, line in enumerate(lines, 1):
            try:
                receipt = LogReceipt.model_validate_json(line, strict=True)
                check_receipt(receipt, keys)
                if re.fullmatch("[0-9a-f]{64}", receipt.head) is None:
                    raise ReceiptError("its head is no SHA-256")
            except (ValidationError, ReceiptError) as error:
                why = "it is no receipt" if isinstance(error, ValidationError) else str(error)
                known.doubts.append(f"receipt {number}: {why}")
                continue
            place = (receipt.session, receipt.seq)
            if known.heads.setdefault(place, receipt.head) != receipt.head:
                known.contradicted[place] = receipt.head
        return known

    def of(self, session: str | None) -> dict[int, str]:
        """The heads of a session by the number of the record."""
        return {seq: head for (of, seq), head in self.heads.items() if of == session}

    def contradictions(self, session: str | None) -> Iterator[str]:
        """What the gateway signed that cannot both be true."""
        for (of, seq), head in self.contradicted.items():
            if of == session:
                yield f"the gateway signed two heads of record {seq}: {self.heads[of, seq]} and {head}"
