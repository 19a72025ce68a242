"""What can be added by one file: defences, attacks, detectors, scene sources.

Nothing lists them. `Kind` finds one by its name: a class in a module of the kind's package, an entry point of an
installed package, or the user's own ``module:callable``. What is found is checked, so that its author learns which
method is missing and what it is for. The code of what is found is run: never take a name from a stranger.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import pkgutil
import re
import sys
import sysconfig
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import resolve_name
from pathlib import Path
from typing import Any, Generic, TypeVar

T = TypeVar("T")

_PLACE = r"[^\W\d]\w*(\.[^\W\d]\w*)*"
_REFERENCE = re.compile(f"{_PLACE}:{_PLACE}")


def classes(package: str) -> Iterator[type[Any]]:
    """The classes that the modules of a package define, in the order of the modules; all are imported."""
    for entry in pkgutil.iter_modules(import_module(package).__path__):
        module = import_module(f"{package}.{entry.name}")
        for value in vars(module).values():
            if isinstance(value, type) and f"{value.__module__}.".startswith(f"{module.__name__}."):
                yield value


def own_name(candidate: type) -> str:
    """The class's own attribute ``name``; empty if it has none, or if it is abstract."""
    name = vars(candidate).get("name")
    return name if isinstance(name, str) and not inspect.isabstract(candidate) else ""


@dataclass(frozen=True)
class Kind(Generic[T]):
    """Things of one kind, such as attacks."""

    noun: str
    """What one of them is called in messages."""
    package: str
    """Whose modules hold those that ship. Other packages offer theirs as entry points of the group of that name."""
    contract: type[Any]
    """What each has to be: a protocol, or a class to derive from."""
    name_of: Callable[[type[Any]], str] = own_name
    """The name of a class that is found in the package; empty if it is none of this kind."""
    takes_argument: bool = False
    """Whether ``name:argument`` is a way to ask for one."""
    forms: str = "or module:callable"
    """Other ways to ask for one than a name, for messages."""
    error: type[ValueError] = ValueError
    """Raised where one cannot be had."""
    origins: set[str] = field(default_factory=set, compare=False)
    """Modules of those that do not ship and were made in this process."""

    @cached_property
    def shipped(self) -> Mapping[str, type[T]]:
        """The classes that ship, by name, in the order of their modules.

        Raises
        ------
        error
            If two have the same name.
        """
        found: dict[str, type[T]] = {}
        for candidate in classes(self.package):
            name = self.name_of(candidate)
            if name and found.setdefault(name, candidate) is not candidate:
                raise self.error(f"there are two {self.noun}s {name!r}: {found[name]} and {candidate}")
        return found

    def make(self, text: str) -> T:
        """The one that a text asks for.

        Parameters
        ----------
        text : str
            A name of `shipped` or of an entry point, after which ``:argument`` may stand if the kind takes one; or
            ``module:callable``. What has that name is called, with the argument if there is one.

        Raises
        ------
        error
            If there is no such thing, the user's code fails, or what it returns is none of this kind.
        """
        name, *arguments = text.split(":", 1) if self.takes_argument else [text]
        own: Callable[..., T] | None = self.shipped.get(name)
        made = own(*arguments) if own is not None else self._foreign(name, arguments, text)
        self.check(made, self.contract, text)
        return made

    @property
    def _choice(self) -> str:
        """What may be given, for messages."""
        names = [each for each in sorted(self.shipped) if f"{each}:" not in self.forms]  # the others are in these
        return f"one of {', '.join(names)}, {self.forms}"

    def check(self, candidate: object, contract: type[Any], who: str) -> None:
        """Refuse what does not fulfil a contract, with what it lacks; ``who`` made it."""
        faults = [lacks(candidate, contract), misfits(candidate, contract)]
        if not _is_protocol(contract) and not isinstance(candidate, contract):
            faults.insert(0, f"has to derive from {contract.__name__}")
        if any(faults):
            said = " and ".join(filter(None, faults))
            raise self.error(f"{who} made no {self.noun} but {_shown(candidate)}, which {said}")

    def _foreign(self, name: str, arguments: list[str], text: str) -> T:
        offered = next((f"{point.module}:{point.attr}" for point in entry_points(group=self.package, name=name)), None)
        if offered is None and not _REFERENCE.fullmatch(text):
            raise self.error(f"no {self.noun} {text!r}: give {self._choice}")
        self.origins.add((offered or text).partition(":")[0])
        try:
            made: T = pkgutil.resolve_name(text)() if offered is None else pkgutil.resolve_name(offered)(*arguments)
        except (Exception, SystemExit) as error:  # the user's code may raise anything, or be a script that ends
            said = " ".join(str(error).split())
            if isinstance(error, ModuleNotFoundError) and error.name == re.split("[.:]", text)[0]:
                said += f" (if it is a module of yours, PYTHONPATH has to name its folder; else give {self._choice})"
            raise self.error(f"{text}: {type(error).__name__}: {said}") from error
        return made


