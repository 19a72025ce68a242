"""Whether a gateway that is killed goes on where it was: ``python -m clients.crash_test --kills 40 --out DIR``.

Egos with different defences post frames one after another; at a random moment the gateway gets SIGKILL, and another
one is started on the same database. Then, for each session: what was acknowledged is in the audit log as it was
acknowledged, the log's chain holds and its seeds are those committed to, the state is that of the last decision, every
token counts, and the next frame is answered.
"""

from __future__ import annotations

import asyncio
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from subprocess import Popen
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track
from rich.table import Table

from clients.client import FrameAnswer, GatewayClient, OpenedSession, VehicleClient
from clients.errors import AccessDenied, GatewayError, GatewayUnreachable
from clients.load_test import Bodies, prepare
from clients.local_gateway import start_gateway, until_ready
from clients.simulation import make_folder
from robosac.audit import GENESIS, commitment, digest, seal
from robosac.scenes import IntersectionScene

DEFENSES: Mapping[str, Mapping[str, Any]] = {
    "sample_consensus": {"kind": "sample_consensus", "attacker_ratio": 0.2, "sampling_budget": 7, "collaborators": 3},
    "static_team": {"kind": "static_team", "attacker_ratio": 0.2, "sampling_budget": 7, "collaborators": 3},
    "a2cp": {"kind": "a2cp"},
    "group_testing": {"kind": "group_testing"},
    "none": {"kind": "none"},
}
LOADED_S = (0.05, 1.2)
"""How long a gateway is loaded before it is killed, at random."""
PREPARED_FRAMES = 4
BUDGET_MS = 5000.0
"""Long enough that no frame is cut short on a busy machine."""


@dataclass
class Driven:
    """A session, and what is known of it.

    Attributes
    ----------
    defense : str
    opened : OpenedSession
    next_frame : int
        The first that was never sent.
    acknowledged : mapping of frame to FrameAnswer
        Since the last check.
    seq, head, commitment
        Of the log as far as it was checked: number and digest of the last line, commitment to the next seed.
    answered, last_frame, state
        As the log says.
    """

    defense: str
    opened: OpenedSession
    next_frame: int = 0
    acknowledged: dict[int, FrameAnswer] = field(default_factory=dict)
    seq: int = 0
    head: str = GENESIS
    commitment: str = ""
    answered: int = 0
    last_frame: int = -1
    state: Mapping[str, Any] = field(default_factory=dict)

    async def drive(self, ego: VehicleClient, bodies: Bodies) -> None:
        """Post frames until the gateway is gone."""
        while True:
            try:
                await self.post(ego, bodies)
            except GatewayUnreachable:
                return

    async def post(self, ego: VehicleClient, bodies: Bodies) -> None:
        """Post the next frame."""
        frame, self.next_frame = self.next_frame, self.next_frame + 1
        self.acknowledged[frame] = await ego.post_frame_body(bodies.numbered(frame))

    def follow(self, line: str) -> Iterator[str]:
        """Check the log's next line; what is wrong with it."""
        record = json.loads(line)
        event = {name: value for name, value in record.items() if name not in ("session_id", "seq", "previous")}
        if line != seal(event, self.opened.session_id, self.seq + 1, self.head):
            yield f"line {self.seq + 1} is not sealed to the one before"
        self.seq, self.head = self.seq + 1, digest(line)
        if record["event"] == "frame_answered":
            if commitment(record["seed"]) != self.commitment:
                yield f"frame {record['frame']} used another seed than was committed to"
            if record["frame"] <= self.last_frame:
                yield f"frame {record['frame']} was decided after frame {self.last_frame}"
            answer = self.acknowledged.pop(record["frame"], None)
            if answer is not None and not _same(answer, FrameAnswer.parse(record)):
                yield f"frame {record['frame']} is in the log with another result than was acknowledged"
            self.answered, self.last_frame = self.answered + 1, record["frame"]
        self.commitment = record.get("next_seed_commitment", self.commitment)
        self.state = record.get("state", self.state)


