"""The audit log: how its records are chained, and what can be proved from them."""

from robosac.audit.chain import GENESIS, commitment, digest, seal

__all__ = ["GENESIS", "commitment", "digest", "seal"]
