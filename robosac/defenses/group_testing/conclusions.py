"""What a frame's findings about objects say about who lies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from robosac.defenses.group_testing.differences import SAME_LIE_M, blame
from robosac.defenses.group_testing.findings import Findings, one_out
from robosac.defenses.group_testing.fusions import UNHEARD
from robosac.defenses.group_testing.lies import AUDIT_FRAMES, QUIET_FRAMES, Word
from robosac.defenses.group_testing.model import CELLS, CLEAN
from robosac.defenses.group_testing.objects import Lie
from robosac.defenses.group_testing.straying import strays
from robosac.defenses.protocol import Hypothesis

CLEARING = 1.5
"""What a frame in which nothing is wrong takes off the logarithm of the odds that one of those fused attacks."""
FEWEST_SEEN = 3
"""Whoever sees so many vehicles against the word of all others is not blind: one or two differ by where they end."""
CONFLICT_SCORE = 0.5
"""Conflicts are counted over boxes of this score."""
FEWEST_BESIDE = 3
"""Teammates beside whom another one is to blame for more than ghosts, if so many are heard: beside fewer, one honest
message more changes much.
"""
LEAST_CALM = 0.5
"""Evidence on objects is worth so much, at least, however unsteady the ego is."""


def conclude(found: Findings, answer: Hypothesis) -> None:
    """Who lied in this frame; the posterior learns it, and memory keeps it."""
    if found.hearing is None:
        return
    found.place(answer)
    blamed: dict[str, list[Lie]] = {name: [] for name in found.team}
    comparisons = _comparisons(found)
    heard = [name for name in found.team if name not in found.unheard]
    frame = found.known.memory.frame
    asked: dict[str, tuple[Hypothesis, Hypothesis]] = {}
    for joined, shown in found.shown.items():
        done = {
            suspect: found.effects(joined, without, (suspect,))
            for (fused, without), suspect in comparisons.items()
            if fused == joined
        }
        for suspect, lies in blame(done, shown).items():
            others = len(heard) - (suspect in heard)
            enough = len(joined) > max(1, min(FEWEST_BESIDE, others))
            if enough and len(joined) > len(asked.get(suspect, ((), ()))[0]):
                asked[suspect] = joined, tuple(name for name in joined if name != suspect)
            counting = [lie for lie in lies if enough or lie.counts_as == "ghost"]
            counting = [lie for lie in counting if found.calm or not lie.veiled]
            counting = _borne_out(found, suspect, joined, counting, others)
            found.note(joined, tuple(name for name in joined if name != suspect), counting)
            blamed[suspect] += counting
    for name, lie in _together(found, answer):
        blamed[name].append(lie)
    conflicts = _conflicts(found, answer)
    having_a_part = _having_a_part(found, answer)
    straying = _straying(found, asked, answer)
    _leave_alone(found, answer)
    _clear(found, comparisons)
    blameful = {name for name, lies in blamed.items() if lies}
    _doubt_ego(found, bool(blameful or conflicts))
    concerned = blameful | conflicts.keys() | having_a_part | straying.keys() | found.lies.levels.keys()
    for name in filter(concerned.__contains__, found.team):
        counts, lies = dict(conflicts.get(name, {})), blamed[name]
        if lies or name in having_a_part:
            found.lies.effects[name] = frame
        if lies and found.excused(name):
            lies = [replace(lie, along=True) for lie in lies]
        for kind in sorted({lie.counts_as for lie in lies}):
            of_kind = [lie for lie in lies if lie.counts_as == kind]
            places = [found.placed(lie.place) for lie in of_kind]
            counts[kind] = found.lies.counting(name, kind, places, frame)
            if any(lie.said for lie in of_kind):
                counts[kind] = 1
        weight, kinds = found.lies.add(name, counts), Counter(lie.counts_as for lie in lies)
        if straying.get(name, 0.0) > weight:  # no displacement counts twice
            found.known.memory.straying.note(name, (straying[name] - weight) * _worth(found))
            weight, kinds["straying"] = straying[name], 1
        if weight:
            _accuse(found, name, weight, kinds, lies, sum(conflicts.get(name, {}).values()))


def _borne_out(found: Findings, suspect: str, joined: Hypothesis, lies: Sequence[Lie], others: int) -> list[Lie]:
    """The lies that count by the word of those who say so, and are not another's; what is doubtful counts as late,
    which names nobody.
    """
    counting = []
    for lie in lies:
        words = {found.proof(joined, suspect, lie), found.lies.hear(suspect, lie.by, others)}
        if Word.NOTHING not in words:
            counting.append(replace(lie, along=True) if Word.DOUBTFUL in words else lie)
    return counting


def _together(found: Findings, answer: Hypothesis) -> list[tuple[str, Lie]]:
    """What several do together: who they are that vouch for a lie in the answer, where it is gone without all of them.
    Leaving out one of them alone does not put it right.
    """
    blamed = []
    for lie in found.lies_in(answer) if answer in found.shown else ():
        group = found.vouching(answer, lie)
        without = tuple(name for name in answer if name not in group)
        if group and without in found.shown:
            done = found.effects(answer, without, group)
            if any(np.hypot(*(each.place - lie.place)) <= SAME_LIE_M for each in done if each.kind == lie.kind):
                found.note(answer, without, [lie])
                blamed += [(name, lie) for name in group]
    return blamed


def _conflicts(found: Findings, answer: Hypothesis) -> dict[str, dict[str, int]]:
    """Boxes of the answer over which each teammate alone says the contrary of all others. Where the ego itself is
    unsteady, only those count over which it did not before: there honest mistakes are to be expected, and stay.

    Given by teammate and by the kind they count as. Whoever denies what all others see where its own message shows
    nothing, and sees nothing against their word elsewhere, may be blind there, as a scanner is behind a wall of its
    own: ``unseen``. What a late message says is ``late``.
    """
    if answer not in found.shown or found.hearing is None:
        return {}
    claims = found.shown[answer].everybody
    claims = claims.of_boxes(claims.boxes[:, 5] >= CONFLICT_SCORE)
    both = np.array(claims.in_conflict(found.unheard))
    conflicts = {claims.witnesses[i]: both[:, i] for i in np.flatnonzero(both.any(axis=(0, 2))).tolist()}
    frame, once = found.known.memory.frame, None if found.calm else 1
    counts: dict[str, dict[str, int]] = {}
    for name in filter(conflicts.__contains__, found.team):
        supported, denied = conflicts[name]
        if supported.any() and denied.any():
            found.lies.effects[name] = frame
        unseen = denied & found.hearing.everybody.is_empty(name, claims.boxes[:, :2])
        if unseen.any() and found.hearing.alone(name, found.unheard) >= FEWEST_SEEN:
            unseen[:] = False
        kinds = np.where(unseen, "unseen", "conflict")
        if found.excused(name):
            kinds[:] = "late"
        for kind in ("conflict", "unseen", "late"):
            places = [found.placed(box[:2]) for box in claims.boxes[(supported | denied) & (kinds == kind)]]
            counts.setdefault(name, {})[kind] = found.lies.counting(name, kind, places, frame, once)
    return counts


def _having_a_part(found: Findings, answer: Hypothesis) -> set[str]:
    """Those of the answer whose own messages go with something that is wrong in it."""
    if answer not in found.shown:
        return set()
    going = (found.shown[answer].going_with(lie) for lie in found.lies_in(answer) if lie.kind != "moved")
    return set(answer) & set(chain.from_iterable(going))


def _leave_alone(found: Findings, answer: Hypothesis) -> None:
    """What is wrong in the answer without anybody's doing: everybody was left out lately, or a hole is no loss. A hole
    that nobody speaks of who is fused tells nothing.
    """
    if answer not in found.shown or not found.lies_in(answer):
        return
    frame = found.known.memory.frame
    for name in one_out(answer, found.decoded):
        found.lies.left_out[name] = frame
    lying = any(found.lies.worst(name) for name in found.team)
    everybody = not lying and all(found.lies.recently_left_out(name, frame) for name in answer)
    for lie in found.unexplained(answer):
        witnesses = found.supporters(answer, lie) if lie.kind == "gone" else ()
        if lie.kind == "gone" and not witnesses:
            continue
        tested = lie.kind == "gone" and witnesses in found.decoded
        if everybody or (tested and not found.is_real(answer, witnesses, lie)):
            found.lies.leave_alone(found.placed(lie.place), frame)


def _straying(
    found: Findings, asked: Mapping[str, tuple[Hypothesis, Hypothesis]], answer: Hypothesis
) -> dict[str, float]:
    """What it adds to suspicion how much each of those strays who were left out of a fusion (`asked`), where it adds
    anything. What is known of somebody who is not in the answer fades once it was not asked for some frames: else it
    would never be back where too few are left to ask it beside.
    """
    memory, weights = found.known.memory, dict[str, float]()
    for name, (joined, without) in asked.items():
        anew = memory.frame - found.lies.audited.get(name, -AUDIT_FRAMES) >= AUDIT_FRAMES
        by = strays(found.shown[joined], found.shown[without], name)
        if weight := memory.straying.learn(name, by, anew=anew):
            weights[name] = weight
        found.lies.audited[name] = memory.frame
    for name in set(found.team) & memory.straying.levels.keys() - set(answer) - found.named:
        if memory.frame - found.lies.audited.get(name, -QUIET_FRAMES) >= QUIET_FRAMES:
            memory.straying.fade(name)
    return weights


def _doubt_ego(found: Findings, anything_wrong: bool) -> None:
    """Learn whether the ego's own message is late; where nothing seems wrong it does no harm."""
    memory = found.known.memory
    if memory.placing.ego_astray:
        return
    if (anything_wrong or memory.ego_is_late) and found.ego_late:
        memory.ego_late = memory.frame


