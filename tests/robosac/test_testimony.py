"""What messages say of places, in whatever frame they are asked about."""

import numpy as np
import pytest

from robosac.boxes import pose_matrix
from robosac.testimony import ACROSS, ALONG, LAYERS, LIKELIHOOD, MOST, Testimony, X, Y, planar

SIZE, HALF = 8, 8.0  # places of 2 m
HERE, AWAY = pose_matrix(0, 0, 1.6, 0), pose_matrix(3.0, -2.0, 1.6, np.pi / 2)


def made(maps, poses=(HERE,), names=("", "a")):
    maps = np.asarray(maps, dtype=np.float32)
    over = np.zeros((len(maps), SIZE, SIZE), dtype=np.float32)
    return Testimony(names[: len(maps)], maps, planar(HERE, poses), over, HALF)


def slope(along_x, along_y, level=0.0):
    """L that rises by so much a metre."""
    x, y = np.meshgrid(*[(np.arange(SIZE) + 0.5) * 2 - HALF] * 2)
    maps = np.zeros((1, LAYERS, SIZE, SIZE))
    maps[0, LIKELIHOOD] = level + along_x * x + along_y * y
    return maps


def test_between_places_likelihood_is_bilinear(rng):
    points = rng.uniform(-HALF + 1, HALF - 1, (50, 2))
    found = made(slope(0.3, -0.2, 0.5)).likelihood(points)
    np.testing.assert_allclose(found, [0.5 + 0.3 * points[:, 0] - 0.2 * points[:, 1]], atol=1e-5)
    crossed = np.zeros((1, LAYERS, SIZE, SIZE))
    crossed[0, LIKELIHOOD, 4, 4] = 4.0  # at (1, 1)
    found = made(crossed).likelihood(np.array([[1.0, 1.0], [2.0, 1.0], [2.0, 0.0], [3.0, 1.0]]))
    np.testing.assert_allclose(found, [[4.0, 2.0, 1.0, 0.0]], atol=1e-6)


def test_outside_a_map_nothing_is_said():
    everywhere = made(slope(0, 0, 5.0))
    corners = np.array([[-7.0, 7.0], [7.0, -7.0]])
    np.testing.assert_allclose(everywhere.likelihood(corners), [[5.0, 5.0]])
    outside = np.array([[9.0, 0], [0, 9.0], [-9.0, 0], [0, -9.0], [1e4, -1e4]])
    np.testing.assert_array_equal(everywhere.likelihood(outside), np.zeros((1, 5)))
    assert 0.0 < everywhere.likelihood(np.array([[7.5, 0.0]]))[0, 0] < 5.0  # it fades at the rim


def test_likelihood_is_kept_within_bounds():
    found = made(np.concatenate([slope(0, 0, 80.0), slope(0, 0, -80.0)]), [HERE, HERE]).likelihood(np.zeros((1, 2)))
    np.testing.assert_array_equal(found, [[MOST], [-MOST]])


