import numpy as np
import pytest
import shapely
from hypothesis import example, given
from hypothesis import strategies as st

from robosac import boxes as geometry
from robosac.boxes import corners, from_world, in_units, laid_iou, nms, pairwise_iou, pose_fault, pose_matrix, to_world
from tests.robosac.rectangles import from_corners

coordinate = st.floats(-20, 20)
side = st.floats(0.05, 12)
angle = st.floats(-10, 10)
box = st.tuples(coordinate, coordinate, side, side, angle)


def shapely_iou(a, b):
    p, q = shapely.polygons(corners(a)), shapely.polygons(corners(b))
    # without a grid edges that lie on one another may make it find nothing in common
    intersection = shapely.area(shapely.intersection(p[:, None], q[None, :], grid_size=1e-10))
    return intersection / (shapely.area(p)[:, None] + shapely.area(q)[None, :] - intersection)


@given(st.lists(box, min_size=1, max_size=8), st.lists(box, min_size=1, max_size=8))
@example([(3.0, 12.0, 4.0, 10.5, 2.625)], [(3.0, 12.0, 10.0, 10.5, 2.625)])
def test_iou_agrees_with_polygon_clipping(a, b):
    a, b = np.array(a), np.array(b)
    np.testing.assert_allclose(pairwise_iou(a, b), shapely_iou(a, b), atol=1e-7)


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, -np.pi, 1e-9, 0.3])
def test_iou_of_degenerate_pairs(yaw):
    one = np.array([[1.0, 2.0, 4.0, 2.0, yaw]])
    beside = one + [[4.0 * np.cos(yaw), 4.0 * np.sin(yaw), 0, 0, 0]]
    inside = one * [[1, 1, 0.5, 0.5, 1]]
    turned = one + [[0, 0, 0, 0, np.pi]]
    assert pairwise_iou(one, one) == pytest.approx(1.0)
    assert pairwise_iou(one, turned) == pytest.approx(1.0)
    assert pairwise_iou(one, beside) == pytest.approx(0.0, abs=1e-9)
    assert pairwise_iou(one, inside) == pytest.approx(0.25)
    assert pairwise_iou(inside, one) == pytest.approx(0.25)


def test_iou_of_nothing_and_of_flat_boxes():
    flat = np.array([[0.0, 0.0, 4.0, 0.0, 0.2]])
    assert pairwise_iou(np.empty((0, 5)), flat).shape == (0, 1)
    assert pairwise_iou(flat, flat).tolist() == [[0.0]]


@given(st.lists(st.tuples(box, box), max_size=8))
def test_boxes_laid_on_one_another_overlap_by_their_shapes(pairs):
    a, b = (np.array(boxes).reshape(-1, 5) for boxes in (list(zip(*pairs, strict=True)) or [(), ()]))
    laid = b.copy()
    laid[:, :2] = a[:, :2]
    np.testing.assert_allclose(laid_iou(a, b), np.diag(pairwise_iou(a, laid)), atol=1e-12)


@given(box)
def test_corners_and_back(values):
    original = np.array([values])
    again = from_corners(corners(original))
    np.testing.assert_allclose(again[:, :4], original[:, :4], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * again[:, 4]), -np.exp(1j * original[:, 4]), atol=1e-6)


def test_corners_are_counter_clockwise():
    points = corners(np.array([[3.0, -1.0, 4.0, 2.0, 0.7]]))[0]
    assert shapely.Polygon(points).exterior.is_ccw


def test_from_world_inverts_the_pose():
    pose = pose_matrix(10.0, -3.0, 1.7, 2.5)
    moved = from_world(np.array([[12.0, 0.0, 4.0, 2.0, 3.0, 0.9]]), pose)
    back = pose @ np.array([moved[0, 0], moved[0, 1], -1.7, 1.0])
    np.testing.assert_allclose(back[:2], [12.0, 0.0], atol=1e-12)
    assert moved[0, 4] == pytest.approx(0.5)
    assert moved[0, 5] == 0.9
    turned = from_world(np.array([[0.0, 0.0, 4.0, 2.0, -2.0]]), pose_matrix(0.0, 0.0, 0.0, 0.5))
    assert turned[0, 4] == pytest.approx(-2.5)


def greedy_nms(boxes, scores, threshold):
    kept = []
    for i in np.argsort(-scores, kind="stable"):
        if all(shapely_iou(boxes[[i]], boxes[[k]])[0, 0] <= threshold for k in kept):
            kept.append(int(i))
    return kept


