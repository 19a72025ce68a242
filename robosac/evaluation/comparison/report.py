"""The page, the figures and the pictures of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from robosac import __version__
from robosac.calibrated import calibration_digest, without_witness
from robosac.evaluation.comparison.pictures import draw_passes, draw_precision
from robosac.evaluation.comparison.playing import Plan
from robosac.evaluation.comparison.rows import (
    WINDOWS,
    Estimate,
    Figures,
    NamingFigures,
    ObjectFigures,
    Row,
    StandingFigures,
)
from robosac.evaluation.comparison.settings import lacks_witness
from robosac.evaluation.comparison.tables import sections
from robosac.evaluation.report import Table, write_csv, write_report

HEAD = """# Defences against attacks

`{command}`: {scenes} test sequences of {frames} frames at {rate:g} Hz, {ego} the ego, attackers drawn among its
teammates{poses}. In each setting all defences meet the same frames. *Oracle* fuses everybody who is honest in the
frame. `sample_consensus` and `static_team` test hypotheses of three teammates, or of as many as can be honest, and at
most seven a frame. `group_testing` expects exact poses; a session's default is `group_testing, expecting .2 m`, where
the detector is calibrated for that. Passes are fused ones; that of the ego alone comes on top. Standard errors (+-) are
over sequences, by the jackknife; those of differences and ratios to the oracle take both on the same sequences. All
figures are in `comparison.csv`. {made_by}
"""
REPORT = "comparison.md"
PRECISION, PASSES = "precision.png", "passes.png"
ESTIMATES = ("ap50", "ap70", "ap50_difference", "ap70_difference", "ap70_ratio")
OVERALL = ("passes_first", "passes_early", "passes_steady", "honest_refused", "milliseconds")
NAMING = tuple(NamingFigures.__dataclass_fields__)
SHARES = ("held", "flagged", "confirmed", "single_witness", "disputed", "true_confirmed", "true_contradicted")
OBJECTS = tuple(ObjectFigures.__dataclass_fields__)
STANDING = tuple(StandingFigures.__dataclass_fields__)


def write_comparison(rows: Sequence[Row], plan: Plan, out: Path, command: str) -> Path:
    """Write ``comparison.md``, ``comparison.csv``, ``precision.png`` and ``passes.png`` into a folder.

    Returns
    -------
    Path
        Of the Markdown page.
    """
    write_csv(out / "comparison.csv", Table.of([_flat(row) for row in rows]))
    draw_precision(rows, out / PRECISION)
    draw_passes(rows, out / PASSES)
    scenes = plan.scenes()
    egos = sorted({scene.egos[0] for scene in scenes})
    head = HEAD.format(
        command=command,
        scenes=len(scenes),
        frames=plan.extent.frames,
        rate=1 / scenes[0].frame_period_s,
        ego=" or ".join(egos),
        made_by=made_by(plan),
        poses=f", teammates wrong about their positions by {plan.pose_error_m:g} m" if plan.pose_error_m else "",
    )
    return write_report(out / REPORT, head, sections(rows, PRECISION, PASSES))


def made_by(plan: Plan) -> str:
    """What made the figures besides the command, for whoever cites them."""
    info, calibration = plan.detector.info, calibration_digest(plan.detector.info)
    digests = f"weights {info.weights_digest:.12}" + (f" and calibration {calibration:.12}" if calibration else "")
    made = f"Made by robosac {__version__} with seed {plan.seed}; {info.name}: {digests}."
    return f"{made} {without_witness(info.name)}." if lacks_witness(plan.defenses) else made


def _flat(row: Row) -> dict[str, object]:
    """Figures from a frame on end in ``_from_5`` and the like, standard errors in ``_se``."""
    line: dict[str, object] = {
        "campaign": row.setting.campaign,
        "attackers": row.setting.attackers,
        "defense": row.defense,
    }
    for first in WINDOWS:
        suffix = f"_from_{first}" if first else ""
        line |= {f"{name}{suffix}": value for name, value in _figures(row.windows.get(first)).items()}
    line |= {name: _rounded(getattr(row, name)) for name in OVERALL}
    line |= {name: _rounded(getattr(row.naming, name, None)) for name in NAMING}
    return line | _told(row.objects, OBJECTS) | _told(row.standing, STANDING)


def _told(figures: ObjectFigures | StandingFigures | None, names: Sequence[str]) -> dict[str, object]:
    line: dict[str, object] = {}
    for name in names:
        value = getattr(figures, name, None)
        line[name] = _rounded(value.value if isinstance(value, Estimate) else value)
        if name in SHARES:
            line[f"{name}_se"] = _rounded(value.error) if isinstance(value, Estimate) else None
    return line


def _figures(figures: Figures | None) -> dict[str, object]:
    line: dict[str, object] = {}
    for name in ESTIMATES:
        estimate: Estimate | None = getattr(figures, name, None)
        line[name] = _rounded(estimate.value if estimate else None)
        line[f"{name}_se"] = _rounded(estimate.error if estimate else None)
    return line | {"infiltrated": _rounded(figures.infiltrated if figures else None)}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 5)