def _comparisons(found: Findings) -> dict[tuple[Hypothesis, Hypothesis], str]:
    """Pairs of decoded fusions of which the first has one teammate more, and who that is.

    Beside somebody who is all but certain to attack, what another one changes is no lie of its own: an
    attacker's boxes come and go with whoever is fused with it.
    """
    suspicion = found.known.suspicion()
    return {
        (joined, without): suspect
        for joined in found.shown
        for suspect, without in one_out(joined, found.shown).items()
        if all(suspicion[name] <= UNHEARD for name in without)
    }


def _accuse(
    found: Findings, name: str, weight: float, kinds: Mapping[str, int], lies: Sequence[Lie], conflicts: int
) -> None:
    """A piece of evidence on one teammate: all kinds of attack explain it alike."""
    log_likelihood = np.zeros(CLEAN + CELLS * len(found.known.model.kinds))
    log_likelihood[CLEAN:] = weight * _worth(found)
    before = found.known.suspicion()[name]
    nobody, one = found.known.rows([(), (name,)])
    found.known.posterior.update(nobody, one, log_likelihood)
    after = found.known.suspicion()[name]
    ratio = np.log(max(after, 1e-9) / max(1 - after, 1e-9)) - np.log(max(before, 1e-9) / max(1 - before, 1e-9))
    places = [found.placed(lie.place).round(2).tolist() for lie in lies[:4]]
    found.known.memory.add_evidence(
        name,
        {
            "frame": found.known.memory.frame,
            "test": "objects",
            "teammates": [name],
            "kinds": dict(sorted(kinds.items())),
            "conflicts": conflicts,
            "places": places,
            "log_likelihood_ratio": round(float(ratio), 3),
        },
    )


