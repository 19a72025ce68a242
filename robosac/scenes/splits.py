"""Which scenes serve what: seeds that are never shared between training, validation and test."""

from __future__ import annotations

TEST_SEEDS = range(0, 1_000)
VALIDATION_SEEDS = range(1_000, 2_000)
TRAINING_SEEDS = range(10_000, 1_000_000)
