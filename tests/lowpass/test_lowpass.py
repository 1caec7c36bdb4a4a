"""Low-pass filters against SciPy and exact arithmetic; jitter and motion from a log; suggestions."""

from __future__ import annotations

import math
from fractions import Fraction
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.signal import (
    bessel,
    butter,
    cheb1ap,
    cheb2ap,
    cheby1,
    cheby2,
    ellip,
    ellipap,
    group_delay,
    sos2tf,
    sosfilt,
    sosfreqz,
)

import calib
from calib.core.errors import BadInputError
from calib.io.logs import read_log, write_log
from calib.stages.actuator.kinematics import marker_from_head
from calib.stages.camera.pose import plane_map
from calib.stages.lowpass.filters import (
    FAMILIES,
    Design,
    dc_delay_s,
    design_lowpass,
    digital_poles,
    filter_signal,
    frequency_response,
    group_delay_s,
    noise_gain,
    prototype,
    rest_error_binary32,
)
from calib.stages.lowpass.jitter import jitter_after, resample_to_ticks, spectrum, suggest
from calib.stages.lowpass.stage import positions_from_log, solve
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.sensors import marker_pixels
from calib.twin.simulate import run_log

FREQUENCIES = np.array([0.0, 0.1, 0.7, 1.0, 3.0, 11.0, 29.0])


@pytest.mark.parametrize("order", [1, 2, 5, 8])
@pytest.mark.parametrize(("family", "scipys"), [("butterworth", butter), ("bessel", bessel)])
def test_the_response_is_scipys(order: int, family: str, scipys: object) -> None:
    words = {"norm": "mag"} if family == "bessel" else {}
    expected = scipys(order, 1.3, fs=60.0, output="sos", **words)
    ours = design_lowpass(Design(1.3, 60.0, order, family)).exact
    _, H = sosfreqz(ours, FREQUENCIES, fs=60.0)
    _, theirs = sosfreqz(expected, FREQUENCIES, fs=60.0)
    np.testing.assert_allclose(H, theirs, rtol=1e-7, atol=1e-13)


@pytest.mark.parametrize("order", [1, 2, 5, 8])
def test_critical_poles_are_equal_and_lose_half_the_power(order: int) -> None:
    _, poles = prototype("critical", order)
    assert np.all(poles == poles[0])
    gain = np.prod(poles / (poles - 1j))
    assert abs(gain) ** 2 == pytest.approx(0.5, rel=1e-12)


@pytest.mark.parametrize("order", [1, 2, 3, 5, 8])
@pytest.mark.parametrize(
    ("family", "analogue", "scipys", "ripples"),
    [
        ("chebyshev1", cheb1ap, cheby1, (0.5,)),
        ("chebyshev2", cheb2ap, cheby2, (40.0,)),
        ("elliptic", ellipap, ellip, (0.5, 40.0)),
    ],
)
def test_rippled_responses_are_scipys_but_for_what_names_the_cutoff(
    order: int, family: str, analogue: object, scipys: object, ripples: tuple[float, ...]
) -> None:
    """SciPy names the end of the ripples; the gain at rest is 1 here."""
    cut = abs(np.atleast_1d(analogue(order, *ripples)[1])[0] / prototype(family, order)[1][0])
    end_hz = 60.0 / np.pi * np.arctan(np.tan(np.pi * 1.3 / 60.0) / cut)
    expected = scipys(order, *ripples, end_hz, fs=60.0, output="sos")
    _, theirs = sosfreqz(expected, FREQUENCIES, fs=60.0)
    _, H = sosfreqz(design_lowpass(Design(1.3, 60.0, order, family)).exact, FREQUENCIES, fs=60.0)
    np.testing.assert_allclose(np.abs(H), np.abs(theirs / theirs[0]), rtol=1e-6, atol=1e-12)


RIPPLED = ("chebyshev1", "chebyshev2", "elliptic")
CUTOFF = st.floats(1e-3, 0.499)


@settings(max_examples=150, deadline=None)
@given(CUTOFF, st.integers(1, 8), st.sampled_from(FAMILIES + RIPPLED))
def test_the_gain_at_rest_is_exactly_one_in_binary32(part: float, order: int, family: str) -> None:
    try:
        made = design_lowpass(Design(part * 60.0, 60.0, order, family))
    except BadInputError:
        assert part < 0.01
        return
    for section in made.sections:
        assert np.array_equal(section.astype(np.float32).astype(np.float64), section)
        b, a = [Fraction(v) for v in section[:3]], [Fraction(v) for v in section[3:]]
        assert sum(b) == sum(a) > 0
        # Zeros on the unit circle, both at z = -1 where the family has none.
        assert b[2] in (0, b[0])
        assert family in RIPPLED or b[0] - b[1] + b[2] == 0
    assert made.stable
    assert made.pole_radius < 1.0


