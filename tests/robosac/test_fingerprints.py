import numpy as np
import pytest

from robosac.scenes import IntersectionScene
from robosac.screening.fingerprints import SKETCH, fingerprints, likeness, packed, unpacked


def one(*tensors, **named):
    return fingerprints({"a": named or {"x": tensors[0]}})["a"]


def a_map(rng, dtype=np.float16):
    return rng.normal(0.5, 1.0, (64, 32, 32)).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_sizes_are_those_of_the_values(dtype, rng):
    values = a_map(rng, dtype)
    values[3, 4, 5] = -9.5
    largest, rms = one(values).sizes["x"]
    assert largest == 9.5
    assert rms == pytest.approx(np.sqrt(np.mean(values.astype(np.float64) ** 2)), rel=0.05)
    assert one(np.abs(values)).sizes["x"][0] == 9.5
    assert one(-np.abs(values)).sizes["x"][0] == 9.5
    assert one(np.zeros((2, 2), dtype)).sizes["x"] == (0.0, 0.0)


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, bool])
def test_whole_numbers_have_sizes_too(dtype):
    assert one(np.array([[0, 1], [1, 1]], dtype)).sizes["x"] == (1.0, pytest.approx(np.sqrt(0.75)))


@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_no_size_within_any_bound(odd, rng):
    values = a_map(rng)
    values[0, 0, 0] = odd
    shown = one(values)
    assert not shown.sizes["x"][0] <= 1e300
    assert np.isfinite(shown.sketch).all()


@pytest.mark.parametrize("shape", [(64, 32, 32), (3, 5), (1,), (0,)])
@pytest.mark.parametrize("dtype", [np.float16, np.uint8])
def test_the_digest_knows_the_same_bytes_and_no_others(shape, dtype, rng):
    values = (rng.normal(size=shape) * 50).astype(dtype)
    assert one(values).digest == one(values.copy()).digest == one(np.asfortranarray(values)).digest
    for place in rng.integers(0, max(values.size, 1), 20 if values.size else 0):
        other = values.copy()
        other.reshape(-1).view(np.uint8)[place * values.itemsize] ^= 1
        assert one(other).digest != one(values).digest
    if values.size > 1:
        assert one(np.roll(values, 1)).digest != one(values).digest


def test_the_digest_is_of_all_tensors_by_their_names(rng):
    a, b = a_map(rng), a_map(rng)
    both = one(x=a, y=b)
    assert both.digest != one(x=b, y=a).digest
    assert both.digest != one(x=a, y=a).digest
    assert both.digest == one(y=b, x=a).digest


def test_a_map_that_is_the_same_nearly_everywhere_is_blank(rng):
    flat = np.full((64, 32, 32), 0.5, np.float16)
    flat += rng.normal(size=(64, 1, 1)).astype(np.float16)
    rimmed = flat.copy()
    rimmed[:, :4], rimmed[..., -4:] = rng.normal(size=(64, 4, 32)), rng.normal(size=(64, 32, 4))
    for blank in (flat, rimmed, np.zeros_like(flat), np.full((5, 3), 2.0), np.zeros((0, 4, 4)), np.zeros((3, 0))):
        assert one(blank).blank
        assert not one(blank).sketch.any()
    for rows, is_blank in ((4, True), (5, False)):  # of 24 within the rims
        filled = rimmed.copy()
        filled[7, 28 - rows : 28] += 0.75
        assert one(filled).blank == is_blank
        filled[8, 4:28, 4:28] = np.arange(24)
        assert not one(filled).blank
    assert not one(np.array([[1.0] * 9 + [2.0]])).blank
    assert not one(x=flat, y=a_map(rng)).blank


def test_the_message_of_an_empty_scan_is_blank(detector):
    tensors = detector.encode(np.zeros((0, 3)), np.eye(4)).tensors
    assert fingerprints({"a": tensors})["a"].blank


@pytest.mark.parametrize("off_m", [0.5, 1.0, 2.0])
def test_the_message_of_a_covered_scanner_is_blank(detector, rng, off_m):
    angle, tilt = rng.uniform(-np.pi, np.pi, 3000), rng.uniform(-0.5, 0.1, 3000)
    off = off_m + rng.normal(0.0, 0.03, 3000)
    cover = off[:, None] * np.column_stack([np.cos(angle), np.sin(angle), np.sin(tilt)])
    assert fingerprints({"a": detector.encode(cover, np.eye(4)).tensors})["a"].blank


def test_no_message_of_a_scanner_that_sees_is_blank(detector):
    for number in (1600, 1601):
        views = IntersectionScene(number).frame(0).views.values()
        prints = fingerprints({str(i): detector.encode(v.points, v.pose).tensors for i, v in enumerate(views)})
        assert not any(one.blank for one in prints.values())


def test_likeness_is_the_correlation_of_the_maps(rng):
    first, noise = a_map(rng, np.float64), rng.normal(size=(64, 32, 32))
    for share in (0.0, 0.3, 0.6, 0.9, 1.0):
        second = share * (first - 0.5) + np.sqrt(1 - share**2) * noise + 3.0
        shown = fingerprints({"a": {"x": first}, "b": {"x": second}})
        assert likeness(shown["a"].sketch, shown["b"].sketch) == pytest.approx(share, abs=0.25 * (1 - share**2) + 0.01)
    assert likeness(shown["a"].sketch, shown["a"].sketch) == pytest.approx(1.0)


def test_fingerprints_do_not_depend_on_who_else_is_there(rng):
    a, b = {"x": a_map(rng)}, {"x": a_map(rng)}
    together = fingerprints({"a": a, "b": b})
    for name, tensors in (("a", a), ("b", b)):
        alone = fingerprints({name: tensors})[name]
        assert (alone.digest, alone.sizes) == (together[name].digest, together[name].sizes)
        np.testing.assert_array_equal(alone.sketch, together[name].sketch)
    assert fingerprints({}) == {}


def test_a_sketch_is_the_same_after_it_was_text(rng):
    sketches = np.stack([one(a_map(rng)).sketch, np.zeros(SKETCH), one(a_map(rng)).sketch])
    assert sketches.shape == (3, SKETCH)
    np.testing.assert_array_equal(unpacked(packed(sketches)), sketches)
    assert unpacked(packed(sketches)[2:])[0].tolist() == sketches[2].tolist()
    assert unpacked([]).shape == (0, SKETCH)
    with pytest.raises(ValueError, match="base64"):
        unpacked(["?"])
