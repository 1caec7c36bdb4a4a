"""A fleet's statistics: drift, robust z and the summary, on truth that was put in."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.core.arrays import FloatArray
from calib.runner.fleet import (
    Drift,
    FleetSummary,
    RigSpec,
    drift_limit,
    drift_of,
    limit_of,
    robust_z,
    spread_of,
    summarise,
    table_of,
)
from calib.runner.outcomes import Outcome


def _line(t: FloatArray, x: FloatArray, sigma: FloatArray) -> Drift:
    found = drift_of(t, x, sigma, spread_of(x, sigma))
    assert found is not None
    return found


def _drawn(rng: np.random.Generator, n: int, slope: float, dirty: float) -> Drift:
    t = 5000.0 + np.arange(n)
    sigma = rng.uniform(0.3, 1.0, n)
    x = 273.0 + slope * (t - 5000.0) + rng.standard_normal(n) + sigma * rng.standard_normal(n)
    bad = rng.random(n) < dirty
    x[bad] += 60.0 * rng.choice([-1.0, 1.0], int(bad.sum()))
    return _line(t, x, sigma)


@pytest.mark.few(2)
@pytest.mark.parametrize(("n", "dirty"), [(20, 0.0), (100, 0.0), (100, 0.1)])
def test_the_slope_is_as_good_as_its_sigma_says(n: int, dirty: float) -> None:
    rng = np.random.default_rng(n)
    pulls = []
    for _ in range(400):
        found = _drawn(rng, n, 0.02, dirty)
        pulls.append((found.slope - 0.02) / found.sigma)
    assert abs(np.mean(pulls)) < 4.0 / np.sqrt(400)
    assert 0.85 < np.std(pulls) < 1.25


def test_a_drift_is_beyond_the_limit_and_chance_is_not() -> None:
    rng = np.random.default_rng(1)
    limit = drift_limit(100, 20)
    assert abs(_drawn(rng, 100, 0.04, 0.05).z) > limit
    still = [abs(_drawn(rng, 100, 0.0, 0.0).z) > limit for _ in range(300)]
    assert np.mean(still) < 0.02


ORDER = ("a", "b", "c")
MU = np.array([273.0, 160.0, -0.22])
ROOT = np.diag([2.0, 0.8, 0.003]) @ np.array([[1.0, 0.0, 0.0], [0.5, 0.9, 0.0], [0.0, -0.3, 0.95]])
T = ROOT @ ROOT.T


@given(
    st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=40),
    st.floats(0.1, 10.0),
    st.floats(-1e3, 1e3),
)
def test_z_does_not_depend_on_units(values: list[float], factor: float, shift: float) -> None:
    x = np.round(np.array(values), 3)
    sigma = np.full(len(x), 0.25)
    z = robust_z(x, sigma, spread_of(x, sigma))
    y, bars = factor * x + shift, factor * sigma
    np.testing.assert_allclose(robust_z(y, bars, spread_of(y, bars)), z, rtol=1e-5, atol=1e-5)


def test_chance_alone_is_beyond_the_limit_in_about_one_fleet_of_twenty() -> None:
    rng = np.random.default_rng(5)
    trials, constants = 250, 12
    for rigs in (20, 200):
        limit, false = limit_of(rigs, constants), 0
        for _ in range(trials):
            sigma = rng.uniform(0.3, 1.0, (constants, rigs))
            x = 5.0 + rng.standard_normal((constants, rigs)) + sigma * rng.standard_normal((constants, rigs))
            z = [robust_z(x[k], sigma[k], spread_of(x[k], sigma[k])) for k in range(constants)]
            false += bool((np.abs(z) > limit).any())
        # 5 % plus what the subtraction of the rigs' own sigma adds; three deviations of so many trials.
        assert false / trials < 0.05 + 0.03 + 3.0 * np.sqrt(0.05 * 0.95 / trials)
    assert limit_of(8, 1) > limit_of(50, 1) > 3.5 and limit_of(5000, 9) > limit_of(5000, 1)


def test_a_fifth_of_bad_rigs_does_not_hide_itself() -> None:
    rng = np.random.default_rng(2)
    x = rng.standard_normal(100)
    x[:20] += 12.0
    sigma = np.full(100, 0.1)
    z = robust_z(x, sigma, spread_of(x, sigma))
    limit = limit_of(100, 10)
    assert (np.abs(z[:20]) > limit).all() and not (np.abs(z[20:]) > limit).any()


def _fleet(count: int, seed: int = 0) -> list[tuple[RigSpec, Outcome]]:
    """Rigs of which the 7th stands out in cx, the 3rd has failed, the 5th is poor, and fx drifts."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(1, count + 1):
        values = {
            "camera.fx_px": (273.0 + 0.02 * k + 0.3 * rng.standard_normal(), 0.2),
            "camera.cx_px": (160.0 + 0.5 * rng.standard_normal() + 9.0 * (k == 7), 0.1),
            "camera.views": (6.0 + k % 2, None),
            "plane.R_CW[0][0]": (rng.standard_normal(), None),
            "lens.region_mean_px": (0.5 + 0.01 * rng.standard_normal() - 0.3 * (k % 10 == 0), None),
            "camera.skew_px": (0.0, None),
        }
        status, code = ("failed", 3) if k == 3 else ("poor", 1) if k == 5 else ("ok", 0)
        name = f"rig{k}"
        outcome = Outcome(
            name=name,
            status=status,
            code=code,
            sentence="" if status == "ok" else f"why {k}",
            stages={"intrinsics": status},
            values=values if status != "failed" else {},
        )
        out.append((RigSpec(name, "/x", f"S{k:05d}"), outcome))
    return out


def _summary(count: int) -> FleetSummary:
    known = _fleet(count)
    summary, worst, which = summarise(table_of(known))
    assert worst.shape == (count,) and len(which) == count
    assert which[6] == "camera.cx_px" and worst[6] > summary.limit and np.isnan(worst[2])
    return summary


def test_outliers_drift_and_looks() -> None:
    found = _summary(120)
    by_name = {one.name: one for one in found.constants}
    assert set(by_name) == {"camera.fx_px", "camera.cx_px"}
    assert found.verdicts == {"failed": 1, "poor": 1, "ok": 118}
    assert found.stages == {"intrinsics": {"ok": 118, "failed": 1, "poor": 1}}
    fx, cx = by_name["camera.fx_px"], by_name["camera.cx_px"]
    assert fx.drifts and fx.drift is not None
    assert abs(fx.drift.slope - 0.02) < 4.0 * fx.drift.sigma
    assert not cx.drifts and cx.standing_out == 1 and cx.out[0][0] == "rig7" and fx.unit == "px"
    assert sum(cx.counts) + cx.below + cx.above == 119 and cx.above == 1
    assert [look.name for look in found.looks] == ["rig3", "rig7", "rig5"] and found.to_look_at == 3
    assert found.looks[0].why == "why 3" and "camera cx is" in found.looks[1].why
    assert found.numbered == 120


def test_few_results_are_not_compared() -> None:
    """Seven rigs with a result beside one without: nobody can say that none stands out."""
    found = summarise(table_of(_fleet(8)))[0]
    assert found.verdicts["failed"] == 1 and found.constants[0].spread.count == 7
    assert np.isnan(found.limit)
    assert found.remark == "No rig is compared with the others: fewer than 8 have a result."
    assert not _summary(40).remark


def test_its_size_does_not_grow_with_the_fleet() -> None:
    for count in (40, 2000):
        found = _summary(count)
        assert all(len(one.points) <= 240 and len(one.counts) == 36 for one in found.constants)
