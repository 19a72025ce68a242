import json
import sys
from types import ModuleType
from typing import Literal

import pytest

from robosac.budget import DomainError
from robosac.defenses import (
    A2CP,
    ConsensusSettings,
    DefenseSettings,
    Reference,
    SampleConsensus,
    StaticTeam,
    Undefended,
    build,
    known,
    load,
    read_settings,
    registry,
    shipped,
)
from robosac.defenses.group_testing import CalibrationError


class Mute(ConsensusSettings):
    """Has nothing to say.

    And this is no summary.
    """

    kind: Literal["mute"] = "mute"
    shout: float = 1.0

    def check_team(self, team_size): ...

    def initial_state(self, team): ...

    def change_team(self, state, team): ...


class Whole(Mute):
    kind: Literal["whole"] = "whole"

    def converse(self, team, state, rng): ...


class Failing(DefenseSettings):
    kind: Literal["failing"] = "failing"

    def build(self, calibration):
        return 1 / 0


class Building(Failing):
    kind: Literal["building"] = "building"

    def build(self, calibration):
        return "a wall"


class Other(Whole):
    kind: Literal["halving"] = "halving"


class Vague(Whole):
    kind: str = "vague"


class Silent(Whole):
    kind: Literal["silent"]


@pytest.fixture
def own(monkeypatch):
    """A module of one's own with all of the above."""
    module = ModuleType("own")
    vars(module).update({name: value for name, value in globals().items() if name[:1].isupper()})
    module.loud, module.number = (lambda: Whole(shout=2.0)), (lambda: 7)
    monkeypatch.setitem(sys.modules, "own", module)


@pytest.mark.parametrize(
    ("settings", "defense"),
    [
        ({"kind": "none"}, Undefended()),
        ({"kind": "sample_consensus", "reference": "previous"}, SampleConsensus(reference=Reference.PREVIOUS)),
        ({"kind": "static_team", "recheck_every": None}, StaticTeam(recheck_every=None)),
        ({"kind": "a2cp", "ratios": [0, 0.5]}, A2CP(ratios=(0.0, 0.5))),
        ({"kind": "a2cp", "ratios": None, "sampling_budget": 3}, A2CP(sampling_budget=3)),
    ],
)
def test_a_defence_is_built_from_json(settings, defense):
    assert build(json.loads(json.dumps(settings))) == defense


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({}, "no defence of kind None; known: a2cp, "),
        ({"kind": "nonesuch"}, "no defence of kind 'nonesuch'"),
        ({"kind": "none", "ratios": [0.5]}, "none: ratios: there is no such field"),
        ({"kind": "sample_consensus", "reference": "next"}, "sample_consensus: reference: .*'ego' or 'previous'"),
        ({"kind": "sample_consensus", "attacker_ratio": 2}, "sample_consensus: attacker_ratio: .*less than 1"),
        ({"kind": "a2cp", "ratios": 3}, "a2cp: ratios: .*tuple"),
    ],
)
def test_settings_that_make_no_defence_are_refused(settings, complaint):
    with pytest.raises(DomainError, match=complaint):
        build(settings)


def test_the_defences_that_ship():
    of_old = ("a2cp", "conformal", "group_testing", "halving", "none", "one_by_one", "sample_consensus", "static_team")
    assert set(shipped()) >= set(of_old)
    for kind, model in shipped().items():
        assert load(kind) == model(kind=kind)
        assert model.summary().endswith(".")
        assert model.needs_calibration or build({"kind": kind}).kind == kind


@pytest.mark.usefixtures("own")
def test_a_reference_gives_settings():
    assert load("own:Whole") == Whole()
    assert load("own:loud").shout == 2.0
    kinds = known(["own:Whole"])
    assert set(kinds) == {*shipped(), "whole"}
    assert build({"kind": "whole", "shout": 3}, kinds=kinds) == Whole(shout=3.0)
    assert Mute.summary() == "Has nothing to say."


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("nonesuch", "no defence 'nonesuch': give one of a2cp, .*, or module:callable"),
        ("nonesuch:Thing", "No module named 'nonesuch'"),
        ("own:missing", "no attribute 'missing'"),
        ("own:number", "own:number made no defence but 7, which has to derive from DefenseSettings"),
        ("own:Mute", "own:Mute .* which lacks converse .The conversation about one frame with the teammates present"),
        ("own:Vague", "kind has to be a Literal of one name"),
        ("own:Silent", "kind Field required"),
        ("own:Other", "another defence of kind 'halving'"),
    ],
)
def test_what_is_no_defence_is_explained_in_a_line(name, complaint):
    with pytest.raises(DomainError, match=complaint) as refused:
        known([name])
    assert "\n" not in str(refused.value)


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    ("name", "complaint"), [("Failing", "failing: ZeroDivisionError"), ("Building", "building made .* lacks kind")]
)
def test_what_cannot_be_built_is_explained(name, complaint):
    with pytest.raises(DomainError, match=complaint):
        build(load(f"own:{name}"))


def test_only_a_defence_that_needs_it_asks_for_a_calibration():
    assert build({"kind": "none"}, lambda: pytest.fail("asked")) == Undefended()
    with pytest.raises(CalibrationError, match="group_testing needs the calibration of a detector"):
        build({"kind": "group_testing"})


@pytest.mark.usefixtures("own")
def test_an_installed_package_can_offer_a_defence(tmp_path, monkeypatch):
    info = tmp_path / "mine-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{registry.DEFENSES.package}]\nwhole = own:Whole\nmisnamed = own:Whole\n")
    assert "whole" not in known()
    with pytest.raises(DomainError, match="no defence of kind 'whole'"):
        read_settings({"kind": "whole"})
    monkeypatch.syspath_prepend(tmp_path)
    assert load("whole") == read_settings({"kind": "whole"}) == Whole()
    with pytest.raises(DomainError, match="no defence of kind 'whole'"):
        read_settings({"kind": "whole"}, known())
    with pytest.raises(DomainError, match="misnamed: kind: Input should be 'whole'"):
        read_settings({"kind": "misnamed"})


@pytest.mark.parametrize("kind", [None, 7, [], {}])
def test_a_kind_that_is_no_name_is_refused(kind):
    with pytest.raises(DomainError, match="no defence of kind"):
        read_settings({"kind": kind})
