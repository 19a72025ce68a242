"""Every number of every JSON body, systematically: what is absurd is refused by its name, what is allowed works."""

import json

import pytest

from robosac import defenses
from robosac.audit import verify
from service.schemas import EnrolmentRequest, SessionRequest
from tests.service.conftest import EGO, TEAM, serve

HOSTILE = ["NaN", "Infinity", "-Infinity", "5e-324", "1e-320", "-1e-320", "1e-10", str(2**53), "9" * 30, "9" * 400]
LEAST, BELOW_ONE = 1e-9, 1 - 1e-9
UNLIKE = {"collaborators", "calibration", "ratios", "pose_error_m"}
"""What else bounds these: the team, the detector's calibration."""


def numbers(model):
    """For each field of a model that holds numbers, their schema, and whether it holds several."""
    found = {}
    for name, schema in model.model_json_schema()["properties"].items():
        for choice in schema.get("anyOf", [schema]):
            part = choice.get("items", choice)
            if part.get("type") in ("integer", "number"):
                found[name] = (part, part is not choice)
    return found


FIELDS = [
    *((None, name) for name in numbers(SessionRequest)),
    *((kind, name) for kind, model in defenses.shipped().items() for name in numbers(model)),
]


def test_the_fields_are_found():
    assert {(None, "gather_ms"), ("a2cp", "ratios"), ("conformal", "calibration"), ("static_team", "recheck_every")} < {
        *FIELDS
    }
    assert not numbers(EnrolmentRequest)


async def test_an_absurd_number_is_refused_by_its_name(served):
    for kind, name in FIELDS:
        _, several = numbers(defenses.shipped()[kind] if kind else SessionRequest)[name]
        for number in HOSTILE:
            value = f'"{name}": [{number}]' if several else f'"{name}": {number}'
            defense = f', "defense": {{"kind": "{kind}", {value}}}' if kind else f", {value}"
            body = f'{{"ego_id": "{EGO}", "teammates": {json.dumps(TEAM)}{defense}}}'
            opened = await served.http.post(
                "/v1/sessions", content=body.encode(), headers={"Content-Type": "application/json"}
            )
            assert opened.status_code == 422, (kind, name, number, opened.text)
            told = opened.json()
            assert name in told.get("field", "") or name in told["detail"] or "pose error" in told["detail"], told


async def test_who_is_too_near_to_0_is_not_told_to_give_0(served):
    fields = {"ego_id": EGO, "teammates": TEAM, "frame_period_ms": 1e-12}  # of which 0 is refused, too
    told = (await served.http.post("/v1/sessions", json=fields)).json()
    assert (told["field"], told["detail"]) == ("frame_period_ms", "is nearer to 0 than 1e-09")


def truths(model):
    """The fields of a model that hold true or false."""
    described = model.model_json_schema()["properties"].items()
    return [
        name for name, schema in described if {"type": "boolean"}.items() <= schema.get("anyOf", [schema])[0].items()
    ]


async def test_only_numbers_are_numbers_and_only_true_and_false_are_truth_values(served):
    wrong = [(kind, name, value) for kind, name in FIELDS for value in (True, False, "1", "0.2", "")]
    for kind, model in {None: SessionRequest, **defenses.shipped()}.items():
        wrong += [(kind, name, value) for name in truths(model) for value in (0, 1, "true", "no")]
    assert {(None, "record", 1), ("group_testing", "compare_frames", "no")} < {*wrong}
    for kind, name, value in wrong:
        _, several = numbers(defenses.shipped()[kind] if kind else SessionRequest).get(name, (None, False))
        setting = {name: [value] if several else value}
        fields = {"defense": {"kind": kind, **setting}} if kind else setting
        opened = await served.http.post("/v1/sessions", json={"ego_id": EGO, "teammates": TEAM, **fields})
        assert opened.status_code == 422, (kind, name, value, opened.text)
        told = opened.json()
        assert told["field"] == (f"defense.{name}" if kind else name), told
        assert told["detail"] in ("must be a number", "must be true or false"), told


async def test_an_integer_may_be_written_with_a_point_and_a_number_without(served):
    defense = {"kind": "sample_consensus", "sampling_budget": 7.0, "collaborators": 2}
    session = await served.open(defense=defense, latency_budget_ms=3000)
    assert session.defense["sampling_budget"] == 7


def extreme(schema, *, low):
    """The least or the greatest number that a schema allows, and that is not too near to 0."""
    if low:
        return schema["minimum"] if schema.get("minimum") else LEAST if schema["type"] == "number" else 0
    return schema["maximum"] if "maximum" in schema else BELOW_ONE if schema["type"] == "number" else 2**53 - 1


@pytest.mark.parametrize("low", [True, False], ids=["least", "greatest"])
async def test_the_least_and_the_greatest_that_is_allowed_does_no_harm(low, messages, attacked):
    async with serve(max_hypotheses=10_000) as served:
        for kind, model in defenses.shipped().items():
            settings = {n: extreme(schema, low=low) for n, (schema, _) in numbers(model).items() if n not in UNLIKE}
            session = await served.open(defense={"kind": kind, **settings}, latency_budget_ms=5000)
            ego = served.ego(session)
            for frame in range(2):
                answer = await ego.post_frame(frame, messages[EGO], attacked)
                assert answer.degraded_by is None, (kind, settings)
            assert verify([line.encode() for line in await ego.audit_lines()]) == [], (kind, settings)
