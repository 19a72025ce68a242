"""A simulated fleet as independent HTTP clients: ``robosac fleet``."""

from __future__ import annotations

import asyncio
import contextlib
import re
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import torch
import typer
from rich.console import Console

from clients import trial
from clients.client import GatewayClient, OpenedSession, VehicleClient
from clients.errors import FrameConflict, GatewayUnavailable, GatewayUnreachable
from clients.screen import Screen
from clients.simulation import EgoFrame, Fleet, team_fault
from clients.summary import REPORT, FleetSummary
from robosac import attacks, defenses, detectors
from robosac.answers import FrameAnswer
from robosac.attacks import CAMPAIGN_HELP
from robosac.cli.blame import blaming
from robosac.cli.options import check_attack, load_data, load_detector
from robosac.cli.outputs import tell
from robosac.detectors import DEFAULT_DETECTOR, Detector
from robosac.evaluation.frames import another_scene
from robosac.recording.truth import Truth
from robosac.scenes import DATA_HELP, DEFAULT_DATA, SceneError, SceneSource, first_scenes, load_source
from robosac.wire import ID_PATTERN, Packing

PATIENCE = 5
"""How often a message is sent to a gateway that cannot serve now."""
MOST_PAUSE_S = 30.0
"""Whoever is told to ask later than that gives up."""
LEAVING_S = 2.0
"""For closing the sessions of a run that is ended early."""
T = TypeVar("T")


@dataclass(frozen=True)
class FleetOptions:
    """What a run does: `main` says of each option what it means. None leaves a choice to the gateway."""

    url: str
    scenes: int
    frames: int
    first_scene: int = 0
    egos: int = 1
    attackers: int = 1
    attack: str = "pgd"
    detector: str = DEFAULT_DETECTOR
    defense: dict[str, Any] | None = None
    seed: int = 0
    budget_ms: float | None = None
    real_time: bool = False
    report: Path | None = None
    api_key: str | None = field(default=None, repr=False)
    data: str = DEFAULT_DATA
    truth: bool = False
    packing: Packing | None = None


class _Vehicle:
    """One vehicle: its own connection to the gateway, and its place in each ego's session."""

    def __init__(self, vehicle_id: str, gateway: GatewayClient, options: FleetOptions) -> None:
        self.vehicle_id = vehicle_id
        self.gateway = gateway
        self.refused: Counter[str] = Counter()
        self._tells, self._packing = options.truth, options.packing
        self._at: dict[str, VehicleClient] = {}

    def enrol(self, ego_id: str, session: OpenedSession) -> None:
        token = session.ego_token if ego_id == self.vehicle_id else session.teammate_tokens[self.vehicle_id]
        self._at[ego_id] = self.gateway.vehicle(session.session_id, self.vehicle_id, token, packing=self._packing)

    async def leave(self) -> None:
        await self._at[self.vehicle_id].close()

    async def send(self, frame: EgoFrame, index: int) -> None:
        """Send to an ego; if it did not wait so long, its answer tells who is missing."""
        message = frame.sent[self.vehicle_id]
        try:
            await _patiently(lambda: self._at[frame.ego_id].send(index, message), self.refused)
        except FrameConflict as conflict:
            if not conflict.type.endswith("stale-frame"):
                raise

    async def ask(self, frame: EgoFrame, index: int) -> tuple[FrameAnswer, float] | None:
        """The answer, and after how many milliseconds it came; None if it is lost, as the gateway could not say in time
        whether the frame was kept, and it was.
        """
        started, refused = time.perf_counter(), Counter[str]()
        truth = Truth(frame.truth, tuple(sorted(frame.attackers))) if self._tells else None
        try:
            answer = await _patiently(lambda: self._at[frame.ego_id].ask(index, frame.message, truth), refused)
        except FrameConflict as conflict:
            if not conflict.type.endswith("stale-frame") or "store-too-slow" not in refused:
                raise
            return None
        finally:
            self.refused.update(refused)
        return answer, (time.perf_counter() - started) * 1e3


async def _patiently(call: Callable[[], Awaitable[T]], refused: Counter[str]) -> T:
    """Call; where the gateway cannot serve now and says when to ask again, do so: the machine may be slow for a while.

    Each refusal after which it is asked again is counted, by the problem's type.

    Raises
    ------
    GatewayError
        As the call does, and if the gateway could not serve `PATIENCE` times.
    """
    for _ in range(PATIENCE - 1):
        try:
            return await call()
        except GatewayUnavailable as busy:
            if busy.retry_after_s is None or busy.retry_after_s > MOST_PAUSE_S:
                raise
            refused[busy.type.rpartition(":")[2]] += 1
            await asyncio.sleep(busy.retry_after_s)
    return await call()


