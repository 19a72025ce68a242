"""Detectors that a file names: a log, or a recording."""

from __future__ import annotations

import typer

from robosac import detectors
from robosac.cli.blame import blaming
from robosac.detectors import Detector
from robosac.detectors.base import split_precision


def load_named(wanted: str | None, named: str, what: str) -> Detector:
    """The detector that the user wants, or else the one of this name if it ships: what a file names may be anything.

    ``what`` it is the detector of, for the message.
    """
    if wanted is None and split_precision(named)[0] not in detectors.available():
        raise typer.BadParameter(f"the detector of {what}, {named!r}, does not ship; give it", param_hint="--detector")
    with blaming("--detector", ValueError, OSError):
        return detectors.load(wanted or named)
