"""Inspects the objects of a frame: whom to leave out to see who is behind a false one, and who lied."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

import numpy as np

from robosac.boxes import FloatArray
from robosac.defenses.group_testing.claims import SUPPORTS, Claims
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.lies import Lies
from robosac.defenses.group_testing.model import CELLS, CLEAN, LIE
from robosac.defenses.group_testing.objects import REACH_M, SAME_LIE_M, Hearing, Lie, Shown, blame, effects, gone
from robosac.defenses.group_testing.standing import Judged, judge
from robosac.defenses.protocol import Hypothesis, Outcome
from robosac.testimony import Testimony

SUSPECT = 0.5
"""Who is suspected more than this, and not named, is asked again each frame, so as to be cleared or named."""
UNHEARD = 0.9
"""The testimony of those suspected more than this counts for nothing."""
CLEARING = 1.5
"""What a frame in which nothing is wrong takes off the logarithm of the odds that one of those fused lies."""
CONFLICT_SCORE = 0.5
"""Conflicts are counted over boxes of this score."""


class Inspection:
    """The objects of one frame while it is judged.

    Parameters
    ----------
    known : Knowledge
    lies : Lies
        Changed in place.
    team : tuple of str
        Teammates present.
    named : collection of str
        Held to be attackers before this frame.
    keep_contradicted : bool
        Whether boxes that are contradicted stay in the answer.
    """

    def __init__(
        self, known: Knowledge, lies: Lies, team: Hypothesis, named: Collection[str], keep_contradicted: bool
    ) -> None:
        self._known = known
        self._keep_contradicted = keep_contradicted
        self._lies = lies
        self._team = team
        self._unheard = {name for name, p in known.suspicion().items() if name in named or p > UNHEARD}
        self._named = frozenset(named)
        self._shown: dict[Hypothesis, Shown] = {}
        self._decoded: set[Hypothesis] = set()
        self._hearing: Hearing | None = None
        self._pose: FloatArray = np.eye(4)

    def learn(self, outcome: Outcome) -> Shown | None:
        """Take in a decoded subset; what it shows is given back, checked, if there is testimony to check it by."""
        self._decoded.add(outcome.teammates)
        if outcome.testimony is None or outcome.boxes is None:
            return None
        if self._hearing is None:
            self._hearing = Hearing(outcome.testimony, self._unheard)
        if outcome.pose is not None:
            self._pose = outcome.pose
        shown = self._shown[outcome.teammates] = Shown(outcome.teammates, outcome.boxes, self._hearing)
        return shown

    def next_test(self, answer: Hypothesis) -> Hypothesis | None:
        """The subset to decode next, to see who is behind what is wrong; None if nothing is, or all is explained."""
        for subset in self._again(answer):
            if subset not in self._decoded:
                return subset
        if answer not in self._shown:
            return None
        lies = self._unexplained(answer) or self._hardly_explained(answer)
        holes = [lie for lie in lies if lie.kind == "gone"]
        if holes and len(holes) == len(lies):
            witnesses = self._supporters(answer, holes[0])
            if witnesses and witnesses not in self._decoded:
                return witnesses
            lies = [lie for lie in holes if self._is_real(answer, witnesses, lie)]
        if not lies:
            return None
        for suspect in self._candidates(answer, lies):
            without = tuple(name for name in answer if name != suspect)
            if without and without not in self._decoded:
                return without
        return None

    def conclude(self, answer: Hypothesis) -> None:
        """Who lied in this frame; the posterior learns it, and memory keeps it."""
        if self._hearing is None:
            return
        blamed: dict[str, list[Lie]] = {name: [] for name in self._team}
        comparisons = self._comparisons()
        for joined, shown in self._shown.items():
            found = {
                suspect: effects(shown, self._shown[without], suspect)
                for (fused, without), suspect in comparisons.items()
                if fused == joined
            }
            for suspect, lies in blame(found, shown).items():
                blamed[suspect] += lies
        conflicts = self._conflicts(answer)
        self._leave_alone(answer)
        self._clear()
        for name in self._team:
            counts = dict.fromkeys({lie.kind for lie in blamed[name]}, 1) | {"conflict": conflicts[name]}
            weight = self._lies.add(name, counts)
            if weight:
                self._accuse(name, weight, blamed[name], conflicts[name])

    def judged(self, answer: Hypothesis) -> Judged | None:
        """How each box of an answer stands; None where nothing is known of objects."""
        if answer not in self._shown:
            return None
        objects, contradicted = judge(self._shown[answer], list(self._shown.values()))
        return ((*objects, *contradicted), ()) if self._keep_contradicted else (objects, contradicted)

    def _leave_alone(self, answer: Hypothesis) -> None:
        """What is wrong in the answer without anybody's doing: everybody was left out lately, or a hole is no loss."""
        frame = self._known.memory.frame
        for name in answer:
            if tuple(other for other in answer if other != name) in self._decoded:
                self._lies.left_out[name] = frame
        lying = any(self._lies.worst(name) for name in self._team)
        everybody = not lying and all(self._lies.recently_left_out(name, frame) for name in answer)
        for lie in self._unexplained(answer) if answer in self._shown else ():
            witnesses = self._supporters(answer, lie) if lie.kind == "gone" else ()
            tested = lie.kind == "gone" and (not witnesses or witnesses in self._decoded)
            if everybody or (tested and not self._is_real(answer, witnesses, lie)):
                self._lies.leave_alone(self._placed(lie.place), frame)

    def _again(self, answer: Hypothesis) -> list[Hypothesis]:
        """What is to be decoded to ask those again that are neither in the answer nor named: of those only in doubt,
        beside the answer, in one frame as many together as are more likely all honest than not, in the next the least
        suspected; each of the two most suspected ones, or that lied lately, alone and beside the answer.
        """
        posterior, suspicion = self._known.posterior, self._known.suspicion()
        left = [name for name in self._team if name not in answer and name not in self._named]
        left.sort(key=lambda name: suspicion[name])
        suspects = [name for name in left if suspicion[name] > SUSPECT or self._lies.worst(name)]
        doubtful = [name for name in left if name not in suspects]
        groups = [self._with(answer, doubtful[:count]) for count in range(len(doubtful), 0, -1)]
        asked = groups[-1:]
        turn = self._hearing is None or self._known.memory.frame % 2 == 0  # a liar among them would spoil every test
        if len(groups) > 1 and turn:
            honest = posterior.unattacked(posterior.masks(self._known.rows(groups))) >= SUSPECT
            asked = [groups[int(honest.argmax())]] if honest.any() else asked
        for suspect in suspects[-2:][::-1]:
            asked += [(suspect,), self._with(answer, [suspect])]
        return asked

    def _with(self, answer: Hypothesis, others: Collection[str]) -> Hypothesis:
        """The answer and others, in the order of the team."""
        return tuple(name for name in self._team if name in answer or name in others)

    def _supporters(self, answer: Hypothesis, hole: Lie) -> Hypothesis:
        """The two of those fused who support a vehicle in a hole most, in the order of the team."""
        testimony = self._said()
        said = dict(zip(testimony.agents, testimony.likelihood(hole.place[None])[:, 0].tolist(), strict=True))
        most = sorted((name for name in answer if said[name] >= SUPPORTS), key=lambda name: -said[name])[:2]
        return tuple(name for name in answer if name in most)

    def _is_real(self, answer: Hypothesis, witnesses: Hypothesis, hole: Lie) -> bool:
        """Whether those who support a vehicle in a hole show it without the others: else nobody has taken it away."""
        if witnesses not in self._shown:
            return False
        part = self._shown[witnesses]
        found = part.boxes[gone(self._shown[answer], part, None)]
        return bool(len(found)) and bool(np.hypot(*(found[:, :2] - hole.place).T).min() <= REACH_M)

    def _comparisons(self) -> dict[tuple[Hypothesis, Hypothesis], str]:
        """Pairs of decoded fusions of which the first has one teammate more, and who that is.

        Beside somebody who is all but certain to attack, what another one changes is no lie of its own: an
        attacker's boxes come and go with whoever is fused with it.
        """
        suspicion = self._known.suspicion()
        found = {}
        for joined in self._shown:
            for suspect in joined:
                without = tuple(name for name in joined if name != suspect)
                if without in self._shown and all(suspicion[name] <= UNHEARD for name in without):
                    found[joined, without] = suspect
        return found

    def _unexplained(self, answer: Hypothesis) -> list[Lie]:
        """What is wrong in the answer and not remembered as nobody's, and in no decoded fusion without one of them is
        put right.
        """
        lies = self._lies_in(answer)
        for suspect in answer:
            without = tuple(name for name in answer if name != suspect)
            if lies and without in self._shown:
                done = effects(self._shown[answer], self._shown[without], suspect)
                lies = [a for a in lies if all(np.hypot(*(a.place - b.place)) > SAME_LIE_M for b in done)]
        return lies

    def _lies_in(self, answer: Hypothesis) -> list[Lie]:
        """What is wrong in the answer, and not remembered as nobody's doing."""
        frame = self._known.memory.frame
        return [lie for lie in self._shown[answer].lies if not self._lies.is_quiet(self._placed(lie.place), frame)]

    def _hardly_explained(self, answer: Hypothesis) -> list[Lie]:
        """What is wrong in the answer, and explained, while only one of those fused was left out: what two do together
        is explained by either.
        """
        left_out = sum(tuple(other for other in answer if other != name) in self._shown for name in answer)
        return self._lies_in(answer) if left_out == 1 and len(answer) > 1 else []

    def _candidates(self, answer: Hypothesis, lies: Sequence[Lie]) -> list[str]:
        """Who may be behind them, the likeliest first: those suspected already, and those whose own testimony goes with
        the lie. Who was left out lately comes after the others.
        """
        testimony = self._said()
        said = testimony.likelihood(np.stack([lie.place for lie in lies]))
        sign = np.array([-1.0 if lie.kind == "gone" else 1.0 for lie in lies])
        suspicion = self._known.suspicion()
        own = dict(zip(testimony.agents, (said * sign).sum(axis=1).tolist(), strict=True))
        frame = self._known.memory.frame

        def unlikely(name: str) -> tuple[bool, float]:
            again = self._lies.recently_left_out(name, frame) and not self._lies.worst(name)
            return again, -(10 * self._lies.worst(name) + 10 * suspicion[name] + own[name])

        return sorted(answer, key=unlikely)

    def _conflicts(self, answer: Hypothesis) -> dict[str, int]:
        """Boxes of the answer over which each teammate alone says the contrary of all others."""
        if answer not in self._shown:
            return dict.fromkeys(self._team, 0)
        boxes = self._shown[answer].boxes
        claims = Claims.of(boxes[boxes[:, 5] >= CONFLICT_SCORE], self._said())
        return {name: claims.conflicts(name, self._unheard) for name in self._team}

    def _said(self) -> Testimony:
        """What everybody says."""
        if self._hearing is None:
            raise RuntimeError("there is no testimony yet")
        return self._hearing.everybody

    def _accuse(self, name: str, weight: float, lies: Sequence[Lie], conflicts: int) -> None:
        """A piece of evidence on one teammate: all kinds of attack explain it alike."""
        kinds = len(self._known.model.kinds)
        log_likelihood = np.zeros(CLEAN + CELLS * kinds)
        log_likelihood[CLEAN:] = weight
        before = self._known.suspicion()[name]
        nobody, one = self._known.rows([(), (name,)])
        self._known.posterior.update(nobody, one, log_likelihood)
        after = self._known.suspicion()[name]
        ratio = np.log(max(after, 1e-9) / max(1 - after, 1e-9)) - np.log(max(before, 1e-9) / max(1 - before, 1e-9))
        places = [self._placed(lie.place).round(2).tolist() for lie in lies[:4]]
        self._known.memory.add_evidence(
            name,
            {
                "frame": self._known.memory.frame,
                "test": "objects",
                "teammates": [name],
                "kinds": dict(sorted(Counter(lie.kind for lie in lies).items())),
                "conflicts": conflicts,
                "places": places,
                "log_likelihood_ratio": round(float(ratio), 3),
            },
        )

    def _clear(self) -> None:
        """Where nothing is wrong with any object, whoever is fused is less likely to lie: the most of them that were
        fused so. Holes count only where vehicles were taken away.
        """
        clean = [subset for subset, shown in self._shown.items() if not self._wrong(shown)]
        best = max(clean, key=len, default=())
        if not best:
            return
        model = self._known.model
        log_likelihood = np.zeros(CLEAN + CELLS * len(model.kinds))
        first = CLEAN + CELLS * model.kinds.index(LIE)
        log_likelihood[first : first + CELLS] = -CLEARING
        for name in (name for name in best if not self._lies.worst(name)):
            nobody, one = self._known.rows([(), (name,)])
            self._known.posterior.update(nobody, one, log_likelihood)

    def _wrong(self, shown: Shown) -> bool:
        frame = self._known.memory.frame
        lies = [lie for lie in shown.lies if not self._lies.is_quiet(self._placed(lie.place), frame)]
        return any(lie.kind != "gone" or self._is_lost(shown, lie) for lie in lies)

    def _is_lost(self, shown: Shown, hole: Lie) -> bool:
        """Whether some decoded part of a fusion shows the vehicle of a hole."""
        parts = [part for part in self._shown if set(part) < set(shown.teammates)]
        return any(self._is_real(shown.teammates, part, hole) for part in parts)

    def _placed(self, place: FloatArray) -> FloatArray:
        """A place (2,) of the ego's frame in the world."""
        placed: FloatArray = self._pose[:2, :2] @ place + self._pose[:2, 3]
        return placed