@pytest.mark.parametrize("family", FAMILIES + RIPPLED)
@pytest.mark.parametrize("order", [1, 2, 3, 8])
def test_rounding_moves_the_cutoff_little_and_poles_are_those_of_the_sections(
    order: int, family: str
) -> None:
    made = design_lowpass(Design(1.0, 60.0, order, family))
    np.testing.assert_allclose(made.sections, made.exact, rtol=2e-4, atol=2e-7)
    assert len(digital_poles(made.sections)) == order
    assert len(made.sections) == (order + 1) // 2

    def power(f: float) -> float:
        return float(np.abs(sosfreqz(made.sections, [f], fs=60.0)[1][0])) ** 2 - 0.5

    assert brentq(power, 0.1, 5.0) == pytest.approx(1.0, abs=1e-5)


F = np.array([0.0, 0.05, 0.5, 1.0, 2.0, 7.0, 25.0])
EVERY = [(order, family) for order in (1, 2, 5) for family in FAMILIES + RIPPLED]


def _sections(order: int = 1, family: str = "butterworth", cutoff: float = 1.0) -> np.ndarray:
    return design_lowpass(Design(cutoff, 60.0, order, family)).sections


@pytest.mark.parametrize(("order", "delay_s"), [(1, 0.159), (2, 0.225)])
def test_the_delay_of_slow_motion(order: int, delay_s: float) -> None:
    sections = _sections(order)
    assert dc_delay_s(sections, 60.0) == pytest.approx(delay_s, abs=5e-4)
    # A ramp arrives late by just that.
    t = np.arange(3000) / 60.0
    assert 40.0 - np.interp(40.0, t, filter_signal(sections, t)) == pytest.approx(
        dc_delay_s(sections, 60.0), rel=1e-6
    )


@pytest.mark.parametrize(("order", "family"), EVERY)
def test_response_and_delay_are_scipys(order: int, family: str) -> None:
    sections = _sections(order, family)
    H = frequency_response(sections, F, 60.0)
    np.testing.assert_allclose(H, sosfreqz(sections, F, fs=60.0)[1], rtol=1e-9, atol=1e-15)
    h = 1e-4
    ahead, behind = (frequency_response(sections, F[1:] + s * h, 60.0) for s in (1.0, -1.0))
    slope = -np.angle(ahead / behind) / (4.0 * np.pi * h)
    np.testing.assert_allclose(group_delay_s(sections, F[1:], 60.0), slope, rtol=1e-6, atol=1e-7)
    if order <= 2:
        _, theirs = group_delay(sos2tf(sections), w=F[:-1], fs=60.0)
        np.testing.assert_allclose(group_delay_s(sections, F[:-1], 60.0), theirs / 60.0, rtol=1e-6, atol=1e-9)


def test_filtering_is_the_firmwares_difference_equation() -> None:
    x = 0.3 + np.random.default_rng(1).normal(size=400)
    exact = design_lowpass(Design()).exact
    b0, a1, out = exact[0, 0], exact[0, 4], [x[0]]
    for before, value in pairwise(x):
        out.append(b0 * (before + value) - a1 * out[-1])
    np.testing.assert_allclose(filter_signal(exact, x), out, rtol=0.0, atol=1e-13)
    assert filter_signal(exact, x[:1]) == pytest.approx(x[:1])


@pytest.mark.parametrize(("order", "family"), EVERY)
def test_the_noise_gain_is_the_sum_of_squares(order: int, family: str) -> None:
    sections = _sections(order, family, 0.8)
    impulse = np.zeros(20_000)
    impulse[0] = 1.0
    assert noise_gain(sections) == pytest.approx(float(np.sum(sosfilt(sections, impulse) ** 2)), rel=1e-9)


@pytest.mark.few(0, 2)
@pytest.mark.parametrize(("cutoff_hz", "order"), [(1.0, 1), (0.1, 2), (0.03, 4), (0.03, 7)])
def test_a_slow_filter_rests_where_its_input_is(cutoff_hz: float, order: int) -> None:
    """The firmware's form, where the direct form of the same coefficients stays off by much more."""
    made = design_lowpass(Design(cutoff_hz, 60.0, order))
    # 0.01 mm at 0.11 m, beyond which it is called poor.
    assert rest_error_binary32(made) < 9e-5
    if order < 4:
        return
    y = sosfilt(made.sections.astype(np.float32), np.ones(40_000, dtype=np.float32))
    assert y.dtype == np.float32
    assert abs(float(y[-1]) - 1.0) > 1e-4


