import logging
import re
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from robosac.answers import Reason, Source
from robosac.defenses import Decision, SampleConsensus, StaticTeam
from tests.robosac.fusing import SEEN, TEAM, FakeDetector, Stubborn, run


@pytest.mark.parametrize("part", ["prepare", "detect"])
def test_a_fault_inside_is_answered_by_the_ego_alone(part, caplog):
    with caplog.at_level(logging.CRITICAL):
        result = run(FakeDetector(broken=part))
    assert result.source is Source.EGO_ONLY
    assert "RuntimeError: cannot" in result.fault
    assert set(result.rejected) == set(TEAM)
    assert {r.reason for r in result.rejected.values()} == {Reason.NOT_SAMPLED}
    np.testing.assert_array_equal(result.boxes, SEEN)


@pytest.mark.parametrize(
    ("boxes", "words"),
    [
        (None, r"an array of boxes \(n, 6\), got a NoneType"),
        ([SEEN], r"an array of boxes \(n, 6\), got a list"),
        (SEEN[:, :5], r"boxes \(n, 6\), got \(\d+, 5\)"),
        (SEEN[0], r"boxes \(n, 6\), got \(6,\)"),
        (SEEN * np.nan, "finite numbers"),
        (SEEN.astype(str), "finite numbers"),
        (SEEN * [1, 1, -1, 1, 1, 1], "lengths and widths of 0 or more, got -"),
    ],
)
def test_what_are_no_boxes_is_a_fault_that_is_told(boxes, words, caplog):
    detector = FakeDetector()
    decode = detector.detect
    detector.detect = lambda teammates=(): boxes if teammates else decode()
    with caplog.at_level(logging.CRITICAL):
        result = run(detector)
    assert re.match(f"DetectorError: detect must return {words}", result.fault)
    np.testing.assert_array_equal(result.boxes, SEEN)


class Liar(SampleConsensus):
    """Answers with a subset that was never in consensus."""

    def converse(self, team, state, rng):
        yield [("a",)]
        return Decision(("a", "b"), Source.CONSENSUS, dict.fromkeys("cde"), None, state)


class Muddled(SampleConsensus):
    """Says one thing and does another."""

    def __init__(self, accepted, source, rejected):
        super().__init__()
        object.__setattr__(self, "decision", (accepted, source, rejected))

    def converse(self, team, state, rng):
        yield [("a",)]
        accepted, source, rejected = self.decision
        return Decision(accepted, source, dict.fromkeys(rejected), None, state)


@pytest.mark.parametrize(
    ("defense", "attackers"),
    [
        (Liar(), ""),
        (Stubborn(), "c"),
        (Muddled((), Source.CONSENSUS, "abcde"), ""),
        (Muddled(("a",), Source.EGO_ONLY, "bcde"), ""),
        (Muddled(("a",), Source.CONSENSUS, "bcd"), ""),
        (Muddled(("a",), Source.CONSENSUS, "abcde"), ""),
    ],
)
def test_nothing_unverified_or_unexplained_reaches_the_answer(defense, attackers, caplog):
    with caplog.at_level(logging.CRITICAL):
        result = run(FakeDetector(attackers), defense)
    assert (result.source, result.accepted) == (Source.EGO_ONLY, ())
    assert "UnverifiedAnswer" in result.fault
    assert set(result.rejected) == set(TEAM)


class Usurper(StaticTeam):
    """Trusts whom it likes."""

    def converse(self, team, state, rng):
        yield [("a",)]
        trusted = {"trusted": ["a", "b"], "frames_since_check": 0}
        return Decision(("a",), Source.CONSENSUS, dict.fromkeys("bcde"), None, trusted)


class Flatterer(StaticTeam):
    """Answers with teammates that are not on its list."""

    def converse(self, team, state, rng):
        yield from ()
        return Decision(("a", "b"), Source.TRUSTED, dict.fromkeys("cde"), None, state)


@pytest.mark.parametrize("defense", [Usurper(), Flatterer()])
def test_trust_comes_from_consensus_and_from_nothing_else(defense, caplog):
    with caplog.at_level(logging.CRITICAL):
        result = run(FakeDetector(), defense, state={"trusted": ["a"] if isinstance(defense, Flatterer) else []})
    assert (result.source, result.accepted) == (Source.EGO_ONLY, ())
    assert "UnverifiedAnswer" in result.fault


class Hoarder(SampleConsensus):
    """A defence of one's own, which remembers what no log can hold."""

    kind: Literal["hoarder"] = "hoarder"

    def converse(self, team, state, rng):
        decision = yield from super().converse(team, state, rng)
        return replace(decision, state={"seen": {*team}})


def test_a_state_that_cannot_be_kept_is_a_fault_of_the_frame(caplog):
    with caplog.at_level(logging.CRITICAL):
        result = run(FakeDetector(), Hoarder())
    assert (result.source, result.state) == (Source.EGO_ONLY, {})
    assert "CanonicalizationError" in result.fault


class Numbering(SampleConsensus):
    """A defence of one's own, whose evidence has numbers for names."""

    kind: Literal["numbering"] = "numbering"

    def converse(self, team, state, rng):
        decision = yield from super().converse(team, state, rng)
        told = {"by": [{5: 1, "5": 2}]}
        return replace(
            decision, rejected={name: replace(why, evidence=told) for name, why in decision.rejected.items()}
        )


def test_evidence_by_anything_but_texts_is_a_fault_of_the_frame(caplog):
    with caplog.at_level(logging.CRITICAL):
        result = run(FakeDetector(), Numbering())
    assert result.source == Source.EGO_ONLY
    assert "keys that are no text" in result.fault


class Beginner(SampleConsensus):
    """Asks for this, and then returns that."""

    kind: Literal["beginner"] = "beginner"  # type: ignore[assignment]

    def __init__(self, asked, decided=None):
        super().__init__()
        object.__setattr__(self, "script", (asked, decided))

    def converse(self, team, state, rng):
        asked, decided = self.script
        yield asked
        return decided


class Plain(Beginner):
    """Forgets to yield."""

    def converse(self, team, state, rng):
        return Decision((), Source.EGO_ONLY, dict.fromkeys(team), None, state)


@pytest.mark.parametrize(
    ("defense", "words"),
    [
        (Plain([]), "TypeError: beginner: converse must be a generator"),
        (Beginner(None), "TypeError: beginner: converse must yield lists of hypotheses, got a NoneType"),
        (Beginner(["a"]), "ValueError: beginner: converse asked for 'a'; a hypothesis is a tuple of teammates"),
        (Beginner([("a", "z")]), r"ValueError: beginner: converse asked for \('a', 'z'\); .* who are a, b, c, d, e"),
        (Beginner([("a",)]), "TypeError: beginner: converse must return a Decision, got a NoneType"),
    ],
)
def test_a_conversation_in_another_form_is_told(defense, words, caplog):
    with caplog.at_level(logging.CRITICAL):
        result = run(FakeDetector(), defense)
    assert (result.source, result.accepted) == (Source.EGO_ONLY, ())
    assert re.match(words, result.fault)