@dataclass
class Kill:
    """What one kill showed.

    Attributes
    ----------
    loaded_s : float
        From the start of the load to the kill.
    acknowledged : int
        Frames acknowledged since the kill before.
    unacknowledged : int
        Frames that were decided, but whose answer was lost with the gateway.
    restart_s : float
        From the start of the process to its readiness.
    first_answer_s : float
        From the start of the process until every session had been checked and had its next frame answered.
    wrong : list of str
    """

    loaded_s: float
    acknowledged: int = 0
    unacknowledged: int = 0
    restart_s: float = 0.0
    first_answer_s: float = 0.0
    wrong: list[str] = field(default_factory=list)


async def check(session: Driven, gateway: GatewayClient, bodies: Bodies) -> list[str]:
    """What is wrong with a session after a restart; posts its next frame."""
    opened = session.opened
    ego = gateway.vehicle(opened.session_id, _EGO, opened.ego_token)
    before = session.last_frame
    wrong = [complaint for line in await ego.audit_lines(session.seq) for complaint in session.follow(line)]
    wrong += [f"frame {frame} was acknowledged and is not in the log" for frame in session.acknowledged]
    session.acknowledged.clear()
    state = await ego.state()
    expected = {
        "audit_seq": session.seq,
        "audit_head": session.head,
        "next_seed_commitment": session.commitment,
        "frames_answered": session.answered,
        "last_frame": session.last_frame if session.answered else None,
        "state": session.state,
    }
    wrong += [f"{name} is {state[name]!r}, not {value!r}" for name, value in expected.items() if state[name] != value]
    if not before <= session.last_frame < session.next_frame:
        wrong.append(f"the last frame is {session.last_frame}")
    wrong += [
        complaint
        for name, token in opened.teammate_tokens.items()
        for complaint in await _token(ego, name, token, gateway)
    ]
    try:
        await session.post(ego, bodies)
    except GatewayError as error:
        wrong.append(f"the next frame was not answered: {error}")
    return wrong


async def _token(ego: VehicleClient, name: str, token: str, gateway: GatewayClient) -> list[str]:
    """A teammate's token is known if what only the ego may do is forbidden, rather than unauthenticated."""
    try:
        await gateway.vehicle(ego.session_id, name, token).state()
    except AccessDenied as error:
        return [] if error.status == 403 else [f"the token of {name} is worth nothing any more"]
    return [f"{name} was taken for the ego"]


def _same(one: FrameAnswer, other: FrameAnswer) -> bool:
    return np.array_equal(one.boxes, other.boxes) and {**vars(one), "boxes": 0} == {**vars(other), "boxes": 0}


_EGO, *_TEAM = IntersectionScene(0).agents


class Crashes:
    """Kills gateways one after another on one database.

    Parameters
    ----------
    database_url : str
    log : Path
        Takes what the gateways print.
    bodies : Bodies
    rng : numpy.random.Generator
        Of the moments.
    """

    def __init__(self, database_url: str, log: Path, bodies: Bodies, rng: np.random.Generator) -> None:
        self._database_url = database_url
        self._log = log
        self._bodies = bodies
        self._rng = rng
        self._process: Popen[bytes] | None = None
        self._url = ""
        self.sessions: list[Driven] = []

    async def open(self, sessions: int) -> None:
        """Start the first gateway and open sessions, with one defence after another."""
        await self._start()
        async with GatewayClient(self._url) as gateway:
            for number in range(sessions):
                kind = list(DEFENSES)[number % len(DEFENSES)]
                opened = await gateway.open_session(_EGO, _TEAM, defense=DEFENSES[kind], latency_budget_ms=BUDGET_MS)
                self.sessions.append(Driven(kind, opened))

    async def kill(self) -> Kill:
        """Load the gateway, kill it, start another and check every session."""
        kill = Kill(float(self._rng.uniform(*LOADED_S)))
        answered = sum(session.answered for session in self.sessions)
        async with GatewayClient(self._url) as gateway:
            loads = [
                asyncio.create_task(
                    session.drive(
                        gateway.vehicle(session.opened.session_id, _EGO, session.opened.ego_token), self._bodies
                    )
                )
                for session in self.sessions
            ]
            await asyncio.sleep(kill.loaded_s)
            await self.stop()
            await asyncio.gather(*loads)
        kill.acknowledged = sum(len(session.acknowledged) for session in self.sessions)
        started = time.perf_counter()
        await self._start()
        kill.restart_s = time.perf_counter() - started
        async with GatewayClient(self._url) as gateway:
            for number, session in enumerate(self.sessions):
                complaints = await check(session, gateway, self._bodies)
                kill.wrong += [f"session {number} ({session.defense}): {complaint}" for complaint in complaints]
        kill.first_answer_s = time.perf_counter() - started
        kill.unacknowledged = sum(session.answered for session in self.sessions) - answered - kill.acknowledged
        return kill

    async def stop(self) -> None:
        """Kill the gateway."""
        if self._process is not None:
            self._process.kill()
            await asyncio.to_thread(self._process.wait)

    async def _start(self) -> None:
        self._process, self._url = start_gateway(self._log, self._database_url)
        await until_ready(self._url, self._process, self._log)