async def run_fleet(options: FleetOptions, console: Console) -> FleetSummary:
    """Drive the fleet through the gateway.

    Raises
    ------
    clients.errors.GatewayError
        If any message or frame is not accepted as it should be; that a teammate's message comes too late is no error.
    ValueError
        If there is no such attack, detector or data, the gateway's detector has other weights, or the egos are in no
        frame.
    """
    detector, attack = detectors.load(options.detector), attacks.load_campaign(options.attack)
    if options.attackers and (fault := attacks.lacking(attack, detector)):
        raise ValueError(fault)
    count = options.first_scene + options.scenes
    source = load_source(options.data)
    scenes = first_scenes(source, "test", count, options.frames)
    summary = FleetSummary(detector)
    screen = Screen(console, options.scenes * options.frames * options.egos)
    with screen.live:
        for scene in scenes[options.first_scene :]:
            other = another_scene(source, "test", scene)
            fleet = Fleet(scene, detector, options.egos, options.attackers, attack, options.seed, other)
            await _run_scene(options, fleet, summary, screen)
    if summary.lost and not summary.frames:
        raise GatewayUnreachable("the database took longer than a frame has over every one, so no answer came")
    if not summary.frames:
        raise ValueError(f"{source.name}: the egos are in none of the frames")
    return summary


async def _run_scene(options: FleetOptions, fleet: Fleet, summary: FleetSummary, screen: Screen) -> None:
    vehicles = {
        name: _Vehicle(name, GatewayClient(options.url, options.api_key), options) for name in fleet.scene.agents
    }
    opened: list[_Vehicle] = []
    try:
        for ego_id in fleet.egos:
            session = await vehicles[ego_id].gateway.open_session(
                ego_id,
                fleet.teammates(ego_id),
                detector=fleet.detector.info.name,
                defense=options.defense,
                latency_budget_ms=options.budget_ms,
                frame_period_ms=fleet.scene.frame_period_s * 1e3,
            )
            vehicles[ego_id].enrol(ego_id, session)
            opened.append(vehicles[ego_id])
            if session.detector["weights_digest"] != fleet.detector.info.weights_digest:
                raise ValueError(f"the gateway's {fleet.detector.info.name} has other weights than the fleet's")
            summary.defense, summary.lacks_witness = session.defense, session.lacks_witness
            for vehicle in vehicles.values():
                vehicle.enrol(ego_id, session)
        start = time.monotonic()
        for index in range(options.frames):
            frames = await asyncio.to_thread(fleet.sense, index)
            if options.real_time:
                await asyncio.sleep(max(0.0, start + index * fleet.scene.frame_period_s - time.monotonic()))
            answers = await asyncio.gather(*(_exchange(vehicles, frame, index) for frame in frames))
            for frame, answered in zip(frames, answers, strict=True):
                if answered is None:
                    summary.lost += 1
                    continue
                answer, latency_ms = answered
                await asyncio.to_thread(summary.add, frame, answer, latency_ms)
                screen.add(fleet.scene.number, frame, answer, latency_ms)
        while opened:
            await opened[-1].leave()
            opened.pop()
    finally:
        await _leave(opened)
        for vehicle in vehicles.values():
            summary.refused.update(vehicle.refused)
        await asyncio.gather(*(vehicle.gateway.aclose() for vehicle in vehicles.values()))


async def _leave(egos: list[_Vehicle]) -> None:
    """Close what a run leaves open that is ended early, as far as the gateway still answers."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LEAVING_S):
            await asyncio.gather(*(ego.leave() for ego in egos), return_exceptions=True)


async def _exchange(vehicles: dict[str, _Vehicle], frame: EgoFrame, index: int) -> tuple[FrameAnswer, float] | None:
    """All vehicles post at the same time; the ego's post is answered, as `_Vehicle.ask` says."""
    sending = [vehicles[name].send(frame, index) for name in frame.sent]
    answered, _ = await asyncio.gather(vehicles[frame.ego_id].ask(frame, index), asyncio.gather(*sending))
    return answered


