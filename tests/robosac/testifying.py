"""Hand-made testimony: who says what of which place."""

import numpy as np
from scipy.spatial.distance import cdist

from robosac.boxes import pose_matrix
from robosac.detectors.witness import as_testimony
from robosac.testimony import ACROSS, ALONG, LAYERS, LIKELIHOOD, Testimony, X, Y, planar

HALF_EXTENT_M = 32.0
SIZE = 64
SPREAD_M = 2.5
"""What is said of a place is said of all within so far."""
SLOPE = 0.05
"""And a little less firmly, by so much a metre: the place itself is a peak."""


def saying(said, poses=None, seen=None) -> Testimony:
    """What agents say, from the `Testimony` of a network that knows it all.

    Parameters
    ----------
    said : mapping of agent to sequence of (x, y, L)
        Places in the ego's frame; the ego, "", first. Elsewhere L is 0.
    poses : mapping of agent to (4, 4) ndarray
        By default everybody stands where the ego does.
    seen : mapping of agent to (n, 2) sequence
        Centres of the vehicles that the agent sees, ego frame; each place tells the nearest. By default the places that
        it speaks of with L > 0.
    """
    agents = tuple(said)
    stands = [(poses or {}).get(name, pose_matrix(0, 0, 0, 0)) for name in agents]
    from_ego = planar(stands[agents.index("")], stands)
    centres = (np.arange(SIZE) + 0.5) * (2 * HALF_EXTENT_M / SIZE) - HALF_EXTENT_M
    x, y = np.meshgrid(centres, centres)
    maps = np.zeros((len(agents), LAYERS, SIZE, SIZE), dtype=np.float16)
    maps[:, [ALONG, ACROSS]] = np.log(0.2)
    for index, name in enumerate(agents):
        places = np.reshape(np.asarray(said[name], dtype=np.float64), (-1, 3))
        for place in places:
            px, py = from_ego[index, :2, :2] @ place[:2] + from_ego[index, :2, 2]
            near = tuple(slice(*np.searchsorted(centres, (at - SPREAD_M, at + SPREAD_M))) for at in (py, px))
            far = np.hypot(x[near] - px, y[near] - py)
            firmly = place[2] - SLOPE * np.sign(place[2]) * far
            maps[index, LIKELIHOOD][near] = np.where(far <= SPREAD_M, firmly, maps[index, LIKELIHOOD][near])
        known = np.reshape((seen or {}).get(name, places[places[:, 2] > 0, :2]), (-1, 2))
        if len(known):
            known = known @ from_ego[index, :2, :2].T + from_ego[index, :2, 2]
            nearest = cdist(known, np.column_stack([x.ravel(), y.ravel()])).argmin(axis=0).reshape(x.shape)
            maps[index, X], maps[index, Y] = known[nearest, 0] - x, known[nearest, 1] - y
    return as_testimony(agents, maps, from_ego, HALF_EXTENT_M)
