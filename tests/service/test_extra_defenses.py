"""Defences that the operator lists: ``ROBOSAC_EXTRA_DEFENSES``."""

import sys
from types import ModuleType
from typing import Literal

import pytest
from pydantic import Field

from robosac.defenses.one_by_one import OneByOne
from service.settings import Settings
from tests.service.conftest import TEAM, problem, serve


class Wary(OneByOne):
    """Tests every teammate alone."""

    kind: Literal["wary"] = "wary"
    consensus_threshold: float = Field(0.4, gt=0, le=1)


class Twin(Wary):
    kind: Literal["none"] = "none"


class Forgetful(Wary):
    def initial_state(self, team): ...


class Picky(Wary):
    def check_team(self, team_size):
        raise LookupError("no team is good enough")


@pytest.fixture(autouse=True)
def own(monkeypatch):
    module = ModuleType("own")
    module.Wary, module.Twin, module.Forgetful, module.Picky = Wary, Twin, Forgetful, Picky
    monkeypatch.setitem(sys.modules, "own", module)


EXTRA = {"extra_defenses": "own:Wary"}


async def test_a_listed_defence_is_served_like_one_that_ships(ego_message, attacked):
    async with serve(**EXTRA) as served:
        session = await served.open(defense={"kind": "wary", "reference": "previous"})
        settings = {"kind": "wary", "consensus_threshold": 0.4, "reference": "previous"}
        assert session.defense == settings
        ego = served.ego(session)
        answer = await ego.post_frame(0, ego_message, attacked)
        assert (answer.source, answer.sampling_steps) == ("consensus", len(TEAM) + 1)
        assert (await ego.state())["defense"] == settings
        assert (await ego.audit())[0]["defense"] == settings
        assert (await served.open(defense={"kind": "none"})).defense == {"kind": "none"}


@pytest.mark.parametrize(
    ("defense", "field"),
    [
        ({"kind": "wary", "consensus_threshold": 0}, "defense.consensus_threshold"),
        ({"kind": "wary", "reference": "next"}, "defense.reference"),
        ({"kind": "wary", "sampling_budget": 3}, "defense.sampling_budget"),
        ({"kind": "unwary"}, "defense.kind"),
        ({"kind": ["wary"]}, "defense.kind"),
        ("wary", "defense"),
    ],
)
async def test_its_settings_are_checked_like_those_of_one_that_ships(defense, field):
    async with serve(**EXTRA) as served:
        request = {"ego_id": "a", "teammates": ["b"], "defense": defense}
        answer = await served.http.post("/v1/sessions", json=request)
        assert problem(answer, 422, "invalid-request")["field"] == field


async def test_whoever_names_no_kind_is_told_all_that_are_served():
    async with serve(**EXTRA) as served:
        for defense in ({"kind": "unwary"}, {"kind": None}, {}):
            request = {"ego_id": "a", "teammates": ["b"], "defense": defense}
            told = problem(await served.http.post("/v1/sessions", json=request), 422, "invalid-request")
            assert told["field"] == "defense.kind"
            assert told["detail"].startswith("must be one of a2cp, ")
            assert ", wary" in told["detail"]


async def test_what_is_not_listed_is_not_served(served):
    request = {"ego_id": "a", "teammates": ["b"], "defense": {"kind": "wary"}}
    assert (
        problem(await served.http.post("/v1/sessions", json=request), 422, "invalid-request")["field"] == "defense.kind"
    )


async def test_a_session_whose_defence_is_not_listed_any_more_says_so(tmp_path, good_frame):
    database = {"database_url": f"sqlite:///{tmp_path}/robosac.db"}
    async with serve(**database, **EXTRA) as served:
        session = await served.open(defense={"kind": "wary"})
    async with serve(**database) as served:
        problem(await served.post(session, "frames", good_frame(0)), 503, "defense-unavailable")
        (opened,) = await served.ego(session).audit()
        assert opened["defense"]["kind"] == "wary"
    async with serve(**database, **EXTRA) as served:
        assert (await served.post(session, "frames", good_frame(0))).status_code == 200


@pytest.mark.parametrize(
    ("extra", "complaint"),
    [
        ("nonesuch:Wary", "No module named 'nonesuch'"),
        ("own:Twin", "another defence of kind 'none'"),
        ("wary", "or module:callable"),
    ],
)
async def test_a_defence_that_cannot_be_loaded_keeps_the_gateway_from_starting(extra, complaint):
    with pytest.raises(ValueError, match=complaint):
        async with serve(extra_defenses=extra):
            pytest.fail("it started")


def test_several_are_separated_by_commas(monkeypatch):
    monkeypatch.setenv("ROBOSAC_EXTRA_DEFENSES", "own:Wary, mine:build,")
    assert Settings().extra_defenses == ("own:Wary", "mine:build")


@pytest.mark.parametrize(
    ("extra", "why"),
    [
        ("own:Forgetful", "wary: initial_state must return a dict of JSON values, got a NoneType"),
        ("own:Picky", "wary: check_team: LookupError: no team is good enough"),
    ],
)
async def test_a_defence_that_fails_before_the_first_frame_opens_no_session(extra, why):
    async with serve(extra_defenses=extra) as served:
        request = {"ego_id": "a", "teammates": ["b"], "defense": {"kind": "wary"}}
        refused = problem(await served.http.post("/v1/sessions", json=request), 422, "impossible-defense")
        assert (refused["field"], refused["detail"]) == ("defense", why)
