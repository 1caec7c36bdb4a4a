"""The book of claims and its figures: outcomes and values as before, and that outcomes follow from values."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from figure_checks import complaints, words_of

from calib.core.plot import KINDS as CURVES
from calib.stages.actuator.dynamics import coriolis_matrix, mass_matrix
from calib.stages.actuator.kinematics import forward_jacobian
from calib.stages.actuator.parameters import Plant
from calib.stages.control.laws import Channel, FeedForward
from thesis import control, mechanics, sensing
from thesis.book import (
    ALBUM,
    BASES,
    BOOK,
    KINDS,
    Claim,
    Drawing,
    Outcome,
    examine,
    golden_figure,
    holds,
    outcome_of,
    row,
    words,
)
from thesis.plot import curves_of
from thesis.robustness import varied
from thesis.runs import nominal, tried, use
from thesis.sheets import figure, write_figures

GOLDEN = json.loads(Path(__file__).with_name("golden.json").read_text())
"""Written by `python tests/thesis --golden`; a difference is to be explained, not refreshed away."""

NAMES = {one.id: one for one in BOOK}
REPRODUCED, REFUTED, CONSTRUCTED, UNMEASURED = Outcome


def _same(ours: Any, kept: Any) -> bool:
    """Whether two documents agree, floats to a millionth or 1e-9, below which rounding decides."""
    if isinstance(kept, dict):
        return ours.keys() == kept.keys() and all(_same(ours[key], kept[key]) for key in kept)
    if isinstance(kept, list):
        return len(ours) == len(kept) and all(map(_same, ours, kept))
    return ours == (kept if isinstance(kept, str) else pytest.approx(kept, rel=1e-6, abs=1e-9))


@pytest.mark.parametrize("claim", BOOK, ids=list(NAMES))
def test_every_claim_is_computed_and_comes_out_as_before(claim: Claim) -> None:
    one = examine(claim)
    kept = GOLDEN["claims"][claim.id]
    assert one.outcome.value == kept["outcome"], f"{one.ours}; {one.how}"
    assert _same(one.values, kept["values"]), f"found {one.values}, expected {kept['values']}"
    assert all(math.isfinite(value) for value in one.values.values() if not isinstance(value, str))
    assert "nan" not in one.ours + one.how
    assert json.loads(json.dumps(row(one)))["values"] == one.values
    # What a rig that was chosen shows is no proof, and measurements that are missing refute nothing.
    assert claim.basis != "chosen" or one.outcome in (CONSTRUCTED, UNMEASURED)
    assert claim.kind != "data" or one.outcome is not REFUTED


@pytest.mark.parametrize("drawing", ALBUM, ids=[one.number for one in ALBUM])
def test_every_figure_is_whole_and_as_before(drawing: Drawing) -> None:
    plot, values = drawing.make()
    assert _same(golden_figure(plot, values), GOLDEN["figures"][drawing.number])
    assert "nan" not in drawing.note.format(**values) and not drawing.source.endswith(".")
    if plot is None:
        assert drawing.boxes and drawing.wires
        return
    labels = [curve.label for curve in curves_of(plot) if curve.label]
    assert labels and len(set(labels)) == len(labels)
    for curve in curves_of(plot):
        assert curve.kind in CURVES and len(curve.x) == len(curve.y) > 0
        assert np.isfinite(curve.x).all() and np.isfinite(curve.y).mean() > 0.5


QUICK = ("3.17", "4.3", "4.10", "4.16")


@pytest.mark.parametrize(
    "drawing",
    [
        pytest.param(one, marks=() if one.number in QUICK else pytest.mark.slow, id=one.number)
        for one in ALBUM
    ],
)
def test_a_figure_is_legible(drawing: Drawing) -> None:
    one = figure(drawing, *drawing.make())
    assert complaints(one) == []
    assert f"Figure {drawing.number}, simulated." in words_of(one)


def test_the_book_has_every_claim_and_figure_once_and_each_tolerance_its_reason() -> None:
    assert list(NAMES) == list(GOLDEN["claims"]) and len(NAMES) == len(BOOK)
    assert [one.number for one in ALBUM] == list(GOLDEN["figures"])
    computed = [
        name
        for module in (sensing, mechanics, control)
        for name, value in vars(module).items()
        if isinstance(value, partial)
        or (
            getattr(value, "__module__", "") == module.__name__
            and name.startswith(("imu_", "cam_", "lp_", "pump_", "kin_", "dyn_", "fit_", "ctl_", "figure_"))
        )
    ]
    stated = [one.id for one in BOOK] + [f"figure.{one.number}" for one in ALBUM]
    assert sorted(computed) == sorted(name.replace(".", "_") for name in stated)
    for one in BOOK:
        assert one.kind in KINDS and one.basis in BASES and one.statement and one.where
        assert bool(one.expect) == bool(one.tolerance)
        # A figure of another rig is not held against measurements.
        assert not (one.kind == "data" and one.basis == "twin" and one.expect)


@pytest.mark.parametrize(
    ("condition", "inside", "outside"),
    [
        ("5 +- 0.1", (4.91, 5.09), (4.89, 5.11, math.nan)),
        ("-0.3034 +- 10 %", (-0.33, -0.28), (-0.34, -0.27, 0.3034)),
        ("31/483840", (31 / 483840,), (6.4e-5,)),
        ("< 1e-6", (0.0, -1.0), (1e-6, math.nan)),
        ("> 0.7", (0.71,), (0.7, math.nan)),
        (595, (595,), (594.9,)),
    ],
)
def test_conditions(condition: str | float, inside: tuple[float, ...], outside: tuple[float, ...]) -> None:
    assert all(holds(condition, value) for value in inside)
    assert not any(holds(condition, value) for value in outside)


@pytest.mark.parametrize(
    ("kind", "basis", "met", "missed"),
    [
        ("math", "equations", REPRODUCED, REFUTED),
        ("plant", "printed", REPRODUCED, REFUTED),
        ("math", "twin", REPRODUCED, REFUTED),
        ("plant", "twin", REPRODUCED, UNMEASURED),
        ("plant", "chosen", CONSTRUCTED, UNMEASURED),
        ("math", "chosen", CONSTRUCTED, UNMEASURED),
    ],
)
def test_the_outcome_follows_from_basis_kind_and_value(
    kind: str, basis: str, met: Outcome, missed: Outcome
) -> None:
    claim = Claim("a.b", "1.1", "two and two", kind, basis, "", "", expect={"sum": "4 +- 0.1"})
    assert outcome_of(claim, {"sum": 4.05}) is met
    assert outcome_of(claim, {"sum": 4.2}) is missed
    assert outcome_of(replace(claim, expect={}), {"sum": 4.05}) is UNMEASURED


WEAK_LENS = replace(sensing.CAMERA, distortion=np.array([-0.004, -0.001, 0, 0, 0, 0, 0, 0.0]))


@pytest.mark.parametrize(
    ("claim", "module", "name", "value"),
    [
        ("imu.backward_difference", sensing, "advance", lambda *_: (1.0, 0.0)),
        ("cam.negligible", sensing, "CAMERA", WEAK_LENS),
        ("dyn.identity", mechanics, "forward_jacobian", lambda *a: 1.001 * forward_jacobian(*a)),
        ("dyn.mass", mechanics, "mass_matrix", lambda *a: -mass_matrix(*a)),
        ("dyn.coriolis", mechanics, "coriolis_matrix", lambda *a: 1.01 * coriolis_matrix(*a)),
        ("fit.lambda", mechanics, "printed_plant", Plant),
        ("fit.k_bnd", mechanics, "PRINTED_K_BND", 0.16949),
        ("pump.poly", mechanics, "_PRINTED_MM", (-0.1493, 3.756, -25.87, 54.13)),
        ("ctl.pid_discrete", control, "Channel", lambda pid: Channel(replace(pid, Ki=0.99 * pid.Ki))),
        ("ctl.ff", control, "FeedForward", lambda: FeedForward(slope_pwm_per_m=3000.0)),
    ],
)
def test_other_equations_or_numbers_come_to_the_other_outcome(
    monkeypatch: pytest.MonkeyPatch, claim: str, module: ModuleType, name: str, value: Any
) -> None:
    before = examine(NAMES[claim]).outcome
    monkeypatch.setattr(module, name, value)
    assert {before, examine(NAMES[claim]).outcome} == {REPRODUCED, REFUTED}


_J0 = 0.25 * 0.0166 * 0.065**2 + 1.27e-5
_PI = math.pi


@pytest.mark.parametrize(
    ("claim", "value", "expected", "rel"),
    [
        ("cam.naming", "bow_positive", 0.4 * 0.2 * 0.09, 1e-9),  # x k1 (0.5^2 - 0.4^2)
        ("cam.mustache", "turns_at", math.sqrt(0.6 * 0.2201 / 0.5494), 1e-9),
        ("lp.cutoff", "delay_order1_s", 1.0 / (2.0 * _PI), 2e-3),
        ("lp.cutoff", "delay_order2_s", math.sqrt(2.0) / (2.0 * _PI), 2e-3),
        ("lp.cutoff", "kept_of_4hz_percent", 100.0 / math.sqrt(17.0), 0.02),
        # The next term of each alternating series is nearly all that is left out.
        ("kin.series_H", "error_x_um", 65e3 * (_PI / 2) ** 9 / math.factorial(10), 0.05),
        ("kin.series_H", "error_y_um", 65e3 * (_PI / 2) ** 8 / math.factorial(9), 0.05),
        ("kin.rotation", "printed_error", 2.0 * math.sin(0.7), 1e-6),
        ("dyn.ke_share", "percent", 100.0 * 1.27e-5 / _J0, 1e-9),
        # zeta of the axial mode times sqrt(m / 2) over sqrt of the bending mode's mass J0 / (2 r^2).
        ("dyn.damping_lateral", "share", math.sqrt(0.0166 * 0.0126**2 / _J0), 1e-6),
        ("dyn.spring_sign", "growth_per_s", math.sqrt(47.7 / (0.5 * 0.0166)), 1e-6),
        ("fit.out_of_plane", "greatest_mm", 0.5 * 65.0 * math.radians(4.7), 2e-3),
        ("ctl.setpoint", "at_10_s_mm", -25.0, 1e-9),
    ],
)
def test_values_are_those_of_closed_forms(claim: str, value: str, expected: float, rel: float) -> None:
    assert examine(NAMES[claim]).values[value] == pytest.approx(expected, rel=rel)


def test_forces_are_in_balance_in_the_steady_angle() -> None:
    plot, _ = mechanics.figure_3_17()
    spring, other, bending, pump = (curve.y for curve in curves_of(plot))
    assert pump == pytest.approx(spring + bending, abs=0.01)
    assert other == pytest.approx(bending, abs=0.01)


def test_words_and_files(tmp_path: Path) -> None:
    lines = words([examine(one) for one in BOOK if one.id.startswith("kin.")])
    assert lines[0].split() == ["claim", "where", "kind", "basis", "outcome", "our", "figure"]
    assert lines[-3].startswith("7 of 65 claims: 4 reproduced, 2 refuted, 1 consistent by construction")
    some = [one for one in ALBUM if one.number in ("3.5", "4.6")]
    first, again = (write_figures(tmp_path / name, some) for name in ("a", "b"))
    assert [path.name for path in first] == [one.path for one in some] + ["figures.json", "index.html"]
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(first, again, strict=True))
    svg, page = first[0].read_text(), first[3].read_text()
    assert "Figure 3.5, simulated." in svg and "<dc:date>" not in svg and len(svg) < 300_000
    assert all(f'<img src="{one.path}"' in page for one in some)
    rows = json.loads(first[2].read_text())["figures"]
    assert all(one["simulated"] and one["drawn_from"] and one["values"] for one in rows)


def test_runs_are_done_once_for_each_rig() -> None:
    before, rig = tried("swing", 0.5), nominal()
    assert tried("swing", 0.5) is before and tried("swing", 0.5, seed=1) is not before
    try:
        use(varied(0))
        assert not np.array_equal(tried("swing", 0.5).states, before.states)
    finally:
        use(rig)