def code_of(*kinds: Kind[Any]) -> str:
    """A digest of the user's own code that things of some kinds were made by in this process; empty if there was none.

    It is of the modules that they came from, and of what these import, but not of what is installed.
    """
    files: dict[str, Path] = {}
    names = [name for kind in kinds for name in kind.origins]
    while names:
        name = names.pop()
        place = getattr(sys.modules.get(name), "__file__", None)
        if name in files or not place or _is_installed(Path(place)):
            continue
        files[name] = Path(place)
        if place.endswith(".py"):
            names += _imported(Path(place).read_bytes(), sys.modules[name].__package__ or "")
    return digest_of(*files.values()) if files else ""


@cache
def package_code() -> str:
    """A digest of this package's own code."""
    return digest_of(*Path(__file__).parent.rglob("*.py"))


def digest_of(*files: Path) -> str:
    """A digest of the contents of files, whatever their order."""
    contents = sorted(hashlib.sha256(file.read_bytes()).digest() for file in files)
    return hashlib.sha256(b"".join(contents)).hexdigest()


def _imported(source: bytes, package: str) -> Iterator[str]:
    """Names of modules that the source of one imports, and of what may be some."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and (package or not node.level):
            base = resolve_name("." * node.level + (node.module or ""), package)
            yield from (base, *(f"{base}.{alias.name}" for alias in node.names))


def _is_installed(file: Path) -> bool:
    paths = sysconfig.get_paths()
    roots = {Path(paths[name]) for name in ("stdlib", "platstdlib", "purelib", "platlib")} | {Path(__file__).parent}
    return any(file.is_relative_to(root) for root in roots)


def parts(contract: type[Any]) -> dict[str, str]:
    """What an object needs to have to fulfil a contract, and what each part is for.

    Returns
    -------
    mapping of name to str
        All public methods and properties of a protocol, the abstract ones of a class, each with the first line of its
        docstring.
    """
    return {name: (inspect.getdoc(part) or "").partition("\n")[0] for name, part in _parts(contract).items()}


def _parts(contract: type[Any]) -> dict[str, Any]:
    protocol = _is_protocol(contract)
    return {
        name: part
        for base in reversed(contract.__mro__)
        for name, part in vars(base).items()
        if not name.startswith("_")
        and (callable(part) or isinstance(part, property))
        and (protocol or getattr(part, "__isabstractmethod__", False))
    }


def lacks(candidate: object, contract: type[Any], needed: Collection[str] | None = None) -> str:
    """Which parts of a contract an object lacks, and what each is for.

    Parameters
    ----------
    candidate : object
    contract : type
    needed : collection of str, optional
        The names that count; by default all `parts` of the contract.

    Returns
    -------
    str
        ``lacks NAME (PURPOSE), ...``; empty if it lacks nothing.
    """
    wanted = _parts(contract)
    missing = [name for name in (wanted if needed is None else needed) if not _has(candidate, name, wanted.get(name))]
    if not missing:
        return ""
    purposes = parts(contract)
    shown = [f"{name} ({purposes[name]})" if name in purposes else name for name in missing]
    return f"lacks {', '.join(shown)}"


def misfits(candidate: object, contract: type[Any]) -> str:
    """Which methods of an object cannot be called as those are of a contract, or of a class of this package that it
    derives from.

    Returns
    -------
    str
        ``has a method NAME that cannot be called with (PARAMETERS)``; empty if all can.
    """
    package = __name__.partition(".")[0]
    ours = [base for base in reversed(type(candidate).__mro__) if base.__module__.partition(".")[0] == package]
    called = [(name, part) for base in ours for name, part in vars(base).items() if not name.startswith("_")]
    for name, part in (*_parts(contract).items(), *called):
        method = getattr(candidate, name, None) if inspect.isfunction(part) else None
        if callable(method):
            parameters = list(inspect.signature(part).parameters.values())[1:]
            called_with = [each.name for each in parameters]
            named = {each.name: each for each in parameters if each.kind is each.KEYWORD_ONLY}
            try:
                inspect.signature(method).bind(*(name for name in called_with if name not in named), **named)
            except TypeError as error:
                return f"has a method {name} that cannot be called with ({', '.join(called_with)}): {error}"
            except ValueError:  # of what is written in another language nothing is known
                continue
    return ""


def _has(candidate: object, name: str, part: object) -> bool:
    return callable(getattr(candidate, name, None)) if inspect.isfunction(part) else hasattr(candidate, name)


def _is_protocol(contract: type[Any]) -> bool:
    return bool(getattr(contract, "_is_protocol", False))


def _shown(candidate: object) -> str:
    """What was made, for a message: by its own description, or by its class where it has none of its own."""
    kind = type(candidate)
    return f"{candidate!r:.100}" if kind.__repr__ is not object.__repr__ else f"a {kind.__module__}.{kind.__qualname__}"
