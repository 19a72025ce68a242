"""Packages that an extra brings along, for what not everybody needs."""

from __future__ import annotations

from importlib.util import find_spec

_EXTRAS = {
    "asyncpg": "postgresql",
    "matplotlib": "plots",
    "mcap": "recordings",
    "ray": "cluster",
    "rerun": "rerun",
    "rosbags": "recordings",
    "simpy": "capacity",
}


class MissingExtra(RuntimeError):
    """A package is needed that is not installed. The message is one line and says how to install it."""


def need(package: str, purpose: str) -> None:
    """Refuse early what could not be done without a package.

    Parameters
    ----------
    package : str
        Of `_EXTRAS`.
    purpose : str
        What needs it, for the message: "pictures", "a PostgreSQL database".

    Raises
    ------
    MissingExtra
        If it is not installed.
    """
    if find_spec(package) is None:
        raise MissingExtra(f"{package} is not installed, for {purpose}: pip install 'robosac[{_EXTRAS[package]}]'")
