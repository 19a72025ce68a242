"""Places to learn from: what is there, and how well a scan has seen it."""

import numpy as np
import pytest

from robosac.boxes import pairwise_iou
from robosac.calibration.places import (
    FREE_PLACES,
    JITTER_M,
    NEAR_PLACES,
    OBSERVED_HITS,
    OWN_BODY_M,
    STANDARD,
    hits,
    places,
)
from robosac.scenes import IntersectionScene, View

HEIGHT_M = 1.8
AHEAD = np.array([[12.0, 0.0, *STANDARD[:2], 0.0]])


def scan(*walls):
    """A scanner over flat ground; walls are (x, half width, height above ground), across the way ahead."""
    azimuth = np.deg2rad(np.arange(-180, 180, 0.5))
    returns = []
    for down in np.deg2rad(np.arange(1.0, 20.0, 0.5)):
        reach = np.full(len(azimuth), HEIGHT_M / np.tan(down))
        for x, half, height in walls:
            ahead = np.abs(azimuth) < np.pi / 2
            at = x / np.where(ahead, np.cos(azimuth), 1.0)
            meets = ahead & (np.abs(at * np.sin(azimuth)) < half) & (HEIGHT_M - at * np.tan(down) < height)
            reach = np.where(meets, np.minimum(reach, at), reach)
        returns.append(np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), -reach * np.tan(down)]))
    points = np.concatenate(returns)
    return View(np.eye(4), points[np.hypot(points[:, 0], points[:, 1]) < 60].astype(np.float32))


def test_a_place_in_the_open_is_hit_often_and_one_behind_a_wall_never():
    assert hits(scan(), AHEAD)[0] > 50
    assert hits(scan((6.0, 5.0, 3.0)), AHEAD)[0] == 0
    behind = AHEAD + [-24.0, 0, 0, 0, 0]
    assert hits(scan((6.0, 5.0, 3.0)), behind)[0] == hits(scan(), behind)[0]


def test_what_is_seen_in_the_place_itself_counts():
    """A wall where the car's rear would be: its returns are the car's."""
    inside, behind = hits(scan((10.5, 5.0, 3.0)), AHEAD)[0], hits(scan((16.0, 5.0, 3.0)), AHEAD)[0]
    assert inside > 0.9 * behind > OBSERVED_HITS


def test_over_a_low_wall_a_part_is_seen():
    """A wall of .9 m, 6 m ahead, hides the lower part of a car, and not its roof."""
    whole, part = hits(scan(), AHEAD)[0], hits(scan((6.0, 5.0, 0.9)), AHEAD)[0]
    assert 0 < part < whole


def test_rays_that_end_short_of_a_car_are_no_hits():
    """A car across the way, and a wall just before it."""
    across = AHEAD + [0, 0, 0, 0, np.pi / 2]
    assert hits(scan((10.5, 5.0, 3.0)), across)[0] == 0
    assert hits(scan((11.5, 5.0, 3.0)), across)[0] > OBSERVED_HITS


@pytest.mark.parametrize(("height", "counted"), [(1.75, 0), (1.0, 21)])
def test_rays_over_a_car_are_no_hits(height, counted):
    """Returns of a wall far behind: those from high up have passed over the car's roof."""
    wall = np.column_stack([np.full(21, 40.0), np.linspace(-2, 2, 21), np.full(21, height - HEIGHT_M)])
    ground = np.column_stack([np.full(200, -9.0), np.linspace(-9, 9, 200), np.full(200, -HEIGHT_M)])
    assert hits(View(np.eye(4), np.concatenate([wall, ground])), AHEAD)[0] == counted


def test_farther_places_are_hit_less():
    found = hits(scan(), np.array([[x, 3.0, *STANDARD[:2], 0.3] for x in (8.0, 16.0, 30.0)]))
    assert found[0] > found[1] > found[2] > 0


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((5, 3))])
def test_without_returns_nothing_is_hit(points):
    np.testing.assert_array_equal(hits(View(np.eye(4), points), AHEAD), [0])
    assert len(hits(scan(), AHEAD[:0])) == 0


def test_places_are_where_vehicles_are_and_where_none_is():
    frame = IntersectionScene(1600).frame(0)
    truth = frame.truth("car-2")[:, :5]
    known = places(frame.views["car-2"], truth, 32.0, np.random.default_rng(0))
    vehicles = known.vehicle > 0
    assert 0 < vehicles.sum() <= len(truth)
    assert 0.6 * FREE_PLACES < (~vehicles).sum() - NEAR_PLACES <= FREE_PLACES
    for box in known.box[vehicles]:
        assert (np.abs(truth - box).max(axis=1) < 1e-9).any()
    assert np.hypot(*(known.at - known.box[:, :2])[vehicles].T).max() < 5 * JITTER_M
    assert not known.box[~vehicles].any()
    free = np.column_stack([known.at, np.full((len(known.at), 3), [0.1, 0.1, 0.0])])[~vehicles]
    shrunk = truth + [0, 0, -0.5, -0.5, 0]
    assert pairwise_iou(free, shrunk).max() == 0
    assert np.hypot(*known.at.T).min() > OWN_BODY_M - 5 * JITTER_M
    assert np.abs(known.at).max() < 32.0
    assert (known.hits >= OBSERVED_HITS).any()
    assert (known.hits < OBSERVED_HITS).any()


def test_the_same_draws_give_the_same_places():
    frame = IntersectionScene(1600).frame(0)
    view, truth = frame.views["rsu"], frame.truth("rsu")[:, :5]
    one, again, other = (places(view, truth, 32.0, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.at, again.at)
    assert one.at.shape != other.at.shape or not np.array_equal(one.at, other.at)


def test_some_free_places_are_right_beside_vehicles():
    lone = np.array([[15.0, 5.0, *STANDARD[:2], 0.7]])
    known = places(scan(), lone, 32.0, np.random.default_rng(0))
    off = (known.at - lone[0, :2])[known.vehicle == 0] @ np.array(
        [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]
    )
    near = (np.abs(off) < np.array([6.5, 4.5]) + 4 * JITTER_M).all(axis=1)
    assert near.sum() >= NEAR_PLACES
    aside = np.abs(off[near, 1])[np.abs(off[near, 0]) < 3.0]
    assert len(aside) >= 3
    assert aside.min() > STANDARD[1]
    assert aside.min() < 3.5


def test_where_no_vehicle_is_places_are_anywhere():
    known = places(scan(), np.zeros((0, 5)), 32.0, np.random.default_rng(0))
    assert len(known.at) > 0
    assert not known.vehicle.any()
