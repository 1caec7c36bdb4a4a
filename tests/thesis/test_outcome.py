"""The words that the book is written in."""

from __future__ import annotations

import math

from thesis.outcome import TWIN_TOLERANCE, Finding, Outcome, claim, exactly, near, on_twin


def test_a_function_becomes_a_claim_that_computes_it() -> None:
    @claim("a.b", "1.1", "two and two", "5", basis="equations")
    def two() -> Finding:
        return Finding(str(2 + 2), exactly(2 + 2 == 5), "added up", {"sum": 4.0})

    assert (two.id, two.where, two.says, two.printed) == ("a.b", "1.1", "two and two", "5")
    assert (two.kind, two.basis) == ("math", "equations")
    found = two.check()
    assert found.outcome is Outcome.REFUTED
    assert found.numbers == {"sum": 4.0} and not found.simulated


def test_a_rig_that_does_not_show_a_thing_refutes_nothing() -> None:
    assert on_twin(True) is exactly(True) is Outcome.REPRODUCED
    assert on_twin(False) is Outcome.UNMEASURED
    assert exactly(False) is Outcome.REFUTED


def test_near_is_a_share_of_the_printed_figure_on_both_sides() -> None:
    assert near(2.0 * (1.0 + 0.99 * TWIN_TOLERANCE), 2.0) and near(-1.95, -2.0)
    assert not near(2.0 * (1.0 + 1.01 * TWIN_TOLERANCE), 2.0)
    assert not near(2.0, -2.0) and not near(None, 2.0) and not near(math.nan, 2.0)