@pytest.mark.parametrize("n", [0, 1, 30, 200])
def test_nms_is_greedy(n, rng):
    boxes = np.column_stack([rng.uniform(-15, 15, (n, 2)), rng.uniform(1, 6, (n, 2)), rng.uniform(-3, 3, n)])
    scores = rng.choice([0.2, 0.5, 0.9], n)
    assert nms(boxes, scores, 0.1).tolist() == greedy_nms(boxes, scores, 0.1)


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_to_world_is_the_inverse_of_from_world_whatever_the_tilt(tilt):
    tilted = np.eye(4)
    tilted[:3, :3] = [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
    pose = pose_matrix(10.0, -3.0, 1.7, 2.5) @ tilted
    boxes = np.array([[12.0, 5.0, 4.0, 2.0, 3.0, 0.9], [-7.0, 0.5, 4.0, 2.0, -1.0, 0.5]])
    np.testing.assert_allclose(from_world(to_world(boxes, pose), pose), boxes, atol=1e-12)


BOX = [[1.0, 2.0, 4.0, 2.0, 0.5]]
OF_BOXES = {
    "corners": corners,
    "pairwise_iou": lambda boxes: pairwise_iou(boxes, BOX),
    "nms": lambda boxes: nms(boxes, np.ones(len(boxes)), 0.5),
    "from_world": lambda boxes: from_world(boxes, np.eye(4)),
    "to_world": lambda boxes: to_world(boxes, np.eye(4)),
}


@pytest.mark.parametrize("call", OF_BOXES.values(), ids=list(OF_BOXES))
@pytest.mark.parametrize("wrong", [BOX[0], np.ones((2, 4)), [BOX], [["a"] * 5]], ids=["1d", "4 columns", "3d", "text"])
def test_what_is_no_set_of_boxes_is_named(call, wrong):
    with pytest.raises(ValueError, match=r"^(boxes|a) must be .*\(n, 5\+\)"):
        call(wrong)


@pytest.mark.parametrize("call", OF_BOXES.values(), ids=list(OF_BOXES))
def test_lists_narrower_numbers_and_views_are_as_good_as_arrays(call):
    wanted = call(np.array(BOX * 2))
    spaced = np.zeros((4, 10))
    spaced[::2, ::2] = BOX * 2
    frozen = np.array(BOX * 2)
    frozen.flags.writeable = False
    for boxes in (BOX * 2, np.array(BOX * 2, dtype=np.float32), spaced[::2, ::2], frozen):
        assert call(boxes).tolist() == wanted.tolist()
    assert len(call([])) == len(call(np.zeros((0, 5)))) == 0


def test_other_arguments_are_named_too():
    with pytest.raises(ValueError, match=r"^scores must be one for each of 1 boxes"):
        nms(BOX, [], 0.5)
    with pytest.raises(ValueError, match=r"^iou_threshold"):
        nms(BOX, [1.0], 2.0)
    with pytest.raises(ValueError, match=r"^pose must be of shape"):
        from_world(BOX, np.eye(3))
    with pytest.raises(ValueError, match=r"^pose must be numbers"):
        to_world(BOX, "north")
    with pytest.raises(ValueError, match=r"^boxes must be of shape \(n, 6\+\)"):
        in_units(BOX)
    assert pose_fault(np.eye(4).tolist()) is None


@pytest.mark.parametrize(
    ("place", "most", "over"),
    [
        ((0, 0), 1.0004, 1.0006),  # the length of an axis, squared: 1 to a thousandth
        ((0, 1), 9e-4, 1.1e-3),
        ((3, 1), 9e-10, 1.1e-9),
        ((3, 3), 1 + 9e-6, 1 + 1.1e-5),
        ((1, 3), 1e8, 1.1e8),
    ],
)
def test_a_pose_may_be_off_by_as_little_as_rounding_makes_it(place, most, over):
    pose = np.eye(4)
    pose[place] = most
    assert pose_fault(pose) is None
    for wrong in (over, np.nan, np.inf):
        pose[place] = wrong
        assert pose_fault(pose) is not None


def test_how_many_pairs_are_looked_at_at_a_time_makes_no_difference(rng, monkeypatch):
    some = np.column_stack([rng.uniform(-3, 3, (7, 2)), rng.uniform(1, 5, (7, 2)), rng.uniform(-3, 3, 7)])
    whole = geometry.pairwise_iou(some, some)
    monkeypatch.setattr(geometry, "_AT_A_TIME", 4)
    np.testing.assert_array_equal(geometry.pairwise_iou(some, some), whole)
