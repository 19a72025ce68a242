"""One page about all worlds that defences were compared in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from robosac.evaluation.comparison.playing import EGO_ONLY, ORACLE, Plan
from robosac.evaluation.comparison.report import made_by
from robosac.evaluation.comparison.rows import Estimate, Row
from robosac.evaluation.comparison.settings import DEFENSES, Setting
from robosac.evaluation.comparison.tables import true_boxes
from robosac.evaluation.report import Section, Table, write_csv, write_report

HEAD = """# Defences in several worlds

`{command}`: {scenes} test sequences of {frames} frames in each world. *Lost* is what a defence's answers have less than
the oracle, the fusion of everybody who is honest in the frame, on the same frames. Standard errors (+-) are over
sequences, by the jackknife. *Named* counts honest teammates that were ever named in their sequence, and the sequences
in which this happened. Passes are fused ones, in the first frames and later. All figures are in `worlds.csv`; each
world has its own report in the folder of its name. {made_by}
"""
WORLDS_REPORT = "worlds.md"
UNDEFENDED = next(name for name, settings in DEFENSES.items() if settings.kind == "none")


def write_worlds(rows: Mapping[str, Sequence[Row]], plans: Mapping[str, Plan], out: Path, command: str) -> Path:
    """Write ``worlds.md`` and ``worlds.csv`` into a folder.

    Parameters
    ----------
    rows : mapping of world to sequence of Row
        As `compare_plans` has them.
    plans : mapping of world to Plan
        What was played in each.
    out : Path
        The folder.
    command : str
        That made them.

    Returns
    -------
    Path
        Of the Markdown page.
    """
    extent = next(iter(plans.values())).extent
    lines = [(row.setting, line) for world in rows for row, line in _lines(world, rows[world])]
    write_csv(out / "worlds.csv", Table.of([{"setting": setting.label, **_flat(*line)} for setting, line in lines]))
    sections = [
        Section(setting.label, "", [Table.of([_shown(*line) for of, line in lines if of == setting])])
        for setting in extent.settings
    ]
    made = made_by(next(iter(plans.values())))
    head = HEAD.format(command=command, scenes=extent.scenes, frames=extent.frames, made_by=made)
    return write_report(out / WORLDS_REPORT, head, sections)


_Line = tuple[str, Row, Row, Row | None, Row]
"""World, a defence's row, and beside it those of the oracle, of undefended fusion and of the ego alone."""


def _lines(world: str, rows: Sequence[Row]) -> Iterator[tuple[Row, _Line]]:
    at = {(row.setting, row.defense): row for row in rows}
    for row in rows:
        if row.defense not in (ORACLE, EGO_ONLY):
            setting: Setting = row.setting
            bare = at.get((setting, UNDEFENDED))
            yield row, (world, row, at[setting, ORACLE], bare, at[setting, EGO_ONLY])


def _flat(world: str, row: Row, oracle: Row, bare: Row | None, alone: Row) -> dict[str, object]:
    line: dict[str, object] = {
        "world": world,
        "campaign": row.setting.campaign,
        "attackers": row.setting.attackers,
        "defense": row.defense,
        "sequences": row.sequences,
        "true_boxes": round(row.true_boxes, 3),
    }
    for whose, of in (("oracle", oracle), ("undefended", bare), ("ego_only", alone), ("own", row)):
        for ap in ("ap50", "ap70"):
            line[f"{whose}_{ap}"] = round(getattr(of.whole, ap).value, 5) if of else None
    for ap in ("ap50", "ap70"):
        difference: Estimate = getattr(row.whole, f"{ap}_difference")
        line[f"{ap}_lost"] = round(0.0 - difference.value, 5)
        line[f"{ap}_lost_se"] = None if difference.error is None else round(difference.error, 5)
    standing = row.standing
    for name in ("true_confirmed", "true_contradicted"):
        share: Estimate | None = getattr(standing, name, None)
        line[name] = None if share is None else round(share.value, 5)
        line[f"{name}_se"] = None if share is None or share.error is None else round(share.error, 5)
    naming = row.naming
    return line | {
        "honest_refused": None if row.honest_refused is None else round(row.honest_refused, 5),
        "honest_named": naming.honest_named if naming else None,
        "honest": naming.honest if naming else None,
        "sequences_honest_named": naming.sequences_honest_named if naming else None,
        "passes_first": round(row.passes_first, 3),
        "passes_steady": round(row.passes_steady, 3),
    }


def _shown(world: str, row: Row, oracle: Row, bare: Row | None, alone: Row) -> dict[str, str]:
    naming = row.naming
    return {
        "world": world,
        "defence": row.defense,
        "true boxes": f"{row.true_boxes:.1f}",
        "AP50/AP70: oracle": _precision(oracle),
        UNDEFENDED: _precision(bare) if bare else "-",
        "ego only": _precision(alone),
        "its own": _precision(row),
        "AP50 lost": _lost(row.whole.ap50_difference),
        "AP70 lost": _lost(row.whole.ap70_difference),
        "honest messages left out": "-" if row.honest_refused is None else f"{row.honest_refused:.3f}",
        "honest teammates named": f"{naming.honest_named} of {naming.honest}" if naming else "-",
        "in sequences": f"{naming.sequences_honest_named} of {row.sequences}" if naming else "-",
        "passes: first / later": f"{row.passes_first:.2f} / {row.passes_steady:.2f}",
        **true_boxes(row.standing),
    }


def _precision(row: Row) -> str:
    return f"{row.whole.ap50.value:.3f}/{row.whole.ap70.value:.3f}"


def _lost(difference: Estimate) -> str:
    error = "" if difference.error is None else f" +- {difference.error:.3f}"
    return f"{0.0 - difference.value:.3f}{error}"
