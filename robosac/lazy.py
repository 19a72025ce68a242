"""Names of a package whose modules are imported only when somebody asks for them (PEP 562).

Torch takes seconds to import, scipy one. Who needs `robosac.Message` alone should not pay for them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pkgutil import resolve_name


def lazily(package: str, places: Mapping[str, str]) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """A package's ``__getattr__`` and ``__dir__``.

    No name may be that of a module in the package: once that module is imported, the name would mean the module.

    Parameters
    ----------
    package : str
        Its ``__name__``.
    places : mapping of name to ``module:attribute``
        Where each name of the package comes from.
    """

    def find(name: str) -> object:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found: object = resolve_name(places[name])
        setattr(sys.modules[package], name, found)  # next time it is an attribute like any other
        return found

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *places})

    return find, names
