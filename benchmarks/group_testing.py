"""Group testing on test sequences against what is possible: precision, passes, and whom it names.

Every subset of the five teammates is decoded once a frame, for every setting; the recordings are kept in a folder and
read again by the next run.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from robosac import attacks
from robosac.calibration import calibration_of
from robosac.defenses import GroupTesting
from robosac.defenses.group_testing.defense import DEFAULT_POSE_ERROR_M
from robosac.detectors import Detector, load
from robosac.evaluation.playing import Tally, play
from robosac.evaluation.recordings import RecordedFrame, record_sequence, save
from robosac.evaluation.recordings import load as read
from robosac.scenes import IntersectionScene
from robosac.scenes.splits import TEST_SEEDS

EGO = "car-1"
SETTINGS = ("none", "pgd:1", "pgd:2", "pgd:3", "pgd:4", "erase:1", "erase:2", "pgd:1@10", "erase:1@10", "erase:2@10")
HEADINGS = (
    "attack",
    "oracle AP50/AP70",
    "group testing",
    "no defence",
    "attacker in the answer",
    "passes: first, 2 to 5, later",
    "honest named",
    "attackers named",
    "frames to name, mean and most",
)


def main(
    recordings: Annotated[Path, typer.Option(help="Folder of the recordings.")],
    setting: Annotated[list[str] | None, typer.Option(help="ATTACK:NUMBER, or ATTACK:NUMBER@FIRST_FRAME.")] = None,
    sequences: int = 20,
    frames: int = 25,
    pose_error: Annotated[float, typer.Option(help="Of the teammates, metres.")] = 0.0,
    expected_pose_error: Annotated[
        float, typer.Option(help="That the defence reckons with, metres.")
    ] = DEFAULT_POSE_ERROR_M,
) -> None:
    """Print a table in Markdown. Attackers in the answer and precision are counted from the sixth frame on, or from the
    sixth frame of the attack.
    """
    torch.set_num_threads(1)
    recordings.mkdir(parents=True, exist_ok=True)
    detector = load()
    defense = GroupTesting.calibrated(calibration_of(detector.info), expected_pose_error)
    print(f"| {' | '.join(HEADINGS)} |\n|{'---|' * len(HEADINGS)}")
    for name in setting or SETTINGS:
        attack, _, rest = name.partition(":")
        number, _, start = rest.partition("@")
        first = int(start or 0)
        tally = Tally(steady_from=first + 5)
        for seed in TEST_SEEDS[:sequences]:
            honest = _recorded(recordings, detector, seed, frames, "none", 0, pose_error, None)
            sequence = honest
            if attack != "none":
                sequence = _recorded(recordings, detector, seed, frames, attack, int(number), pose_error, honest)
            sequence = [*honest[:first], *sequence[first:]]
            tally.add(sequence, play(defense, sequence, np.random.default_rng(seed)))
        print(_row(name, tally, first), flush=True)


def _recorded(
    folder: Path,
    detector: Detector,
    seed: int,
    frames: int,
    attack: str,
    number: int,
    pose_error_m: float,
    honest: list[RecordedFrame] | None,
) -> list[RecordedFrame]:
    suffix = f"-{pose_error_m:g}m" if pose_error_m else ""
    path = folder / f"{seed}-{attack}{number or ''}{suffix}.npz"
    if not path.exists():
        team = sorted(set(IntersectionScene(seed).agents) - {EGO})
        order = np.random.default_rng([0, 77, seed]).permutation(team)
        made = record_sequence(
            detector,
            seed,
            frames,
            attacks.load("pgd" if attack == "none" else attack),
            [str(name) for name in order[:number]],
            np.random.default_rng([0, seed, number]),
            unattacked=honest,
            ego_id=EGO,
            pose_error_m=pose_error_m,
        )
        save(path, list(made))
    return read(path, detector.info)[:frames]


def _row(name: str, tally: Tally, first: int) -> str:
    def precision(curve: object) -> str:
        return f"{curve.at(0.5):.3f}/{curve.at(0.7):.3f}"  # type: ignore[attr-defined]

    to_name = np.array(tally.frames_to_name) - first
    cells = [
        name,
        precision(tally.oracle),
        precision(tally.ap),
        precision(tally.undefended),
        f"{np.mean(tally.infiltrated):.3f}",
        f"{np.mean(tally.first):.1f}, {np.mean(tally.early):.1f}, {np.mean(tally.steady):.2f}",
        f"{tally.honest_named}/{tally.honest}",
        f"{tally.attackers - tally.unnamed}/{tally.attackers}" if tally.attackers else "",
        f"{to_name.mean():.1f}, {to_name.max()}" if len(to_name) else "",
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    typer.run(main)
