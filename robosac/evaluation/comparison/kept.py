"""Sequences of a comparison that are played already, kept in a folder until all are, so that it can go on."""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from robosac import __version__
from robosac.calibrated import digest_beside
from robosac.defenses.registry import DEFENSES
from robosac.evaluation.average_precision import Matched
from robosac.evaluation.comparison.playing import Naming, Plan, Played, PlayedScene
from robosac.evaluation.comparison.settings import Setting
from robosac.evaluation.objects import Judged, ObjectHistory
from robosac.evaluation.standing import TrueBoxes
from robosac.files import replacing, write_text
from robosac.plugins import code_of, package_code

_PLAN = "plan.json"
_SEQUENCES = "*.msgpack.gz"


def begin(plan: Plan) -> int:
    """Make ready the folder that a plan keeps its sequences in.

    Returns
    -------
    int
        How many of those that the plan wants are there already.

    Raises
    ------
    ValueError
        If the folder has sequences of another plan.
    OSError
        If nothing can be written there.
    """
    if plan.kept is None:
        return 0
    path, ours = plan.kept / _PLAN, _described(plan)
    theirs = json.loads(path.read_text()) if any(plan.kept.glob(_SEQUENCES)) else ours
    other = [name for name, value in ours.items() if theirs.get(name) != value]
    if other:
        raise ValueError(
            f"{plan.kept} has sequences of a comparison that was stopped, and that differs in {', '.join(other)}; "
            "choose another folder or delete it"
        )
    write_text(path, json.dumps(ours, indent=1))
    return sum(_file(plan.kept, number).exists() for number in range(plan.extent.scenes))


def load(folder: Path, number: int) -> PlayedScene | None:
    """The sequence of this number, as `keep` got it; None if it is not there."""
    try:
        packed = _file(folder, number).read_bytes()
    except FileNotFoundError:
        return None
    return {
        (Setting(campaign, attackers), name): _played(values)
        for campaign, attackers, name, values in msgpack.unpackb(gzip.decompress(packed))
    }


def keep(folder: Path, number: int, played: PlayedScene) -> None:
    """Write a sequence, which takes its place at once."""
    lines = [(setting.campaign, setting.attackers, name, asdict(each)) for (setting, name), each in played.items()]
    packed = msgpack.packb(lines, default=lambda array: array.tolist())
    with replacing(_file(folder, number)) as beside:
        beside.write_bytes(gzip.compress(packed, compresslevel=1))


def end(plan: Plan) -> None:
    """Delete what is kept, once the report is written."""
    if plan.kept is not None:
        shutil.rmtree(plan.kept)


def _file(folder: Path, number: int) -> Path:
    return folder / _SEQUENCES.replace("*", f"{number:04d}")


def _described(plan: Plan) -> dict[str, Any]:
    """What sequences must have been played with to stand in one report. Their number may differ."""
    info, extent = plan.detector.info, plan.extent
    return {
        "version": __version__,
        "code": _code(plan),
        "data": plan.data.name,
        "detector": [info.name, info.weights_digest, digest_beside(info)],
        "defenses": list(plan.defenses),
        "settings": [[setting.campaign, setting.attackers] for setting in extent.settings],
        "frames": extent.frames,
        "seed": plan.seed,
        "pose error": plan.pose_error_m,
        "live": plan.live,
    }


def _code(plan: Plan) -> str:
    """A digest of this package, and of what is the user's own."""
    return f"{package_code()} {plan.code} {code_of(DEFENSES)}"


def _played(values: Mapping[str, Any]) -> Played:
    naming, objects = values["naming"], values["objects"]
    return Played(
        **{
            **values,
            "matched": [_matched(**each) for each in values["matched"]],
            "naming": naming and Naming(**{**naming, "after": tuple(naming["after"])}),
            "objects": ObjectHistory(_judged(objects["judged"]), _judged(objects["undefended"]), objects["all_named"]),
            "standing": [TrueBoxes(*each) for each in values["standing"]],
        }
    )


def _matched(scores: Sequence[float], iou: Sequence[float], best: Sequence[int], truths: int) -> Matched:
    return Matched(np.array(scores, np.float64), np.array(iou, np.float64), np.array(best, np.int64), truths)


def _judged(frames: Sequence[Sequence[Mapping[str, Any]]]) -> list[tuple[Judged, ...]]:
    return [tuple(Judged(**each) for each in frame) for frame in frames]
