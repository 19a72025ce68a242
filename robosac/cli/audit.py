"""Prove what the gateway decided, from its audit log."""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Annotated, BinaryIO

import typer

from robosac import wire
from robosac.audit import Receipts, digest, misbehaviour, sentence, verification
from robosac.audit.lines import RecordError, lines_in, read
from robosac.audit.receipts import by_id
from robosac.cli.blame import blaming
from robosac.cli.named import load_named
from robosac.cli.outputs import Force, check_file
from robosac.faults import printable
from robosac.files import write_text

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)

MOST_FRAME_BYTES = 2**30
"""Of a frame's messages that are read."""
MOST_FINDINGS = 20
"""That are told one by one: of a file that is no log at all, every line is one."""
Log = Annotated[Path, typer.Argument(help="The audit log (JSON Lines).", metavar="FILE")]


@app.command()
def verify(
    file: Log,
    head: Annotated[
        str | None, typer.Option(help="SHA-256 of the last line, from elsewhere: the session's 'audit_head'.")
    ] = None,
    receipts: Annotated[
        Path | None, typer.Option(help="Receipts that clients kept (JSON Lines); needs --gateway-key.")
    ] = None,
    gateway_key: Annotated[
        list[str] | None, typer.Option(help="The gateway's public key, base64 (/v1/keys); may be given again.")
    ] = None,
) -> None:
    """Check that nothing in a log was changed, and that it does not contradict itself; 1 if something is wrong."""
    if gateway_key and receipts is None:
        raise typer.BadParameter("is for receipts, and none are given", param_hint="--receipts")
    promised = None if receipts is None else _read_receipts(receipts, gateway_key or [])
    if head is not None and re.fullmatch("[0-9a-f]{64}", head) is None:
        raise typer.BadParameter("must be 64 hexadecimal digits, lower case", param_hint="--head")
    with blaming("FILE", OSError), file.open("rb") as lines:
        log = _Counted(lines_in(lines))
        findings = verification.verify(log, head, promised)
    for finding in findings[:MOST_FINDINGS]:
        _say(finding)
    if len(findings) > MOST_FINDINGS:
        _say(f"... and {len(findings) - MOST_FINDINGS} more")
    for doubt in promised.doubts if promised else ():
        _say(f"{receipts}: {doubt}", err=True)
    if findings:
        _say(f"{file}: findings: {len(findings)}")
        raise typer.Exit(1)
    last = log.last.removesuffix(b"\n")
    if promised is not None:
        _say(f"{file}: as {len(promised.of(read(last)['session_id']))} receipts promised")
    proved = "which is the head given" if head else "to be compared with a head from elsewhere"
    _say(f"{file}: {log.count} records, nothing wrong; head {digest(last.decode())}, {proved}")


@app.command()
def show(file: Log) -> None:
    """Tell what a log says, a sentence a record; 1 if a line is no record, or if there is none.

    It proves nothing: that is for `verify`.
    """
    number = broken = 0
    for number, line in enumerate(_lines(file), 1):
        try:
            record, told = read(line.removesuffix(b"\n")), sentence(line)
        except RecordError as error:
            broken += 1
            _say(f"line {number}: {error}", err=True)
        else:
            _say(f"{record.get('seq', '?')} {record.get('time', '')} {told}")
    if not number:
        _say(f"{file}: the log is empty", err=True)
    if broken or not number:
        raise typer.Exit(1)


