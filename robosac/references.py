"""Objects of the user's own code, named ``module:attribute``."""

from __future__ import annotations

import pkgutil
import re
from typing import Any

_REFERENCE = re.compile(r"[\w.]+:[\w.]+")


def is_reference(text: str) -> bool:
    """Whether a text has the form ``module:attribute``."""
    return _REFERENCE.fullmatch(text) is not None


def make(reference: str) -> Any:
    """What the callable at a reference returns. Its module must be importable, and is imported: never take a reference
    from a stranger.

    Raises
    ------
    ValueError
        If there is no such module or attribute, or the call fails.
    """
    try:
        return pkgutil.resolve_name(reference)()
    except Exception as error:  # the user's code may raise anything
        said = " ".join(str(error).split())
        raise ValueError(f"{reference}: {type(error).__name__}: {said}") from error
