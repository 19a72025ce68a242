"""Sums up what a defence did over all sequences of a setting, and how far that can be relied on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robosac.boxes import FloatArray
from robosac.evaluation.average_precision import AveragePrecision
from robosac.evaluation.comparison.playing import Naming, Played
from robosac.evaluation.comparison.settings import Setting
from robosac.evaluation.objects import ObjectHistory, Tally, object_rates
from robosac.evaluation.standing import NONE, TrueBoxes

EARLY = 5
"""The frames after these count as steady."""
WINDOWS = (0, EARLY, 10)
"""Figures are given for the frames from each of these numbers on."""


@dataclass(frozen=True)
class Estimate:
    """A figure and its standard error over sequences; None with a single sequence."""

    value: float
    error: float | None

    @classmethod
    def of(cls, figure: FloatArray) -> Estimate:
        """By the jackknife: ``sqrt((n - 1) / n * sum((x_i - mean(x))^2))``, x_i the figure without sequence i.

        ``figure`` (1 + n,) is that of all sequences, and then those without each in turn. Source: Efron and Tibshirani,
        An Introduction to the Bootstrap (1993), chapter 11.
        """
        left_out = figure[1:]
        n = len(left_out)
        return cls(float(figure[0]), float(np.sqrt((n - 1) * left_out.var())) if n > 1 else None)

    def times(self, factor: float) -> Estimate:
        """The figure in another unit."""
        return Estimate(factor * self.value, None if self.error is None else abs(factor) * self.error)


@dataclass(frozen=True)
class Figures:
    """What the answers of some frames are worth."""

    ap50: Estimate
    ap70: Estimate
    ap50_difference: Estimate
    ap70_difference: Estimate
    """To the oracle on the same sequences; negative where something is lost."""
    ap70_ratio: Estimate | None
    """To the oracle; None where that has 0."""
    infiltrated: float
    """Share of frames with an attacking message in the answer."""


@dataclass(frozen=True)
class NamingFigures:
    """Whom a defence named."""

    named_all: float | None
    """Share of attacked sequences in which all attackers were named; None where nobody attacks."""
    frames_to_name: float | None
    """Frames from the first strike until all attackers are named, the mean over those sequences."""
    attackers_named: int
    attackers_struck: int
    """Attackers that were named after they struck, and all that struck."""
    frames_to_name_each: float | None
    frames_to_name_most: int | None
    """Frames from the first strike of each of the former until it is named, the mean and the most."""
    honest_named: int
    honest: int
    """Honest teammates that were ever named, and all of them."""
    sequences_honest_named: int
    sequences: int
    """Sequences in which any honest teammate was named, and all of them."""


@dataclass(frozen=True)
class ObjectFigures:
    """What became of lies about single objects, as `robosac.evaluation.objects.object_rates` counts it."""

    held: Estimate
    """Share of object frames in which the answer tells the lie."""
    longest: int
    """Most successive frames of a sequence in which it tells one and the same."""
    flagged: Estimate | None
    confirmed: Estimate | None
    single_witness: Estimate | None
    disputed: Estimate | None
    """Shares of object frames in which the answer contradicts or repairs it, and tells it as confirmed, on the word of
    one, or though somebody denies it; None from a defence that does not know how boxes stand.
    """
    frames_to_flag: float | None
    sequences_shown: int
    """Sequences in which a lie holds in the undefended fusion at all."""
    shown_named: int
    """Those of them in which all attackers were named."""
    frames_to_name_shown: float | None
    """Frames from the first in which it does until they are, the mean over those."""


@dataclass(frozen=True)
class StandingFigures:
    """How true boxes stand, as `robosac.evaluation.standing` counts them."""

    true_judged: int
    true_confirmed: Estimate
    true_contradicted: Estimate
    """Shares of them."""


@dataclass(frozen=True)
class Row:
    """What one defence did in one setting."""

    setting: Setting
    defense: str
    """Or `ORACLE`, the fusion of everybody who is honest in the frame, or `EGO_ONLY`."""
    windows: Mapping[int, Figures]
    """By first frame: those of `WINDOWS` that there are frames for."""
    passes_first: float
    passes_early: float
    passes_steady: float
    """Fused passes a frame: in the first, in frames 2 to 5, and afterwards."""
    honest_refused: float | None
    """Share of honest messages left out of the answers; None where there are none."""
    milliseconds: float | None = None
    """Median time of a frame; None unless live."""
    naming: NamingFigures | None = None
    """None where the defence names nobody."""
    true_boxes: float = 0.0
    """A frame."""
    sequences: int = 0
    objects: ObjectFigures | None = None
    """None where nobody lies about single objects."""
    standing: StandingFigures | None = None
    """None from a defence that does not know how boxes stand."""

    @property
    def whole(self) -> Figures:
        """Of all frames."""
        return self.windows[0]


def precisions(sequences: Sequence[Played]) -> dict[int, FloatArray]:
    """Average precision at an IoU of 0.5 and 0.7, of all sequences and without each in turn: (2, 1 + n) in each window.

    Windows are by their first frame; only those that there are frames for.
    """
    found = {}
    for first in WINDOWS:
        if first < len(sequences[0].matched):
            ap = AveragePrecision()
            for number, played in enumerate(sequences):
                for frame in played.matched[first:]:
                    ap.add_matched(frame, number)
            found[first] = np.column_stack([[ap.at(0.5), ap.at(0.7)], ap.leaving_out(0.5, 0.7)])
    return found


def sum_up(
    setting: Setting, defense: str, sequences: Sequence[Played], oracle: Mapping[int, FloatArray], live: bool = False
) -> Row:
    """The row of a defence.

    Parameters
    ----------
    setting : Setting
    defense : str
    sequences : sequence of Played
        All of the same length.
    oracle : mapping of first frame to (2, 1 + n) ndarray
        `precisions` of the oracle on the same sequences.
    live : bool
        Whether its times mean something.
    """
    own = precisions(sequences)
    passes = np.array([played.passes for played in sequences])
    refused, honest = (np.array([getattr(p, of) for p in sequences]).sum() for of in ("refused", "honest"))
    times = [ms for played in sequences for ms in played.milliseconds]
    naming = [played.naming for played in sequences if played.naming is not None]
    return Row(
        setting,
        defense,
        windows={first: _figures(own[first], oracle[first], sequences, first) for first in own},
        passes_first=float(passes[:, 0].mean()),
        passes_early=float(passes[:, 1:EARLY].mean()),
        passes_steady=float(passes[:, EARLY:].mean()),
        honest_refused=float(refused / honest) if honest else None,
        milliseconds=float(np.median(times)) if live and times else None,
        naming=_naming(naming) if naming else None,
        true_boxes=float(np.mean([frame.truths for played in sequences for frame in played.matched])),
        sequences=len(sequences),
        objects=_objects([played.objects for played in sequences]),
        standing=_standing([played.standing for played in sequences]),
    )


def _figures(own: FloatArray, oracle: FloatArray, sequences: Sequence[Played], first: int) -> Figures:
    ratio = Estimate.of(own[1] / oracle[1]) if oracle[1].all() else None
    infiltrated = float(np.mean([played.infiltrated[first:] for played in sequences]))
    ap50, ap70, lost50, lost70 = (Estimate.of(figure) for figure in (*own, *(own - oracle)))
    return Figures(ap50, ap70, lost50, lost70, ratio, infiltrated)


def _naming(sequences: Sequence[Naming]) -> NamingFigures:
    attacked = [naming for naming in sequences if naming.struck]
    all_after = [naming.all_after for naming in attacked if naming.all_after is not None]
    after = [frames for naming in attacked for frames in naming.after]
    return NamingFigures(
        named_all=len(all_after) / len(attacked) if attacked else None,
        frames_to_name=_mean(all_after),
        attackers_named=len(after),
        attackers_struck=sum(naming.struck for naming in attacked),
        frames_to_name_each=_mean(after),
        frames_to_name_most=max(after, default=None),
        honest_named=sum(naming.honest_named for naming in sequences),
        honest=sum(naming.honest for naming in sequences),
        sequences_honest_named=sum(naming.honest_named > 0 for naming in sequences),
        sequences=len(sequences),
    )


def _objects(histories: Sequence[ObjectHistory]) -> ObjectFigures | None:
    rates = object_rates(histories)
    if rates is None:
        return None
    counts = np.array([history.tally for history in histories], dtype=np.float64)
    total = dict(zip(Tally._fields, np.vstack([counts.sum(0), counts.sum(0) - counts]).T, strict=True))

    def share(of: str, known: str) -> Estimate | None:
        return _share(total[of], total[known]) if total[known][0] else None

    return ObjectFigures(
        held=_share(total["held"], total["frames"]),
        longest=rates["longest"],
        flagged=share("flagged", "flag_known"),
        confirmed=share("confirmed", "standing_known"),
        single_witness=share("single_witness", "standing_known"),
        disputed=share("disputed", "standing_known"),
        frames_to_flag=rates["frames_to_flag"],
        sequences_shown=rates["sequences_shown"],
        shown_named=rates["shown_named"],
        frames_to_name_shown=rates["frames_to_name"],
    )


def _standing(sequences: Sequence[Sequence[TrueBoxes]]) -> StandingFigures | None:
    counts = np.array([np.sum([NONE, *frames], axis=0) for frames in sequences], dtype=np.float64)
    judged, confirmed, contradicted = np.vstack([counts.sum(0), counts.sum(0) - counts]).T
    if not judged[0]:
        return None
    return StandingFigures(int(judged[0]), _share(confirmed, judged), _share(contradicted, judged))


def _share(part: FloatArray, whole: FloatArray) -> Estimate:
    """Of all sequences and without each in turn, (1 + n,) both; where nothing is left, the share of all."""
    return Estimate.of(np.divide(part, whole, out=np.full_like(part, part[0] / whole[0]), where=whole > 0))


def _mean(values: Sequence[Any]) -> float | None:
    return float(np.mean(values)) if values else None
