"""References: the source's set-points, files, and what the pumps reach."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from control_models import MODELS, NOMINAL, ORIFICE
from hypothesis import given, settings
from hypothesis import strategies as st
from open_loop import simulate

from calib.core.errors import BadInputError
from calib.core.rig import Rig
from calib.stages.actuator.kinematics import angle, forward
from calib.stages.control.reach import follow, largest_angle, longest_m, reachable, slowed
from calib.stages.control.read import read_reference, recorded_reference
from calib.stages.control.references import (
    BUILT_IN,
    Ellipse,
    built_in,
    check_workspace,
    from_angles,
    resampled,
)
from calib.stages.control.rig_model import Model, feed_forward_pwm
from calib.stages.estimator import replay

H = NOMINAL.tick_s
BOX = (-0.06, 0.04, 0.06, 0.11)


def test_the_set_points_of_the_source() -> None:
    elongation = built_in(NOMINAL, "elongation")
    assert elongation.q_m[-1] == pytest.approx([0.09, 0.09]) and np.ptp(elongation.q_m[301:]) == 0.0
    ellipse = built_in(NOMINAL, "ellipse")
    assert ellipse.q_m == pytest.approx(Ellipse().bellows_m(ellipse.t_s, NOMINAL.plant.bellows_radius_m))
    assert len(ellipse.q_m) == 1200 and ellipse.judged_from_s == 2.0
    step, jump = built_in(NOMINAL, "step"), built_in(NOMINAL, "jump")
    assert set(step.phi_rad.tolist()) == {0.7} and step.kind == "angle" and step.jump_s is None
    assert jump.phi_rad[299] == 0.7 and jump.phi_rad[300] == 0.3 and jump.jump_s == 5.0
    for one in (step, jump):
        assert one.path_m(0.065)[0].tolist() == [0.065, 0.065]
        assert one.path_m(0.065)[1:] == pytest.approx(one.q_m[1:])
    assert ellipse.path_m(0.065) is ellipse.q_m


@pytest.mark.parametrize("name", BUILT_IN)
def test_lengths_and_angle_belong_together(name: str) -> None:
    made = built_in(NOMINAL, name)
    assert angle(made.q_m, NOMINAL.plant.bellows_radius_m) == pytest.approx(made.phi_rad, abs=1e-12)
    assert made.duration_s == pytest.approx(len(made.t_s) * H)
    check_workspace(NOMINAL, made, BOX)


@given(st.lists(st.floats(0.06, 0.09), min_size=4, max_size=30))
def test_resampling_keeps_points_and_overshoots_nowhere(values: list[float]) -> None:
    v = np.array(values)
    t = 3.0 + 5 * H * np.arange(len(v))
    out = resampled(t, v[:, None], H)[:, 0]
    assert len(out) == 5 * (len(v) - 1) + 1
    assert out[::5] == pytest.approx(v, abs=1e-12)
    assert v.min() - 1e-12 <= out.min() and out.max() <= v.max() + 1e-12


RADIUS_M = 0.0126
TURN_S = np.linspace(0.0, 20.0, 2001)


def test_the_exact_chord_gives_the_drawn_ellipse_back() -> None:
    ellipse = Ellipse()
    wanted, reached = ellipse.pose(TURN_S), forward(ellipse.bellows_m(TURN_S, RADIUS_M), RADIUS_M)
    assert np.abs(reached - wanted).max() < 1e-15
    x, y = reached[:, 0], reached[:, 1]
    assert np.abs((x / 0.015) ** 2 + ((y - 0.078) / 0.010) ** 2 - 1.0).max() < 1e-12


def _ellipse(period_s: float) -> np.ndarray:
    t = H * np.arange(round(period_s / H))
    return Ellipse(period_s=period_s).bellows_m(t, NOMINAL.plant.bellows_radius_m)


def test_the_longest_and_most_bent_are_those_of_a_long_simulation() -> None:
    full = simulate(NOMINAL.plant, NOMINAL.pump, np.full((1200, 2), 253.5)).q_m[-1]
    assert longest_m(NOMINAL) == pytest.approx(full[0], abs=1e-6)
    one = simulate(NOMINAL.plant, NOMINAL.pump, np.tile([253.5, 0.0], (1200, 1))).q_m[-1]
    phi = (one[0] - one[1]) / (2 * NOMINAL.plant.bellows_radius_m)
    assert largest_angle(NOMINAL) == pytest.approx(phi, abs=1e-5)


@settings(max_examples=40, deadline=None)
@given(q=st.tuples(st.floats(0.06, 0.1), st.floats(0.06, 0.1)))
@pytest.mark.parametrize("model", MODELS[:2])
def test_reachable_is_what_the_map_can_hold(model: Model, q: tuple[float, float]) -> None:
    at = np.array(q)
    pwm = feed_forward_pwm(model, at)
    end = simulate(model.plant, model.pump, np.tile(pwm, (900, 1))).q_m[-1]
    held = bool(np.abs(end - at).max() < 2e-5)
    near = float(np.abs(end - at).max()) < 1e-4
    assert bool(reachable(model, at)) == held or near


def test_a_fast_ellipse_is_lost_while_deflating() -> None:
    found = follow(NOMINAL, _ellipse(8.0))
    assert not found.possible and found.at_s is not None
    assert "bellows 2 would have to deflate at" in found.reason and "leaves at 0.4 N/s" in found.reason
    # Up to there the wanted forces fall no faster than the air leaves, by more than the tolerance.
    k = round(found.at_s / H)
    assert np.abs(found.missing_m[:k]).max() <= 2.5e-4 < np.abs(found.missing_m[k]).max()


def test_near_no_force_the_lag_is_the_reason() -> None:
    """It read "would have to deflate at 0.369 N/s, its air leaves at 0.4 N/s"."""
    bent = from_angles(NOMINAL, "bent", -0.5 * np.sin(0.5 * H * np.arange(600)))
    wanted, leaves = map(float, re.findall(r"at (\S+) N/s", follow(NOMINAL, bent.q_m).reason))
    assert leaves < wanted < 0.4


def test_the_forces_that_follow_can_be_had() -> None:
    """`given` as commands without delay, turned back through the lag, is what the pumps of the twin give."""
    found = follow(NOMINAL, _ellipse(8.0))
    rise = np.diff(found.given_N, axis=0) / H
    assert float(-rise.min()) <= 0.4 + 1e-9
    most = 2.0390829
    a = math.exp(-H / 0.7)
    assert np.all(found.given_N[1:] <= most + (found.given_N[:-1] - most) * a + 1e-9)


@pytest.mark.parametrize("model", [NOMINAL, ORIFICE])
@pytest.mark.parametrize("period_s", [3.0, 8.0])
def test_slowed_it_can_be_followed_on_the_same_path(model: Model, period_s: float) -> None:
    q = _ellipse(period_s)
    if follow(model, q).possible:
        return
    slow, _ = slowed(model, q)
    assert len(slow) > len(q)
    assert follow(model, slow).possible
    assert slow[0] == pytest.approx(q[0], abs=1e-4) and slow[-1] == pytest.approx(q[-1], abs=1e-4)
    # The same path: every point of it lies close to a point of the reference.
    fine = np.concatenate([q[:-1] + s * np.diff(q, axis=0) for s in (0.0, 0.25, 0.5, 0.75)])
    near = np.min(np.linalg.norm(slow[::7, None, :] - fine[None], axis=2), axis=1)
    assert float(near.max()) < 5e-4


R, H_REFERENCEFILE = NOMINAL.plant.bellows_radius_m, NOMINAL.tick_s
Make = Callable[[str], Path]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    def write(text: str) -> Path:
        path = tmp_path / "ref.csv"
        path.write_text(text)
        return path

    return write


def _table(header: str, *columns: np.ndarray) -> str:
    rows = (",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))
    return "\n".join([header, *rows]) + "\n"


def test_lengths_heads_and_angles_are_the_same_motion(make: Make) -> None:
    t = 0.05 * np.arange(101)
    q = Ellipse(period_s=10.0).bellows_m(t, R)
    pose = forward(q, R)
    lengths = read_reference(make(_table("t_s,q1_m,q2_m,junk", t, q[:, 0], q[:, 1], t)), NOMINAL)
    heads = read_reference(make(_table("t_s,x_m,y_m", t, pose[:, 0], pose[:, 1])), NOMINAL)
    angles = read_reference(make(_table("phi_rad,t_s", pose[:, 2], 7.0 + t)), NOMINAL)
    assert heads.q_m == pytest.approx(lengths.q_m, abs=2e-6)
    assert angles.phi_rad == pytest.approx(lengths.phi_rad, abs=1e-4)
    assert (angles.kind, len(angles.q_m)) == ("angle", len(lengths.q_m))


def test_a_recorded_log_is_a_reference(make: Make) -> None:
    """Rows at uneven times, two stamped alike, lengths from the truth of a simulated log."""
    t = np.sort(np.concatenate([np.arange(0, 3, 1 / 60), np.arange(0, 3, 0.01) + 1e-3]))
    t[5] = t[4]
    q = 0.07 + 0.003 * np.sin(t)
    made = read_reference(make(_table("t_s,u_px,true_q1_m,true_q2_m", t, t, q, q)), NOMINAL)
    assert made.q_m[:, 0] == pytest.approx(0.07 + 0.003 * np.sin(made.t_s), abs=1e-6)


def test_a_recorded_log_whose_time_goes_back_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = np.zeros((4, 3))
    rows[:, 0] = 0.0, 2.0, 0.5, 1.0
    monkeypatch.setattr(replay, "opened", lambda *asked: None)
    monkeypatch.setattr(replay, "smoothed_rows", lambda *asked: rows)
    with pytest.raises(BadInputError, match=r"log\.csv: time goes back from 2\.000 to 1\.000 s, expected"):
        recorded_reference(Path("log.csv"), Rig(), Path("rig.yaml"), NOMINAL)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty, expected a header"),
        ("t_s,q1_m\n0,1\n", "has no reference in it, found t_s, q1_m; expected in metres q1_m and"),
        ("t_ms,q1_m,q2_m\n0,1,1\n", "has no column t_s, found t_ms, q1_m, q2_m; expected a reference"),
        ("t_s,q1_m,q2_m\n0,0.07,\n", "line 2: q2_m is blank or nan"),
        ("t_s,q1_m,q2_m\n0,0.07,0.07\n1,0.07,0.07\n0.5,0.07,0.07\n", "line 4: t_s is 0.5 after 1"),
        ("t_s,q1_m,q2_m\n0,0.07,0.07\n5,0.07,0.07\n", "has 2 rows over 5 s"),
        ("t_s,phi_rad\n0,0.1\n1,30\n2,0.1\n", r"line 3: phi_rad is 30, .* 3\.14; is it in degrees\?"),
        ("t_s,q1_m,q2_m\n0,65,65\n", r"line 2: q1_m is 65, expected at most 1; is it in millimetres\?"),
    ],
)
def test_files_that_are_no_references(make: Make, text: str, sentence: str) -> None:
    with pytest.raises(BadInputError, match=sentence):
        read_reference(make(text), NOMINAL)