def main(  # the options of a command line
    url: Annotated[str, typer.Option(callback=trial.checked_url, help="The gateway.")] = "http://127.0.0.1:8000",
    scenes: Annotated[int, typer.Option(min=1, help="Sequences, each a session of its own.")] = 4,
    frames: Annotated[int, typer.Option(min=1, help="Frames of a sequence.")] = 25,
    first_scene: Annotated[int, typer.Option(min=0, help="Test scenes to leave out before.")] = 0,
    egos: Annotated[int, typer.Option(min=1, help="Vehicles that ask.")] = 1,
    attackers: Annotated[int, typer.Option(min=0, help="Vehicles that attack.")] = 1,
    attack: Annotated[str, typer.Option(help=CAMPAIGN_HELP)] = "pgd",
    detector: Annotated[
        str, typer.Option(help="The vehicles' own copy: a name, a weights file, or module:callable.")
    ] = DEFAULT_DETECTOR,
    defense: Annotated[
        str | None,
        typer.Option(help=f"{', '.join(defenses.shipped())}, or module:callable; by default the gateway's choice."),
    ] = None,
    attacker_ratio: Annotated[float | None, typer.Option(help="Ratio the defence assumes.")] = None,
    sampling_budget: Annotated[int | None, typer.Option(help="Most hypotheses a frame.")] = None,
    collaborators: Annotated[int | None, typer.Option(help="Teammates in a hypothesis.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the attackers' choice and starts.")] = 0,
    budget_ms: Annotated[
        float | None, typer.Option(min=1, max=trial.MOST_BUDGET_MS, help="Latency budget; by default the gateway's.")
    ] = None,
    real_time: Annotated[bool, typer.Option(help="Hold frames to the clock.")] = False,
    report: Annotated[Path | None, typer.Option(help="Folder for summary.json and example.png.")] = None,
    data: Annotated[str, typer.Option(help=DATA_HELP)] = DEFAULT_DATA,
    truth: Annotated[bool, typer.Option("--truth", help="Let egos tell what is true, for recordings.")] = False,
    dtype: Annotated[
        str | None, typer.Option(help="Narrower type in which maps are sent, as the detector takes: int8.")
    ] = None,
    compress: Annotated[bool, typer.Option("--compress", help="Send maps compressed.")] = False,
    api_key: trial.ApiKey = None,
    force: trial.Force = False,
) -> None:
    """Drive a simulated fleet, some of it hostile, through a running gateway."""
    torch.set_num_threads(1)
    console = Console()
    trial.make_folder(report, "--report", REPORT, force, for_pictures=True)
    with blaming("--attack", ValueError):
        campaign = attacks.load_campaign(attack)
    own = load_detector(detector)
    if attackers:
        check_attack(campaign, own)
    _check_dtype(dtype, own)
    _check_scenes(load_data(data), first_scene, scenes, frames, egos, attackers)
    chosen = {"attacker_ratio": attacker_ratio, "sampling_budget": sampling_budget, "collaborators": collaborators}
    asked = _asked(defense, {name: value for name, value in chosen.items() if value is not None})
    options = FleetOptions(
        url=url,
        scenes=scenes,
        frames=frames,
        first_scene=first_scene,
        egos=egos,
        attackers=attackers,
        attack=attack,
        detector=detector,
        defense=asked,
        seed=seed,
        budget_ms=budget_ms,
        real_time=real_time,
        report=report,
        api_key=api_key,
        data=data,
        truth=truth,
        packing=Packing(dtype, compress),
    )
    close_run(options, trial.run(run_fleet(options, console), console, "The fleet", ValueError), console)


def _check_scenes(source: SceneSource, first: int, scenes: int, frames: int, egos: int, attackers: int) -> None:
    """Refuse ids that no gateway takes, and what scenes do not have: so many of them, or frames, egos, attackers."""
    with blaming("--data", SceneError):
        there = source.scenes("test")
        if len(there) < first + scenes:
            option = "--first-scene" if first else "--scenes"
            told = f"{source.name} has {len(there)} test scenes; {first + scenes} are wanted"
            raise typer.BadParameter(told, param_hint=option)
        for scene in there[first : first + scenes]:
            if odd := [name for name in scene.agents if not re.fullmatch(ID_PATTERN, name)]:
                told = f"{source.name}, scene {scene.number}: a gateway takes no vehicle {odd[0]!r:.200}"
                raise SceneError(f"{told}; an id must match {ID_PATTERN}")
            if scene.length is not None and scene.length < frames:
                told = f"scene {scene.number} has {scene.length} frames; {frames} are wanted"
                raise typer.BadParameter(told, param_hint="--frames")
            if fault := team_fault(scene, egos, attackers):
                raise typer.BadParameter(fault[1], param_hint=f"--{fault[0]}")


def _check_dtype(dtype: str | None, detector: Detector) -> None:
    taken = {name for types in detector.info.narrower.values() for name in types}
    if dtype is not None and dtype not in taken:
        choices = ", ".join(sorted(taken)) or "none"
        raise typer.BadParameter(f"{detector.info.name} takes {choices}, not {dtype}", param_hint="--dtype")


def _asked(defense: str | None, given: dict[str, Any]) -> dict[str, Any] | None:
    """The ``defense`` of the sessions, where one is asked for; what the defence itself refuses need not be sent."""
    if defense is None:
        if given:
            raise typer.BadParameter("its settings need to know the kind of defence", param_hint="--defense")
        return None
    with blaming("--defense", ValueError):
        loaded = defenses.load(defense)
        asked = {**loaded.model_dump(mode="json", exclude_unset=True), "kind": loaded.kind, **given}
        defenses.read_settings(asked, {loaded.kind: type(loaded)})
    return asked


def close_run(options: FleetOptions, summary: FleetSummary, console: Console) -> None:
    """Write the report where one is wanted, and print the summary; whoever reads that may have gone."""
    picture = None
    if options.report is not None:
        settings = {name: value for name, value in asdict(options).items() if name not in ("report", "url", "api_key")}
        picture = summary.write(options.report, settings)
    summary.print(console)
    if options.report is not None:
        tell(console, f"Report: {options.report / REPORT} and {picture}")


if __name__ == "__main__":
    typer.run(main)
