"""The book as a whole: every claim of the list, and what is expected to come of it."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest
from outside import outside

from thesis.book import BOOK, by_basis, count, examine, rows, select
from thesis.outcome import BASES, KINDS, Claim, Outcome

REPRODUCED, REFUTED, UNMEASURED = Outcome.REPRODUCED, Outcome.REFUTED, Outcome.UNMEASURED

EXPECTED = {
    "imu.onchip_drift": UNMEASURED,
    "imu.mm_gains": UNMEASURED,
    "imu.mm_drift": UNMEASURED,
    "imu.gyro_lsb": REFUTED,
    "imu.acc_lsb": REPRODUCED,
    "imu.backward_difference": REPRODUCED,
    "cam.points": REPRODUCED,
    "cam.mean_error": UNMEASURED,
    "cam.homography": REFUTED,
    "cam.scale": REPRODUCED,
    "cam.distortion": UNMEASURED,
    "cam.mustache": REPRODUCED,
    "cam.naming": REFUTED,
    "cam.negligible": REFUTED,
    "cam.no_closed_form": REFUTED,
    "cam.offset": REPRODUCED,
    "lp.cutoff": REPRODUCED,
    "pump.threshold": UNMEASURED,
    "pump.poly": REFUTED,
    "pump.range": REPRODUCED,
    "kin.limits": REPRODUCED,
    "kin.series_H": REPRODUCED,
    "kin.rotation": REFUTED,
    "kin.inverse": REPRODUCED,
    "kin.series_f": REPRODUCED,
    "kin.series_f_error": REFUTED,
    "kin.fem": UNMEASURED,
    "dyn.identity": REPRODUCED,
    "dyn.rotational": REPRODUCED,
    "dyn.mass": REPRODUCED,
    "dyn.coriolis": REPRODUCED,
    "dyn.spring_sign": REFUTED,
    "dyn.constants": UNMEASURED,
    "dyn.ke_share": REFUTED,
    "dyn.damping_ratio": UNMEASURED,
    "dyn.damping_lateral": REFUTED,
    "dyn.error_band": UNMEASURED,
    "dyn.static_error": UNMEASURED,
    "fit.lambda": REFUTED,
    "fit.k_bnd": REFUTED,
    "fit.scales": REFUTED,
    "fit.norms": REPRODUCED,
    "fit.out_of_plane": REPRODUCED,
    "pump.g": REFUTED,
    "pump.tau": UNMEASURED,
    "pump.fall": REFUTED,
    "pump.deflation": REPRODUCED,
    "pump.overshoot": UNMEASURED,
    "pump.pwm6v": REPRODUCED,
    "ctl.dt": REPRODUCED,
    "ctl.p": REPRODUCED,
    "ctl.pid_discrete": REPRODUCED,
    "ctl.pid_peak": REPRODUCED,
    "ctl.pid_settle": UNMEASURED,
    "ctl.windup": UNMEASURED,
    "ctl.sim_saturates": UNMEASURED,
    "ctl.ff": REPRODUCED,
    "ctl.setpoint": REFUTED,
    "ctl.pdff_max": REPRODUCED,
    "ctl.pdff_static": UNMEASURED,
    "ctl.integral_delay": UNMEASURED,
    "ctl.ellipse": REFUTED,
    "ctl.ellipse_range": REPRODUCED,
    "ctl.ellipse_wobble": UNMEASURED,
    "ctl.initial": REPRODUCED,
}
"""Changes only together with the code that computes it."""


@pytest.mark.parametrize("claim", BOOK, ids=[claim.id for claim in BOOK])
def test_outcome(claim: Claim) -> None:
    finding = claim.check()
    assert finding.outcome is EXPECTED[claim.id], f"{claim.id}: {finding.ours}; {finding.how}"
    assert finding.ours and "nan" not in finding.ours and finding.how
    assert all(math.isfinite(value) for value in finding.numbers.values())
    assert not (finding.simulated and finding.outcome is REFUTED and claim.kind == "data")
    assert finding.simulated == (claim.basis in ("twin", "chosen"))
    # What was chosen to come out so neither proves nor refutes the text.
    assert not (claim.basis == "chosen" and finding.outcome is REFUTED)


def test_the_book_has_every_claim_once() -> None:
    assert [claim.id for claim in BOOK] == list(EXPECTED)
    assert {claim.kind for claim in BOOK} == set(KINDS)
    assert {claim.basis for claim in BOOK} == set(BASES)
    assert all(claim.says and claim.where and claim.printed for claim in BOOK)


def test_the_book_follows_the_list_of_claims(shared_data: Path) -> None:
    path = outside(shared_data.parent / "reference" / "claims.md")
    listed = re.findall(r"^\| ([a-z]+\.\S+) \|", path.read_text(), re.MULTILINE)
    assert [claim.id for claim in BOOK] == listed


def test_claims_that_need_measurements_are_never_refuted() -> None:
    kinds = {claim.id: claim.kind for claim in BOOK}
    assert all(outcome is not REFUTED for name, outcome in EXPECTED.items() if kinds[name] == "data")


def test_examining_tells_how_far_it_is_and_gives_plain_values() -> None:
    chosen, told = select(["kin.", "ctl.dt"]), []
    found = examine(chosen, lambda done, total: told.append((done, total)))
    assert told == [(k, 8) for k in range(8)]
    assert count(found) == {REPRODUCED: 5, REFUTED: 2, UNMEASURED: 1}
    by = by_basis(found)
    assert tuple(by) == BASES
    assert by["equations"] == {REPRODUCED: 4, REFUTED: 2, UNMEASURED: 0}
    assert sum(sum(outcomes.values()) for outcomes in by.values()) == len(found)
    table = rows(found)
    assert json.loads(json.dumps(table)) == table
    assert table[-1]["id"] == "ctl.dt" and table[-1]["outcome"] == "reproduced"
    assert set(table[0]) >= {"where", "claim", "printed", "ours", "how", "numbers", "simulated", "basis"}


def test_select() -> None:
    assert select([]) == BOOK
    assert [claim.id for claim in select(["cam.mu", "lp"])] == ["cam.mustache", "lp.cutoff"]
    assert select(["nothing"]) == ()