@app.command("replay")
def replay_decision(
    file: Log,
    messages: Annotated[Path, typer.Option(help="The frame's messages, as the gateway kept them (msgpack).")],
    frame: Annotated[int | None, typer.Option(min=0, help="The frame; by default that of the messages.")] = None,
    detector: Annotated[
        str | None,
        typer.Option(help="A detector's name, weights file or module:callable; by default the name in the log."),
    ] = None,
    defense: Annotated[
        str | None, typer.Option(help="Where a defence that does not ship is: module:callable, or its entry point.")
    ] = None,
) -> None:
    """Make a decision again from the log and the messages, and compare; 1 if it comes out otherwise."""
    import torch  # noqa: PLC0415 (seconds to import, and only this command needs it)

    from robosac import defenses  # noqa: PLC0415
    from robosac.audit import replay  # noqa: PLC0415

    torch.set_num_threads(1)  # as gateways do: another order of summation shifts boxes by more than is tolerated
    with blaming("--messages", OSError, wire.WireError):
        with messages.open("rb") as whole:
            body = whole.read(MOST_FRAME_BYTES + 1)
        if len(body) > MOST_FRAME_BYTES:
            raise typer.BadParameter(
                f"a frame of more than {MOST_FRAME_BYTES} bytes is not read", param_hint="--messages"
            )
        number = wire.read_frame(body).frame if frame is None else frame
    with blaming("FILE", OSError, replay.ReplayError), file.open("rb") as lines:
        decision = replay.find(lines_in(lines), number)
    loaded = load_named(detector, decision.session.detector, "the log")
    kind = decision.session.defense.get("kind")
    if defense is not None and kind in defenses.shipped():
        raise typer.BadParameter(f"the log's defence is {kind}, which ships", param_hint="--defense")
    with blaming("--defense", ValueError):
        kinds = None if defense is None else defenses.known([defense])
    with blaming("--messages", replay.ReplayError):
        differences = replay.replay(decision, body, loaded, kinds)
    answer = decision.answer
    what = f"frame {answer.frame} (line {decision.line})"
    if differences:
        for difference in differences:
            _say(difference)
        _say(f"{what}: not the decision in the log")
        raise typer.Exit(1)
    accepted = ", ".join(answer.accepted) or "nobody"
    _say(
        f"{what}: the same decision: {answer.source}, {accepted}; "
        f"{len(answer.hypotheses)} hypotheses, {len(answer.boxes)} boxes"
    )


@app.command()
def report(
    file: Log,
    vehicle: Annotated[str, typer.Option(help="Whom to report.")],
    out: Annotated[Path | None, typer.Option(help="Where to write it; by default to standard output.")] = None,
    force: Force = False,
) -> None:
    """Write what a log says against a vehicle, in the terms of ETSI TS 103 759; 1 if it says nothing or is broken.

    2 if the vehicle was never in the session.
    """
    if out is not None:
        check_file(out, "--out", force, file)
    try:
        with blaming("FILE", OSError), _open_again_and_again(file) as lines:
            log = _Counted(lines_in(lines))
            findings = verification.verify(log)
            if findings:
                _say(f"{file}: {findings[0]}; see robosac audit verify", err=True)
                raise typer.Exit(1)
            lines.seek(0)
            checked = islice(lines_in(lines), log.count)  # the log may have grown meanwhile
            fields = misbehaviour.report(checked, vehicle, datetime.now(UTC))
    except misbehaviour.NothingToReport as nothing:
        _say(f"{file}: {nothing}", err=True)
        raise typer.Exit(2 if isinstance(nothing, misbehaviour.NeverThere) else 1) from nothing
    text = json.dumps(fields, indent=2) + "\n"
    if out is None:
        typer.echo(text, nl=False)
        return
    with blaming("--out", OSError):
        write_text(out, text)
    count = len(fields["report"]["content"]["v2xPduEvidence"])
    _say(f"{out}: {count} observation{'' if count == 1 else 's'} of {vehicle}")


@dataclass
class _Counted:
    """Lines, of which is known how many were read and what the last one is."""

    lines: Iterable[bytes]
    count: int = 0
    last: bytes = b""

    def __iter__(self) -> Iterator[bytes]:
        for line in self.lines:
            self.count, self.last = self.count + 1, line
            yield line


@contextmanager
def _open_again_and_again(file: Path) -> Iterator[BinaryIO]:
    """A file that can be read more than once, as a pipe cannot."""
    with file.open("rb") as given:
        if given.seekable():
            yield given
            return
        with tempfile.TemporaryFile() as copy:
            shutil.copyfileobj(given, copy)
            copy.seek(0)
            yield copy


def _lines(file: Path) -> Iterator[bytes]:
    """The lines of a file, which is not to blame for what goes wrong between them: whoever reads what is told may be
    gone.
    """
    with blaming("FILE", OSError), file.open("rb") as lines:
        yield from lines_in(lines)


def _read_receipts(file: Path, keys: list[str]) -> Receipts:
    if not keys:
        raise typer.BadParameter("is needed: without it anybody could have signed", param_hint="--gateway-key")
    with blaming("--gateway-key", ValueError):
        known = by_id(keys)
    with blaming("--receipts", OSError), file.open("rb") as lines:
        return Receipts.read(lines_in(lines), known)


def _say(what: object, *, err: bool = False) -> None:
    """Print what may hold a log's own words; a terminal must not obey them."""
    typer.echo(printable(str(what)), err=err)