def show(console: Console, sessions: int, kills: Sequence[Kill]) -> None:
    """Print what came of it."""
    restarts = np.percentile([kill.restart_s for kill in kills], [50, 95, 100])
    table = Table(title=f"{len(kills)} kills, {sessions} sessions", title_justify="left", box=SIMPLE_HEAD)
    table.add_column("")
    table.add_column("", justify="right")
    table.add_row("frames acknowledged", str(sum(kill.acknowledged for kill in kills)))
    table.add_row("decided, the answer lost with the gateway", str(sum(kill.unacknowledged for kill in kills)))
    table.add_row("kills after which anything was wrong", str(sum(bool(kill.wrong) for kill in kills)))
    table.add_row("restart, s: p50, p95, max", ", ".join(f"{value:.1f}" for value in restarts))
    console.print(table)
    for number, kill in enumerate(kills, 1):
        for complaint in kill.wrong:
            console.print(f"[red]kill {number}: {complaint}[/red]", markup=True, highlight=False)


def main(
    kills: Annotated[int, typer.Option(min=1, help="How often the gateway is killed.")] = 20,
    sessions: Annotated[int, typer.Option(min=1, help="Sessions, with one defence after another.")] = 5,
    seed: Annotated[int, typer.Option(min=0, help="Of the moments.")] = 0,
    database_url: Annotated[str | None, typer.Option(help="By default SQLite in a temporary folder.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for crash_test.json and the gateways' log.")] = None,
) -> None:
    """Kill a gateway under load again and again, and check that nothing acknowledged is lost.

    Exits with 1 if anything was wrong.
    """
    torch.set_num_threads(1)
    console = Console()
    if out is not None:
        make_folder(out, "--out")
    bodies = prepare(True, 3, console, PREPARED_FRAMES)
    with tempfile.TemporaryDirectory(prefix="robosac-") as folder:
        url = database_url or f"sqlite:///{folder}/robosac.db"
        crashes = Crashes(url, (out or Path(folder)) / "gateway.log", bodies, np.random.default_rng(seed))
        try:
            done = asyncio.run(_run(crashes, kills, sessions, console))
        except (GatewayError, OSError) as error:
            console.print(f"[red]The crash test stopped:[/red] {error}")
            sys.exit(1)
    show(console, sessions, done)
    if out is not None:
        report = {"seed": seed, "sessions": sessions, "kills": [asdict(kill) for kill in done]}
        (out / "crash_test.json").write_text(json.dumps(report, indent=2) + "\n")
        console.print(f"Written: {out / 'crash_test.json'}")
    if any(kill.wrong for kill in done):
        sys.exit(1)


async def _run(crashes: Crashes, kills: int, sessions: int, console: Console) -> list[Kill]:
    try:
        await crashes.open(sessions)
        return [await crashes.kill() for _ in track(range(kills), "kills", console=console, transient=True)]
    finally:
        await crashes.stop()


if __name__ == "__main__":
    typer.run(main)