FIRST = design_lowpass(Design()).sections
T = np.arange(3600) / 60.0


def test_white_jitter_is_measured_through_slow_motion_and_outliers() -> None:
    rng = np.random.default_rng(3)
    noise = 0.2 * rng.normal(size=3600)
    x = 40.0 * np.sin(2.0 * np.pi * 0.1 * T) + noise
    x[::700] += 15.0
    found = spectrum(x, 60.0)
    assert found.flat
    # The line stands 60 dB above the threshold; Hann's side lobes are below that from 7 bins of 1/8 Hz on,
    # and one bin goes to the smoothing.
    assert 0.1 <= found.motion_hz <= 0.1 + 8 / 8
    assert found.outliers >= 6
    assert found.jitter == pytest.approx(0.2, rel=0.15)
    expected = 0.2 * math.sqrt(noise_gain(FIRST))
    assert jitter_after(found, FIRST) == pytest.approx(expected, rel=0.15)
    assert filter_signal(FIRST, noise)[60:].std() == pytest.approx(expected, rel=0.15)


def test_coloured_jitter_above_the_motion_counts_as_it_is() -> None:
    rng = np.random.default_rng(4)
    hum = 0.1 * np.sqrt(2.0) * np.sin(2.0 * np.pi * 20.0 * T)
    found = spectrum(0.02 * rng.normal(size=3600) + hum, 60.0)
    assert found.motion_hz == 0.0
    assert found.jitter == pytest.approx(math.hypot(0.02, 0.1), rel=0.2)
    # A filter at 1 Hz takes the hum out, and only white noise is left.
    assert jitter_after(found, FIRST) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ellipse", "orientation", "chirp"])
def test_the_simulated_rigs_jitter_is_found_in_motion(name: str) -> None:
    rig = SimulatedRig()
    run = run_scenario(make_scenario(name), rig, 1, "sensors", 30.0 if name == "ellipse" else None)
    log = run_log(run)
    rows = log.sampled("u_px", "v_px")
    seen = np.stack([log.columns["u_px"][rows], log.columns["v_px"][rows]], axis=1)
    q = run.trajectory.at(run.sensors.tracker.exposed_s)[:, :2]
    noise = run.sensors.pixels - marker_pixels(rig.view, rig.tracker, q, run.plant.bellows_radius_m)
    for axis in (0, 1):
        one = noise[:, axis][~np.isnan(noise[:, axis])]
        calm = np.where(np.abs(one) < 3.0, one, 0.0)
        found = spectrum(resample_to_ticks(log.t_s[rows], seen, 60.0).longest.values[:, axis], 60.0)
        # Between the jitter without outliers and that with all of them; a floor of few segments to 15 %.
        low, high = (filter_signal(FIRST, value)[60:].std() for value in (calm, one))
        assert 0.85 * low < jitter_after(found, FIRST) < 1.15 * high


T_SUGGEST = np.arange(6000) / 60.0
NOISE = 0.5 * np.random.default_rng(2).normal(size=6000)
REST = spectrum(NOISE, 60.0)
MOVING = spectrum(NOISE + 10.0 * np.sin(2.0 * np.pi * 0.5 * T_SUGGEST), 60.0)


def test_the_wanted_jitter_is_left_and_not_much_less() -> None:
    found = suggest([REST], 0.1, unit="px")
    for one in found.candidates:
        assert 0.098 < one.jitter <= 0.1
    assert filter_signal(found.best.filter.sections, NOISE)[120:].std() == pytest.approx(0.1, rel=0.15)
    assert len(found.candidates) == 1 + 7 * 3


def test_no_filter_of_a_grid_is_faster() -> None:
    found = suggest([REST], 0.15, orders=(1, 2, 3, 4))
    fastest = math.inf
    for family in FAMILIES:
        for order in (1, 2, 3, 4):
            for cutoff in np.geomspace(0.1, 20.0, 80):
                made = design_lowpass(Design(float(cutoff), 60.0, order, family))
                if jitter_after(REST, made.exact) <= 0.15:
                    fastest = min(fastest, dc_delay_s(made.exact, 60.0))
    assert found.candidates[0].delay_s <= 1.001 * fastest


