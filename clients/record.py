"""Look into recordings of the gateway, play them again, and give them other forms."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from clients import trial
from clients.errors import GatewayError
from clients.playing import play_against
from robosac import defenses
from robosac.calibrated import calibration_of
from robosac.cli.blame import blaming, failing
from robosac.cli.named import load_named
from robosac.cli.options import progress
from robosac.cli.outputs import Force, check_file, make_folder, tell
from robosac.defenses import Defense, build
from robosac.defenses.registry import Kinds
from robosac.detectors import Detector
from robosac.extras import need
from robosac.faults import printable
from robosac.figures import check_film, need_figures
from robosac.files import is_special
from robosac.recording.reading import RecordedSession, RecordingError, sessions

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)

File = Annotated[Path, typer.Argument(help="A recording, or a folder of them.", metavar="FILE")]
DetectorOption = Annotated[
    str | None,
    typer.Option(
        "--detector", help="A detector's name, weights file or module:callable; by default the recorded name."
    ),
]
SessionOption = Annotated[
    str | None, typer.Option("--session", help="Which one, where there are several: the beginning of its id.")
]
SHOWN = 5


class Form(StrEnum):
    """What a recording can be turned into."""

    RERUN = "rerun"
    PICTURES = "pictures"
    VIDEO = "video"
    CPM = "cpm"
    ROS2 = "ros2"


SUFFIXES = {Form.RERUN: ".rrd", Form.CPM: ".jsonl", Form.ROS2: ".mcap"}


@app.command()
def info(file: File) -> None:
    """Tell what is in a recording; 1 if one ends in the middle."""
    console, broken = Console(), False
    for session in _read(file):
        opening, frames = session.opening, session.frames
        console.print(_literally((f"Session {opening.session_id}", "bold"), f", opened {opening.created_at}"))
        team = list(dict.fromkeys(name for frame in frames for name in frame.decided.team)) or opening.teammates
        sources = Counter(frame.answer.source.value for frame in frames)
        named = list(dict.fromkeys(name for frame in frames for name in frame.answer.named))
        attackers = sorted({name for frame in frames if frame.truth for name in frame.truth.attackers})
        rows = {
            "ego": opening.ego_id,
            "teammates": ", ".join(team),
            "detector": f"{opening.detector} ({str(opening.weights_digest)[:12]})",
            "defence": str(opening.defense.get("kind")),
            "frames": _span(session),
            "not recorded": str(sum(frame.decided.dropped for frame in frames)),
            "messages": "whole" if opening.bodies else "digests",
            "truth": f"of {len(frames) - session.without_truth} frames",
            "attackers, as recorded": ", ".join(attackers) or "-",
            "answers": ", ".join(f"{count} {source}" for source, count in sources.most_common()) or "-",
            "named": ", ".join(named) or "-",
        }
        counts = sum((Counter(part.counts) for part in session.files), Counter[str]())
        rows["topics"] = ", ".join(f"{topic} {count}" for topic, count in counts.items())
        table = Table(box=None, show_header=False)
        for name, told in rows.items():
            table.add_row(name, _literally(told))
        console.print(table)
        for part in session.files:
            broken |= part.damage is not None
            told = f" {part.path.name}: {part.path.stat().st_size} bytes, {len(part.frames)} frames, "
            whole = ("whole",) if part.damage is None else ((part.damage, "red"), "; what is before that is good")
            console.print(_literally(told, *whole), soft_wrap=True)  # a name that is cut or folded is no file's name
    if broken:
        raise typer.Exit(1)


@app.command()
def replay(
    file: File,
    defense: Annotated[
        str | None,
        typer.Option(help=f"Another defence: {', '.join(defenses.shipped())}, or module:callable."),
    ] = None,
    detector: DetectorOption = None,
    own: Annotated[
        str | None, typer.Option("--recorded-defense", help="Where the recorded defence is, if it does not ship.")
    ] = None,
    url: Annotated[
        str | None,
        typer.Option(callback=trial.checked_url, help="A gateway to play it to, at the speed it was recorded."),
    ] = None,
    api_key: trial.ApiKey = None,
) -> None:
    """Decide the recorded frames again; 1 if recorded detector and defence do not come to the recorded answers."""
    import torch  # noqa: PLC0415 (seconds to import)

    torch.set_num_threads(1)  # as gateways do: another order of summation moves boxes
    console, same = Console(), True
    if url is not None and (detector, own) != (None, None):
        raise typer.BadParameter("the gateway has its own detectors and defences", param_hint="--url")
    recorded = _with_frames(_read(file))
    made = [_Deciding.of(session, detector, defense, own) for session in recorded] if url is None else []
    for deciding in made:
        same &= deciding.again(console, SHOWN if (detector, defense) == (None, None) else 0)
    if url is not None:
        for session in recorded:
            with blaming("FILE", RecordingError), failing(GatewayError):
                asked = None if defense is None else {"kind": defense}
                console.print(_literally(asyncio.run(play_against(url, session, asked, api_key))))
    if not same and defense is None and detector is None:
        raise typer.Exit(1)


@app.command()
def export(
    file: File,
    to: Annotated[
        Form,
        typer.Option(
            help="rerun: .rrd; pictures: a folder with one of each frame; video: .gif, or .mp4 where there is ffmpeg; "
            "cpm: perceived objects as JSON Lines, .jsonl; ros2: .mcap with messages of ROS 2 alone."
        ),
    ],
    out: Annotated[Path, typer.Option(help="The file, or for pictures the folder.")],
    session: SessionOption = None,
    force: Force = False,
) -> None:
    """Write what was recorded in another form."""
    from robosac.playback import plain, rerun_file, views  # noqa: PLC0415 (a second to import)

    _check_form(to, out)
    if to is not Form.PICTURES:
        check_file(out, "--out", force, *(file.iterdir() if file.is_dir() else [file]))
    (chosen,) = _with_frames([_one(_read(file), session)])
    if to is Form.PICTURES:
        make_folder(out, "--out", force, *(f"{frame.number:06d}.png" for frame in chosen.frames[:1]))
    console = Console()
    with failing(OSError, RecordingError), progress(console) as bar:
        task = bar.add_task("frames", total=len(chosen.frames))
        tick: Callable[[], None] = lambda: bar.advance(task)  # noqa: E731
        score = chosen.opening.least_score
        {
            Form.RERUN: lambda: rerun_file.write_rerun(chosen, out),
            Form.PICTURES: lambda: views.write_pictures(chosen, out, score, tick),
            Form.VIDEO: lambda: views.write_moving(chosen, out, score, tick),
            Form.CPM: lambda: plain.write_cpm(chosen, out),
            Form.ROS2: lambda: plain.write_ros2(chosen, out),
        }[to]()
        bar.update(task, completed=len(chosen.frames))
    tell(console, printable(f"{out}: {len(chosen.frames)} frames of {chosen.opening.ego_id}"))


def _check_form(to: Form, out: Path) -> None:
    """Refuse before any work what cannot be written here, or would have a name by which nobody opens it."""
    if to is Form.RERUN:
        need("rerun", "files of rerun")
    elif to is Form.ROS2:
        need("rosbags", "recordings")
    elif to is Form.PICTURES:
        need_figures()
    elif to is Form.VIDEO:
        with blaming("--out", ValueError):
            check_film(out)
    if (suffix := SUFFIXES.get(to)) and out.suffix != suffix and not is_special(out):
        raise typer.BadParameter(f"{out}: the name has to end in {suffix}", param_hint="--out")


def _read(file: Path) -> list[RecordedSession]:
    with blaming("FILE", RecordingError, OSError):
        return sessions(file)


def _with_frames(found: list[RecordedSession]) -> list[RecordedSession]:
    """The same, if each has a frame; files that are not whole are told."""
    for part in (file for session in found for file in session.files):
        if part.damage is not None:
            typer.secho(f"{part.path}: {part.damage}; what is before that is good", fg="yellow", err=True)
    with failing(RecordingError):
        for session in found:
            if not session.frames:
                raise RecordingError(f"{session.files[0].path} has no frames")
    return found


def _one(found: Sequence[RecordedSession], wanted: str | None) -> RecordedSession:
    those = [session for session in found if session.opening.session_id.startswith(wanted or "")]
    if len(those) != 1:
        ids = ", ".join(session.opening.session_id[:8] for session in found)
        raise typer.BadParameter(printable(f"must choose one of {ids}"), param_hint="--session")
    return those[0]


def _literally(*parts: str | tuple[str, str]) -> Text:
    """Words, each with its style if it has one: a recording may come from anybody, and its names are no markup."""
    return Text.assemble(
        *((printable(part), "") if isinstance(part, str) else (printable(part[0]), part[1]) for part in parts)
    )


def _span(session: RecordedSession) -> str:
    if not session.frames:
        return "none"
    first, last = session.frames[0], session.frames[-1]
    began = datetime.fromtimestamp(first.time_ns / 1e9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    seconds = (last.time_ns - first.time_ns) / 1e9
    return f"{len(session.frames)}, numbers {first.number} to {last.number}, {began}, {seconds:.1f} s"


@dataclass(frozen=True)
class _Deciding:
    """What a recorded session is decided again with."""

    session: RecordedSession
    detector: Detector
    defense: Defense | None
    """Another one than was recorded."""
    kinds: Kinds | None
    """What the recorded one may be; by default what ships."""
    by: str

    @classmethod
    def of(cls, session: RecordedSession, detector: str | None, defense: str | None, own: str | None) -> _Deciding:
        """As the user wants it, or as it was recorded."""
        opening = session.opening
        loaded = load_named(detector, opening.detector, f"session {opening.session_id}")
        other = None if defense is None else _defense(defense, loaded)
        with blaming("--recorded-defense", ValueError):
            kinds = None if own is None else defenses.known([own])
        kind = opening.defense.get("kind")
        if defense is None and kind not in (kinds or defenses.shipped()):
            why = printable(f"the defence of session {opening.session_id}, {kind}, does not ship: say where it is")
            raise typer.BadParameter(why, param_hint="--recorded-defense")
        return cls(session, loaded, other, kinds, str(defense or kind))

    def again(self, console: Console, shown: int) -> bool:
        """Whether all answers are the same; so many that are not are shown."""
        from robosac.playback.comparing import Compared  # noqa: PLC0415 (seconds to import)
        from robosac.playback.replay import replay as decide  # noqa: PLC0415

        opening, info = self.session.opening, self.detector.info
        if info.weights_digest != opening.weights_digest:
            console.print(_literally(f"{info.name} has other weights than the recorded {opening.detector}."))
        compared = Compared()
        with blaming("FILE", RecordingError), failing(OSError):
            for frame in decide(self.session, self.detector, self.defense, self.kinds):
                compared.add(frame)
        console.print(_literally(f"{opening.session_id}, {self.by} on {info.name}:"))
        for line in compared.lines(shown):
            console.print(_literally(line))
        return compared.same == compared.frames


def _defense(text: str, detector: Detector) -> Defense:
    with blaming("--defense", ValueError):
        return build(defenses.load(text), lambda: calibration_of(detector.info))
