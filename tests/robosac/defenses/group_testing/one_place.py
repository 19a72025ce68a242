"""Sessions in which what is said and shown of one place differs: who lies about it, and how."""

import json

import numpy as np

from robosac.answers import Verdict
from robosac.defenses import EGO, Outcome
from robosac.defenses.group_testing import GroupTesting
from tests.robosac.defenses.group_testing.conversing import TEAM, make_model, run_frame
from tests.robosac.testifying import saying

MODEL = make_model().with_lies
DEFENSE = GroupTesting(MODEL)
SEEN = np.array([[x, y, 4.5, 1.9, 0.0, 0.9] for x in (-22.4, -7.4, 7.6, 22.6) for y in (-12.3, 12.7)])
"""What everybody sees."""
PLACE = np.array([10.4, 2.3])
CAR = np.array([[*PLACE, 4.5, 1.9, 0.0, 0.85]])
YES, NO = 5.5, -7.0
LIAR = "car-4"


class World:
    """Cars that everybody sees, and one place over which they differ.

    Parameters
    ----------
    said : mapping of agent to float
        L of the place, the ego's under "".
    shows : callable
        A subset -> the boxes (n, 6) that its fusion shows there.
    speed : float
        At which all of them drive, metres a frame.
    team : sequence of str
        With the five that other tests are about among them.
    """

    def __init__(self, said, shows, speed=0.0, team=TEAM):
        known = {name: [(x, y, YES) for x, y in SEEN[:, :2]] for name in (EGO, *team)}
        for name, value in said.items():
            known[name].append((*PLACE, value))
        self.testimony = saying(known)
        self.shows = shows
        self.speed = speed
        self.team = team
        self.alone = SEEN
        """What the ego sees alone."""

    def judge(self, subset, _, frame):
        boxes = np.vstack([SEEN, self.shows(subset)])
        told = {"testimony": self.testimony, "alone": self.alone}
        pose = np.eye(4)
        pose[0, 3] = self.speed * frame
        return Outcome(subset, 0.93, Verdict.CONSENSUS, boxes, SEEN, pose, frame, **told)

    def play(self, frames, defense=DEFENSE, quiet=0, before=None):
        """Decisions, and the boxes of each subset decoded, of frames after some quiet ones in another world, by default
        one in which nobody lies.
        """
        state = (before or HONEST).play(quiet, defense)[-1][0].state if quiet else defense.initial_state(self.team)
        rng, met = np.random.default_rng(0), []
        for _ in range(frames):
            decision, tested = run_frame(defense, state, self.team, [], rng, judge=self.judge)
            state = json.loads(json.dumps(decision.state))
            met.append((decision, {o.teammates: o.boxes for o in tested}))
        return met


def nothing(subset):
    return CAR[:0]


def with_liar(shown, otherwise):
    """What a fusion shows with the liar, and without it."""
    return lambda subset: shown if LIAR in subset else otherwise


def seen_by(*names):
    """A fusion with any of them shows the car."""
    return lambda subset: CAR if set(names) & set(subset) else CAR[:0]


def erased(subset):
    return CAR[:0] if LIAR in subset else seen_by("car-2", "car-3", "rsu")(subset)


HONEST = World({}, nothing)
GHOST = World({EGO: -2.0, "car-2": NO, "car-3": NO, LIAR: YES}, with_liar(CAR, CAR[:0]))
ERASED = World({"car-2": YES, "car-3": YES, "rsu": YES, LIAR: NO}, erased)
NEAR, ASIDE = CAR + [0, 0.1, 0, 0, 0, 0], CAR + [0, 1.6, 0, 0, 0, 0]
MOVED = World({"car-2": YES, "car-3": YES, "rsu": YES}, with_liar(ASIDE, NEAR))
DRIVING_MOVED = World({"car-2": YES, "car-3": YES, "rsu": YES}, with_liar(ASIDE, NEAR), speed=1.0)
VEILED = World({EGO: -2.0, "car-2": NO, "car-3": NO, LIAR: NO}, with_liar(CAR, CAR[:0]))
DRIVING_VEILED = World({EGO: -2.0, "car-2": NO, "car-3": NO, LIAR: NO}, with_liar(CAR, CAR[:0]), speed=1.0)
SURE = CAR + [0, 0, 0, 0, 0, 0.1]
DRIVING_UNFOUNDED = World({LIAR: -0.5}, with_liar(SURE, CAR[:0]), speed=1.0)
UNSAID = World({"car-2": YES, "car-3": YES, "rsu": YES}, erased)


def there(decision, tested, boxes):
    """Judged boxes around the place, with their rows."""
    rows = [(judged, tested[judged.subset][judged.index]) for judged in boxes]
    return [(judged, row) for judged, row in rows if np.hypot(*(row[:2] - PLACE)) < 4.0]
