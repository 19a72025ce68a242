"""How a team is cut into blocks, inside which all states are held together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

from robosac.boxes import FloatArray
from robosac.defenses.group_testing import sets


@dataclass(frozen=True, eq=False)
class Block:
    """Teammates whose states are held together."""

    names: Sequence[str]
    table: FloatArray
    """(1 + K, 3 ** n): probability of their states (see `sets`), given each kind of attack; "nobody attacks" is the
    first.
    """

    def __len__(self) -> int:
        return len(self.names)

    def of(self, kept: Sequence[int]) -> Block:
        """The block of some of the members, by their places (ascending)."""
        return Block([self.names[i] for i in kept], sets.marginal(self.table, kept))


def members(blocks: Sequence[Block]) -> list[str]:
    """The team, block by block."""
    return [name for block in blocks for name in block.names]


def together(blocks: Sequence[Block]) -> Block:
    """One block of several, which are taken to be independent given the kind."""
    return Block(members(blocks), reduce(sets.joint, [block.table for block in blocks]))


def halved(blocks: Sequence[Block], limit: int) -> list[Block]:
    """The blocks, those with more members than the limit cut into halves until none is larger."""
    cut: list[Block] = []
    for block in blocks:
        half = len(block) // 2
        table = block.table.reshape(len(block.table), -1, sets.STATES**half)
        parts = Block(block.names[:half], table.sum(axis=1)), Block(block.names[half:], table.sum(axis=2))
        cut += halved(parts, limit) if len(block) > limit else [block]
    return cut


def without(blocks: Sequence[Block], name: str) -> list[Block]:
    """The blocks after one has left; at least one block remains, even if nobody is in it."""
    left = [b.of([i for i, other in enumerate(b.names) if other != name]) if name in b.names else b for b in blocks]
    return [block for block in left if len(block)] or left[:1]


def regrouped(blocks: Sequence[Block], masks: Sequence[int], limit: int) -> list[Block] | None:
    """Those in the masks (one a block) in as few blocks as can hold them, and the others apart; None if that saves
    nothing.

    Those of one block stay in one, so what is known of them together is kept.
    """
    crowded = [mask.bit_count() for mask in masks if mask]
    if len(packed(crowded, limit)) >= len(crowded):
        return None
    found = []
    for wanted in (1, 0):
        places = [[i for i in range(len(b)) if mask >> i & 1 == wanted] for b, mask in zip(blocks, masks, strict=True)]
        parts = [block.of(kept) for block, kept in zip(blocks, places, strict=True) if kept]
        found += [together([parts[i] for i in group]) for group in packed(list(map(len, parts)), limit)]
    return found


def packed(sizes: Sequence[int], room: int) -> list[list[int]]:
    """Items in bins, first fit by decreasing size: their indices, bin by bin."""
    bins: list[list[int]] = []
    for item in sorted(range(len(sizes)), key=lambda i: -sizes[i]):
        fit = next((b for b in bins if sum(sizes[i] for i in b) + sizes[item] <= room), None)
        if fit is None:
            bins.append([item])
        else:
            fit.append(item)
    return bins
