"""The audit log: how its records are chained, and what can be proved from them."""

from robosac.audit.chain import GENESIS, Unsealed, commitment, digest, seal
from robosac.audit.compact import FULL_EVERY, Writer, compact
from robosac.audit.expanding import expanded
from robosac.audit.findings import Fault, Finding
from robosac.audit.receipts import Receipts
from robosac.audit.sentences import sentence
from robosac.audit.verification import verify

__all__ = [
    "FULL_EVERY",
    "GENESIS",
    "Fault",
    "Finding",
    "Receipts",
    "Unsealed",
    "Writer",
    "commitment",
    "compact",
    "digest",
    "expanded",
    "seal",
    "sentence",
    "verify",
]