def test_at_rest_the_simplest_of_equals_and_in_motion_the_truest() -> None:
    """With white jitter one pole and one pair have the same delay for the same jitter."""
    rest, moving = suggest([REST], 0.1), suggest([MOVING], 0.1)
    assert rest.best.filter.design.order == 1
    assert moving.best.filter.design.order == 2
    assert moving.best.delay_s <= 1.07 * moving.candidates[0].delay_s
    single = next(one for one in moving.candidates if one.filter.design.order == 1)
    assert moving.best.motion_lost < 0.7 * single.motion_lost


T_TICKS = np.arange(600) / 60.0
X = np.stack([np.arange(600.0), -np.arange(600.0)], axis=1)


def test_jittered_stamps_change_nothing() -> None:
    t = T_TICKS + np.random.default_rng(0).uniform(-0.3, 0.3, 600) / 60.0
    ticks = resample_to_ticks(np.sort(t), X, 60.0)
    assert len(ticks.pieces) == 1
    assert np.array_equal(ticks.longest.values, X)
    assert (ticks.held, ticks.dropped) == (0, 0)


def test_of_duplicates_the_last_counts() -> None:
    rows = np.sort(np.append(np.arange(600), [50, 50, 599]))
    values = np.arange(603.0)[:, None]
    ticks = resample_to_ticks(T_TICKS[rows], values, 60.0)
    assert ticks.dropped == 3
    assert len(ticks.longest.values) == 600
    assert ticks.longest.values[50, 0] == 52.0
    assert ticks.longest.values[-1, 0] == 602.0


def test_a_long_gap_splits_and_a_short_one_does_not() -> None:
    t = np.concatenate([T_TICKS[:200], T_TICKS[200:] + 3600.0])
    ticks = resample_to_ticks(t, X, 60.0)
    assert [len(piece.t_s) for piece in ticks.pieces] == [200, 400]
    assert ticks.longest.t_s[0] == pytest.approx(3600.0 + 200 / 60.0)
    assert ticks.held == 0
    assert len(resample_to_ticks(np.concatenate([T_TICKS[:200], T_TICKS[200:] + 0.5]), X, 60.0).pieces) == 1


WORKSPACE = (-0.06, 0.04, 0.06, 0.11)


def test_positions_are_the_markers_on_the_plane(tmp_path: Path) -> None:
    rig = SimulatedRig()
    run = run_scenario(make_scenario("ellipse"), rig, 2, "sensors", 8.0)
    log = run_log(run)
    write_log(tmp_path / "log.csv", log)
    seen = positions_from_log(
        read_log(tmp_path / "log.csv"),
        60.0,
        partial(plane_map, rig.view.camera, rig.view.R_CW, rig.view.t_CW_m),
    )
    assert (seen.unit, seen.names) == ("m", ("x", "y"))
    piece = seen.ticks.longest
    truth = {name: log.columns[f"true_{name}"] for name in ("x_m", "y_m", "phi_rad")}
    true = marker_from_head(np.stack([truth["x_m"], truth["y_m"]], axis=1), truth["phi_rad"])
    at = np.stack([np.interp(piece.t_s - 0.025, log.t_s, true[:, i]) for i in (0, 1)], axis=1)
    # A pixel is about 1 mm there; medians pass over the outliers.
    assert np.all(np.median(np.abs(piece.values - at), axis=0) < 0.7e-3)
    assert np.all(np.ptp(at, axis=0) > 0.01)


def test_without_a_rate_the_filter_has_that_of_the_logs_camera(tmp_path: Path) -> None:
    run = run_scenario(make_scenario("ellipse"), SimulatedRig(), 2, "sensors", 8.0)
    for every, rate_hz in ((1, 60.0), (2, 30.0)):
        log = run_log(run)
        dropped = np.rint(60.0 * log.t_s).astype(int) % every > 0
        for name in ("u_px", "v_px"):
            log.columns[name][dropped] = np.nan
        write_log(tmp_path / "log.csv", log)
        made = calib.lowpass(calib.Rig(), log=tmp_path / "log.csv")
        assert made.rate_hz == rate_hz
        assert made.log.held <= 0.02 * made.log.ticks
        # The filter was not chosen by this log, so that its jitter decides nothing.
        assert made.verdict.ok
    with pytest.raises(BadInputError, match="30 camera samples/s, expected the 60 Hz"):
        calib.lowpass(calib.Rig(), log=tmp_path / "log.csv", rate_hz=60.0)


def test_a_filter_that_single_precision_spoils_is_poor() -> None:
    verdict = solve(design_lowpass(Design(0.01, 60.0, 2)), WORKSPACE).verdict
    assert verdict.word == "poor"
    assert "Rounded to single precision it cuts at" in verdict.reasons[0]
    assert "comes to rest up to" in verdict.reasons[1]
