"""The audit log: how its records are chained, and what can be proved from them."""

from robosac.audit.chain import GENESIS, commitment, digest, seal
from robosac.audit.verification import Fault, Finding, verify

__all__ = ["GENESIS", "Fault", "Finding", "commitment", "digest", "seal", "verify"]
