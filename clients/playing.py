"""Recordings played to a running gateway, at the speed at which they were recorded."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from typing import Any

from clients import trial
from clients.client import GatewayClient
from robosac.recording.reading import RecordedSession, RecordingError
from robosac.recording.truth import Truth


async def play_against(
    url: str, session: RecordedSession, defense: Mapping[str, Any] | None = None, api_key: str | None = None
) -> str:
    """Open a session like the recorded one and post its frames as they came; a sentence on what was answered.

    Draws are the gateway's own, so answers may differ from the recorded ones.

    Parameters
    ----------
    url : str
    session : RecordedSession
    defense : mapping, optional
        By default the recorded settings.
    api_key : str, optional

    Raises
    ------
    clients.errors.GatewayError
        If the gateway refuses something.
    RecordingError
        If messages were not recorded.
    """
    opening, frames = session.opening, session.frames
    if not frames:
        raise RecordingError(f"{session.files[0].path} has no frames")
    team = list(dict.fromkeys(name for frame in frames for name in frame.decided.team))
    async with GatewayClient(url, api_key) as gateway:
        opened = await gateway.open_session(
            opening.ego_id,
            team,
            detector=opening.detector,
            defense=opening.defense if defense is None else defense,
            latency_budget_ms=opening.latency_budget_ms,
            frame_period_ms=opening.frame_period_ms,
        )
        ego = gateway.vehicle(opened.session_id, opening.ego_id, opened.ego_token)
        began, same, in_time, latencies = time.monotonic(), 0, 0, []
        for frame in frames:
            messages = await asyncio.to_thread(frame.messages)
            await asyncio.sleep(began + (frame.time_ns - frames[0].time_ns) / 1e9 - time.monotonic())
            boxes = frame.true_boxes
            truth = None if boxes is None or frame.truth is None else Truth(boxes, frame.truth.attackers)
            asked = time.perf_counter()
            own = messages.pop(opening.ego_id)
            answer = await ego.post_frame(frame.number, own, messages, truth=truth)
            latencies.append((time.perf_counter() - asked) * 1e3)
            same += set(answer.accepted) == set(frame.answer.accepted)
            in_time += answer.deadline_met
        await ego.close()
    times = trial.percentiles(latencies)
    return (
        f"{opening.session_id}: {len(frames)} frames in {time.monotonic() - began:.1f} s; in {same} the same teammates "
        f"were accepted as recorded; {in_time} in time, median {times['p50']:.1f} ms, 99 % {times['p99']:.1f} ms"
    )
