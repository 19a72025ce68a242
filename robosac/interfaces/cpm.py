"""Answers in the terms of ETSI's Collective Perception Message (TS 103 324 V2.1.1, data elements of TS 102 894-2).

What comes out is JSON with the standard's names, units and bounds. It is no message: nothing is encoded in ASN.1, there
is no header and no certificate, and what a box does not tell is left out, or is "unavailable".
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from robosac.answers import FrameAnswer
from robosac.boxes import FloatArray

ITS_EPOCH_S = 1_072_915_200
"""2004-01-01T00:00:00 UTC, from which timestamps count, in Unix seconds."""
LEAP_S = 5
"""Leap seconds since then, which TimestampIts counts and Unix time does not. There was none since 2017."""
PASSENGER_CAR = 5
MOST_OBJECTS = 255
_CENTIMETRES = 131_071
_NOT_KNOWN = {
    "latitude": 900_000_001,
    "longitude": 1_800_000_001,
    "altitude": 800_001,
    "ellipse_axis": 4095,
    "heading": 3601,
    "altitude_confidence": 15,
    "coordinate": 4096,
    "angle": 127,
    "dimension": 32,
}
"""What the standard writes for what is not known."""


def collective_perception(answer: FrameAnswer, pose: FloatArray, time_s: float) -> dict[str, Any]:
    """The boxes of an answer as perceived objects.

    Parameters
    ----------
    answer : FrameAnswer
    pose : (4, 4) ndarray
        world_from_sensor of the ego, as it sent it with the frame.
    time_s : float
        When the frame was sensed, Unix seconds.

    Returns
    -------
    dict
        ``managementContainer`` and ``perceivedObjectContainer``. Positions are those of the boxes' centres from the
        ego, along the axes of the world (east and north, if the world is so), in 0.01 m; angles are counted from the
        world's x-axis, counter-clockwise, in 0.1 degrees; lengths and widths are in 0.1 m. As the standard has it, a
        number that lies between two steps takes the upper one. There are no more than 255 objects, best first.
    """
    boxes = answer.boxes_in_world(pose)[:MOST_OBJECTS]
    centre = np.asarray(pose)[:2, 3]
    objects = [_perceived(number, box, centre) for number, box in enumerate(boxes)]
    unknown = dict.fromkeys(("semiMajorAxisLength", "semiMinorAxisLength"), _NOT_KNOWN["ellipse_axis"])
    return {
        "managementContainer": {
            "referenceTime": timestamp_its(time_s),
            "referencePosition": {
                "latitude": _NOT_KNOWN["latitude"],
                "longitude": _NOT_KNOWN["longitude"],
                "positionConfidenceEllipse": {**unknown, "semiMajorAxisOrientation": _NOT_KNOWN["heading"]},
                "altitude": {
                    "altitudeValue": _NOT_KNOWN["altitude"],
                    "altitudeConfidence": _NOT_KNOWN["altitude_confidence"],
                },
            },
        },
        "perceivedObjectContainer": {"numberOfPerceivedObjects": len(answer.boxes), "perceivedObjects": objects},
    }


def timestamp_its(time_s: float) -> int:
    """Unix seconds as TimestampIts: milliseconds since 2004, leap seconds counted."""
    return round((time_s - ITS_EPOCH_S + LEAP_S) * 1e3)


def _perceived(number: int, box: FloatArray, centre: FloatArray) -> dict[str, Any]:
    x, y, length, width, yaw, score = (float(value) for value in box)
    return {
        "objectId": number,
        "measurementDeltaTime": 0,
        "position": {
            "xCoordinate": _coordinate(x - centre[0]),
            "yCoordinate": _coordinate(y - centre[1]),
        },
        "angles": {
            "zAngle": {"value": _steps(math.degrees(yaw) % 360.0, 0.1) % 3600, "confidence": _NOT_KNOWN["angle"]}
        },
        "objectDimensionX": _dimension(length),
        "objectDimensionY": _dimension(width),
        "objectPerceptionQuality": min(max(round(score * 15), 0), 15),
        "classification": [
            {"objectClass": {"vehicleSubClass": PASSENGER_CAR}, "confidence": min(max(round(score * 100), 1), 100)}
        ],
    }


def _coordinate(metres: float) -> dict[str, int]:
    value = min(max(_steps(metres, 0.01), -_CENTIMETRES - 1), _CENTIMETRES)
    return {"value": value, "confidence": _NOT_KNOWN["coordinate"]}


def _dimension(metres: float) -> dict[str, int]:
    return {"value": min(max(_steps(metres, 0.1), 1), 255), "confidence": _NOT_KNOWN["dimension"]}


def _steps(value: float, step: float) -> int:
    """Whole steps that a value takes, the last one begun; what a computer's rounding adds begins none."""
    return math.ceil(round(value / step, 6))
