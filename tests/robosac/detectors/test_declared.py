import re
import sys
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from robosac import detectors
from robosac.detectors import DetectorError, DetectorInfo, TensorSpec
from robosac.detectors.loading import warm_up

MAP = {"map": TensorSpec("float32", (1, 2, 2))}
INFO = DetectorInfo("mine", {"ego": MAP, "teammate": MAP}, (-8, -8, 8, 8), 8.0, "0" * 64, 0.5)


def detector(info=INFO, detect=lambda subset=(): np.zeros((0, 6))):
    return SimpleNamespace(info=info, prepare=lambda ego, teammates: SimpleNamespace(detect=detect))


def loaded(monkeypatch, info):
    module = ModuleType("own")
    module.build = lambda: detector(info)
    monkeypatch.setitem(sys.modules, "own", module)
    return detectors.load("own:build")


def test_a_face_that_can_be_is_taken(monkeypatch):
    assert loaded(monkeypatch, INFO).info is INFO
    assert loaded(monkeypatch, replace(INFO, tensors={"ego": {}, "teammate": MAP}, area_m=[-8, -8.5, 8, 8])).info


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"name": ""}, "info.name must be a text of at most 128 printable characters, got ''"),
        ({"name": "a\udc80"}, r"info.name must be .*, got 'a\udc80'"),
        ({"name": "a\n"}, r"info.name must be .*, got 'a\n'"),
        ({"calibration": "x.json"}, "info.calibration must be a Path or None, got 'x.json'"),
        ({"witness": "x"}, "info.witness must be a Path or None, got 'x'"),
        ({"mirrored": "yes"}, "info.mirrored must be True or False, got 'yes'"),
        ({"precision": "float8"}, "info.precision must be one of float32, bfloat16, float16, got 'float8'"),
        ({"device": 7}, "info.device must be a text, got 7"),
        ({"area_m": (0, 0, 0, 8)}, "info.area_m must be xmin, ymin, xmax, ymax in metres, .*, got (0, 0, 0, 8)"),
        ({"area_m": (0, 0, 8)}, "info.area_m must be .*, got (0, 0, 8)"),
        ({"cell_m": 0}, "info.cell_m must be a positive number of metres, got 0"),
        ({"weights_digest": "none"}, "info.weights_digest must be a SHA-256, 64 hexadecimal digits .*, got 'none'"),
        ({"consensus_score": np.nan}, "info.consensus_score must be a score from 0 to 1, got nan"),
        ({"consensus_score": "0.5"}, "info.consensus_score must be a score from 0 to 1, got '0.5'"),
        ({"tensors": {"ego": MAP}}, "info.tensors must have what the teammate sends, by name, under 'teammate'"),
        ({"tensors": None}, "info.tensors must have what the ego sends, by name, under 'ego'"),
        (
            {"tensors": {"ego": {"map": (1, 2)}, "teammate": MAP}},
            "info.tensors must have a TensorSpec for 'map' of the ego, got (1, 2)",
        ),
        (
            {"tensors": {"ego": MAP, "teammate": {"map": TensorSpec("float", (1, 2))}}},
            "info.tensors of the teammate: 'map' must have a numpy dtype by its name, got 'float'",
        ),
        (
            {"tensors": {"ego": MAP, "teammate": {"map": TensorSpec("float32", (0, 2))}}},
            "info.tensors of the teammate: 'map' must have a shape of positive integers, got (0, 2)",
        ),
        *(
            (
                {"tensors": {"ego": MAP, "teammate": {"map": TensorSpec("float32", (1, 2), narrower)}}},
                "info.tensors of the teammate: 'map' must have a tuple of int8 and floats as narrower, got .*",
            )
            for narrower in ("int8", ("int4",), ("int16",), ["int8"])
        ),
        (
            {"tensors": {"ego": {5: MAP["map"]}, "teammate": MAP}},
            "info.tensors of the ego must have names of at most 128 printable characters, got 5",
        ),
    ],
)
def test_a_face_that_cannot_be_is_refused_by_its_field(fields, words, monkeypatch):
    with pytest.raises(DetectorError, match=re.escape(f"own:build: {words}").replace(r"\.\*", ".*")):
        loaded(monkeypatch, replace(INFO, **fields))


def test_a_face_of_another_kind_is_refused(monkeypatch):
    with pytest.raises(DetectorError, match="own:build: info must be a DetectorInfo, got a dict"):
        loaded(monkeypatch, {"name": "mine"})


def test_what_is_no_boxes_is_told_with_the_detector_while_a_gateway_warms_up():
    with pytest.raises(DetectorError, match=r"^mine: detect must return boxes \(n, 6\), got \(3, 5\)$"):
        warm_up(detector(detect=lambda subset=(): np.zeros((3, 5))))


def test_a_detector_that_answers_no_frame_of_zeros_is_told_with_the_place():
    def detect(subset=()):
        return len(subset) / 0

    with pytest.raises(DetectorError, match=r"^mine cannot answer a frame of zeros: ZeroDivision.*test_declared"):
        warm_up(detector(detect=detect))


def test_boxes_that_nobody_suppressed_are_too_many():
    with pytest.raises(DetectorError, match=r"^mine: detect must return at most 8192 boxes, got 8193: are they supp"):
        warm_up(detector(detect=lambda subset=(): np.ones((8193, 6))))


def test_a_message_that_no_memory_holds_is_told_with_the_detector():
    huge = {"map": TensorSpec("float32", (2**40,))}
    with pytest.raises(DetectorError, match=r"^mine cannot answer a frame of zeros: .*MemoryError"):
        warm_up(detector(replace(INFO, tensors={"ego": MAP, "teammate": huge})))


def test_what_is_prepared_has_to_detect():
    unprepared = SimpleNamespace(info=INFO, prepare=lambda ego, teammates: None)
    with pytest.raises(DetectorError, match=r"^mine: prepare must return a frame to detect in, got a NoneType$"):
        warm_up(unprepared)
