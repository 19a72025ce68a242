import numpy as np
import pytest

from robosac.scenes import Lidar, lidar

EXACT = Lidar(noise_m=0.0, dropout=0.0)
SENSOR = (0.0, 0.0, 1.7, 0.0)


def cast(lidar, boxes, origin=SENSOR):
    points, hits = lidar.scan(np.array(boxes, dtype=float).reshape(-1, 6), origin, np.random.default_rng(0))
    return points, hits


def brute_force(lidar, boxes, origin):
    """Range of every ray by marching along it in small steps."""
    x, y, z, yaw = origin
    ranges = np.full((lidar.azimuths, lidar.beams), np.inf)
    slopes = np.tan(np.deg2rad(np.linspace(lidar.lowest_deg, lidar.highest_deg, lidar.beams)))
    r = np.arange(0.0, lidar.range_m + 1, 0.01)
    for i in range(lidar.azimuths):
        a = 2 * np.pi * i / lidar.azimuths + yaw
        px, py = x + r * np.cos(a), y + r * np.sin(a)
        for j, slope in enumerate(slopes):
            pz = z + r * slope
            solid = pz <= 0
            for bx, by, length, width, byaw, height in boxes:
                c, s = np.cos(byaw), np.sin(byaw)
                u, v = c * (px - bx) + s * (py - by), -s * (px - bx) + c * (py - by)
                solid |= (np.abs(u) <= length / 2) & (np.abs(v) <= width / 2) & (pz <= height)
            first = np.argmax(solid)
            if solid[first] and r[first] <= lidar.range_m:
                ranges[i, j] = r[first]
    return ranges


def test_agrees_with_marching_along_every_ray(rng):
    lidar = Lidar(azimuths=24, beams=12, noise_m=0.0, dropout=0.0)
    boxes = [
        [rng.uniform(6, 20) * np.cos(a), rng.uniform(6, 20) * np.sin(a), 4.5, 2.0, rng.uniform(-3, 3), h]
        for a, h in zip(np.linspace(0, 6, 9), [1.5, 3.2, 1.6] * 3, strict=True)
    ]
    origin = (0.4, -0.3, 1.7, 0.8)
    expected = brute_force(lidar, boxes, origin)
    points, _ = cast(lidar, boxes, origin)
    found = np.hypot(points[:, 0], points[:, 1])
    np.testing.assert_allclose(found, expected[np.isfinite(expected)], atol=0.02)


def test_an_empty_world_is_ground_up_to_the_horizon():
    points, hits = cast(EXACT, [])
    assert hits.shape == (0,)
    np.testing.assert_allclose(points[:, 2], -1.7, atol=1e-5)
    assert np.hypot(points[:, 0], points[:, 1]).max() <= EXACT.range_m


def test_a_near_vehicle_hides_a_far_one_of_its_height_but_not_a_building():
    near, far, tower = [8, 0, 2, 4, 0, 1.6], [16, 0, 2, 4, 0, 1.6], [24, 0, 2, 8, 0, 10.0]
    assert cast(EXACT, [far])[1][0] > 50
    _, hits = cast(EXACT, [near, far, tower])
    assert hits[0] > 50
    assert hits[1] < 10
    assert hits[2] > 20


def test_a_high_sensor_sees_over_vehicles():
    near, far = [8, 0, 2, 4, 0, 1.6], [16, 0, 2, 4, 0, 1.6]
    _, hits = cast(EXACT, [near, far], (0.0, 0.0, 5.0, 0.0))
    assert hits[1] > 20


def test_the_scan_turns_with_the_sensor():
    points, _ = cast(EXACT, [[10, 0, 2, 2, 0, 3.0]], (0.0, 0.0, 1.7, np.pi / 2))
    standing = points[points[:, 2] > -1.6]
    assert standing[:, 1].max() < 0
    assert np.abs(standing[:, 0]).max() < 1.5


def test_dropout_and_noise_are_as_stated():
    wall = [[10, 0, 0.2, 200, 0, 50.0]]
    exact, _ = cast(EXACT, wall)
    noisy, _ = cast(Lidar(noise_m=0.0, dropout=0.3), wall)
    assert len(noisy) == pytest.approx(0.7 * len(exact), rel=0.03)
    blurred, _ = cast(Lidar(noise_m=0.05, dropout=0.0), wall)
    spread = np.hypot(blurred[:, 0], blurred[:, 1]) - np.hypot(exact[:, 0], exact[:, 1])
    assert spread.std() == pytest.approx(0.05, rel=0.05)


def test_rays_that_are_not_tried_would_have_met_nothing(rng, monkeypatch):
    """Also of a sensor close to boxes, or between them, and of boxes out of reach."""
    boxes = np.column_stack([rng.uniform(-70, 70, (60, 2)), rng.uniform(0.5, 12, (60, 2)), rng.uniform(-4, 4, 60)])
    boxes = np.column_stack([boxes, rng.uniform(0.5, 9, 60)])
    origins = [(*rng.uniform(-60, 60, 2), 1.7, rng.uniform(-7, 7)) for _ in range(10)]
    origins += [(*(box[:2] + rng.normal(0, 3, 2)), 1.7, rng.uniform(-7, 7)) for box in boxes[:10]]
    found = [cast(Lidar(), boxes, origin) for origin in origins]

    def all_of_them(obstacles, x, y, yaw, azimuths, range_m):
        return np.divmod(np.arange(azimuths * len(obstacles)), len(obstacles))

    monkeypatch.setattr(lidar, "_towards", all_of_them)
    for (points, hits), origin in zip(found, origins, strict=True):
        right, right_hits = cast(Lidar(), boxes, origin)
        np.testing.assert_array_equal(points, right)
        np.testing.assert_array_equal(hits, right_hits)