def _worth(found: Findings) -> float:
    """What evidence on objects counts for, by how steady the ego is."""
    return max(LEAST_CALM, found.known.memory.steadiness.calm)


def _clear(found: Findings, comparisons: Mapping[tuple[Hypothesis, Hypothesis], str]) -> None:
    """Where nothing is wrong with any object, whoever is fused is less likely to attack: the most of them that were
    fused so. Where something is, so is whoever has no part in it (`_harmless`). Holes count only where vehicles were
    taken away.
    """
    largest_first = sorted(found.shown, key=len, reverse=True)
    best = next((subset for subset in largest_first if not _wrong(found, subset)), ())
    harmless = _harmless(found, comparisons)
    straying = found.known.memory.straying
    unsuspicious = [name for name in found.team if name in best or name in harmless]
    cleared = tuple(name for name in unsuspicious if not found.lies.doubted(name) and not straying.rising(name))
    if not cleared:
        return
    log_likelihood = np.zeros(CLEAN + CELLS * len(found.known.model.kinds))
    log_likelihood[CLEAN:] = -CLEARING
    nobody, all_of_them = found.known.rows([(), cleared])
    found.known.posterior.update(nobody, all_of_them, log_likelihood)


def _harmless(found: Findings, comparisons: Mapping[tuple[Hypothesis, Hypothesis], str]) -> set[str]:
    """Who was left out of fusions of enough others without putting anything right, and does not say what is wrong
    there: of two that lie together, leaving out one does not help.
    """
    harmless, has_a_part = set[str](), set[str]()
    for (joined, without), suspect in comparisons.items():
        if len(without) >= FEWEST_BESIDE:
            says_so = any(found.shown[joined].goes_with(suspect, lie) for lie in found.lies_in(joined))
            (has_a_part if says_so or found.effects(joined, without, (suspect,)) else harmless).add(suspect)
    return harmless - has_a_part


def _wrong(found: Findings, fused: Hypothesis) -> bool:
    return any(lie.kind != "gone" or _is_lost(found, fused, lie) for lie in found.lies_in(fused))


def _is_lost(found: Findings, fused: Hypothesis, hole: Lie) -> bool:
    """Whether some decoded part of a fusion shows the vehicle of a hole."""
    parts = [part for part in found.shown if set(part) < set(fused)]
    return any(found.is_real(fused, part, hole) for part in parts)