def test_places_are_asked_about_in_the_egos_frame():
    """A sender at (3, -2), headed along +y: what it has ahead of itself lies north of it."""
    said = made(np.concatenate([slope(0, 0), slope(0.5, 0.0)]), [HERE, AWAY])
    np.testing.assert_allclose(said.places(np.array([[3.0, 2.0]]))[1], [[4.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(said.places(np.array([[2.0, -2.0]]))[1], [[0.0, 1.0]], atol=1e-9)
    np.testing.assert_allclose(said.likelihood(np.array([[3.0, 2.0], [3.0, -5.0]]))[:, :], [[0, 0], [2.0, -1.5]])


def test_the_egos_own_pose_is_taken_off():
    """Both far away from where the world begins, and the ego turned."""
    ego, other = pose_matrix(500, 300, 1.6, np.pi), pose_matrix(496, 300, 1.6, np.pi)
    np.testing.assert_allclose(planar(ego, [ego, other])[1] @ [4.0, 0.0, 1.0], [0.0, 0.0, 1.0], atol=1e-9)


def test_a_sighting_is_in_the_egos_frame():
    """The sender's places of 2 m, and the offset that each tells."""
    maps = np.zeros((1, LAYERS, SIZE, SIZE))
    maps[0, X], maps[0, Y] = 0.5, -0.25
    maps[0, ALONG], maps[0, ACROSS] = np.log(0.4), np.log(0.1)
    maps[0, X, 4, 6] = 1.5  # of the sender's place at (5, 1)
    said = made(np.concatenate([maps, maps]), [HERE, AWAY])
    seen = said.sighting(np.array([[1.2, 0.7], [1.9, 2.9]]))
    np.testing.assert_allclose(seen.centre[0], [[1.5, 0.75], [1.5, 2.75]], atol=1e-6)
    # the sender has it in the place around (5, 1), so that the vehicle is at (6.5, .75): x = 3 - .75, y = -2 + 6.5
    np.testing.assert_allclose(seen.centre[1, 1], [2.25, 4.5], atol=1e-6)
    np.testing.assert_allclose(seen.along, 0.4, rtol=1e-5)
    np.testing.assert_allclose(seen.across, 0.1, rtol=1e-5)


@pytest.mark.parametrize("names", [("", "b"), ("b", ""), ()])
def test_that_of_some_is_as_before(names, rng):
    maps = rng.normal(size=(3, LAYERS, SIZE, SIZE))
    said = made(maps, [HERE, AWAY, pose_matrix(-1, 2, 1.6, 0.3)], ("", "a", "b"))
    points = rng.uniform(-6, 6, (9, 2))
    some = said.of(names)
    kept = [i for i, name in enumerate(said.agents) if name in names]
    assert some.agents == tuple(said.agents[i] for i in kept)
    np.testing.assert_array_equal(some.likelihood(points), said.likelihood(points)[kept])
    np.testing.assert_array_equal(some.sighting(points).centre, said.sighting(points).centre[kept])
    assert some.over_ego.shape == (len(kept), SIZE, SIZE)


def test_places_of_the_egos_map_are_a_grid():
    places = made(slope(0, 0)).ego_places()
    assert places.shape == (SIZE, SIZE, 2)
    np.testing.assert_allclose([places[0, 0], places[0, 1], places[1, 0]], [[-7, -7], [-5, -7], [-7, -5]])


def test_who_is_silenced_says_nothing_and_the_others_are_as_before(rng):
    said = made(rng.normal(size=(2, LAYERS, SIZE, SIZE)), [HERE, AWAY])
    said.over_ego[:] = 2.0
    points = rng.uniform(-6, 6, (9, 2))
    before = said.likelihood(points)
    less = said.silenced("")
    assert not less.likelihood(points)[0].any()
    assert not less.over_ego[0].any()
    assert less.unread == ("",)
    np.testing.assert_array_equal(less.likelihood(points)[1], before[1])
    np.testing.assert_array_equal(less.over_ego[1], said.over_ego[1])
    np.testing.assert_array_equal(said.likelihood(points), before)
    assert said.over_ego.all()


@pytest.mark.parametrize(("off", "agreed"), [(0.0, True), (0.8, True), (1.0, False)])
def test_they_agree_who_see_a_vehicle_in_one_place(off, agreed):
    maps = np.zeros((3, LAYERS, SIZE, SIZE))
    maps[:, Y] = np.array([0.0, 0.0, off])[:, None, None]
    said = made(maps, [HERE] * 3, ("", "a", "b"))
    points = np.array([[1.2, 0.7], [-2.9, 5.0]])
    centres, same = said.agreed(points, np.array([[True, False], [True, True], [True, False]]))
    np.testing.assert_allclose(centres, [[1.0, 1.0 + off / 3], [-3.0, 5.0]], atol=1e-6)
    assert same.tolist() == [agreed, True]  # one agrees with itself
