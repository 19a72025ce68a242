"""Words of others on a terminal, which must not obey them."""

from __future__ import annotations


def printable(text: str, *, lines: bool = False) -> str:
    """A text with escapes in the place of what is not printable; the ends of its ``lines`` may stay."""
    return "".join(c if c.isprintable() or (lines and c == "\n") else repr(c)[1:-1] for c in text)
