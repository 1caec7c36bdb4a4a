"""The tick with CALIB_FUSED 1 on this machine against float64: coherent motion, recorded, random and hostile.

Rounding, with eps = 2^-24 = 6e-8 as in test_pipeline.py:

- marker: as there, 2e-7 m.
- angle: a tick loses eps phi in each of the sums of turn, bias and correction, and the pull of pictures and
  accelerometer, K_c + K_a = 0.02, forgets it: as a random walk 6e-8 x 1.5 x sqrt(3 / (2 x 0.02)) ~ 8e-7 rad.
  The picture's own part, 4e-8 m / lever, is as much. Were all roundings in one direction it would be
  1.4e-5 rad, but their signs change with the last digit. With the usual 2.5 deviations: 2e-6 rad.
- length: eps l per tick and a memory of 1 / K_r = 110 ticks: as a walk 6e-8 x 0.1 x sqrt(110 / 2) ~ 4e-8 m.
  At rest it stops where K_r e no longer changes its last digit, e = 0.5 eps l / K_r ~ 4e-7 m, and the marker
  adds its 2e-7 m: 2e-6 m, as for the low-pass.
- commands: 24000 PWM/m on lengths that err by 4e-7 m after a long rest, 0.0096: 0.01 PWM.
- decisions, rest or motion and a picture left out, can fall either way where a residual is within its error
  of the limit, 4e-7 + 2e-7 m: 1e-6 m, see `compare`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from firmware_build import LIMITS, compare, host, hostile, need, run, strew, write
from firmware_rigs import header, rig

from calib.stages.estimator.constant_gain import Gains, Ticks, run_gains
from calib.stages.estimator.kinematic import Setup, Start
from calib.stages.firmware.conformance import (
    IMU_HELD,
    MARKER_HELD,
    MODE_OFF,
    MODE_POSITION,
    REJECTED,
    STALE,
    FusedReference,
    Inputs,
)
from calib.stages.firmware.header import Header
from calib.stages.firmware.literals import values
from calib.stages.firmware.vectors import PERIOD, binary32, coherent, directed_fused


@pytest.fixture(scope="module", params=["fused", "full"])
def built(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Header, list[str], Path]:
    need("gcc")
    folder = tmp_path_factory.mktemp(request.param)
    write(folder, header(request.param))
    return header(request.param), host(folder, "-DCALIB_FUSED=1"), folder


def _still(made: Header, mode: int = MODE_POSITION) -> Inputs:
    return replace(coherent(values(made.literals), PERIOD)[-1], reference=(0.08, 0.08), mode=mode)


def test_directed_ticks(built: tuple[Header, list[str], Path]) -> None:
    made, command, _ = built
    ticks = directed_fused(values(made.literals), 2000)
    worst, undecided = compare(made, ticks, run(command, ticks), fused=True)
    assert (worst <= LIMITS).all(), worst
    assert undecided <= 0.01


@pytest.mark.slow
def test_a_hundred_thousand_ticks(built: tuple[Header, list[str], Path]) -> None:
    """Coherent motion with random and hostile values strewn in; flags agree at every tick."""
    made, command, _ = built
    rng = np.random.default_rng(8)
    period = directed_fused(values(made.literals), 10_000)
    ticks = [one for _ in range(10) for one in period]
    strew(ticks, rng, losses=30)
    found = run(command, ticks)
    assert np.isfinite(found.numbers).all()
    worst, undecided = compare(made, ticks, found, fused=True)
    print(f"100000 ticks: differences {worst}, undecided {undecided:.2g} PWM")
    assert (worst <= LIMITS).all(), worst
    assert undecided <= 0.01


def test_nothing_is_ever_nan(built: tuple[Header, list[str], Path]) -> None:
    """Every value of every input hostile at once."""
    made, command, _ = built
    rng = np.random.default_rng(9)
    ticks = hostile(rng, 20_000)
    # Pictures from anywhere, one after the other, as well.
    ticks += [
        binary32(replace(one, u_px=float(u), v_px=float(v), gz_radps=float(g), marker_seen=True))
        for one, u, v, g in zip(
            ticks,
            rng.uniform(-1, 317, 20_000),
            rng.uniform(-1, 209, 20_000),
            rng.normal(0, 30, 20_000),
            strict=True,
        )
    ]
    found = run(command, ticks)
    assert np.isfinite(found.numbers).all()
    low, high = values(made.literals)["CALIB_PUMP_LOW_PWM"], values(made.literals)["CALIB_PUMP_HIGH_PWM"]
    assert found.numbers[:, 7:].min() >= low
    assert found.numbers[:, 7:].max() <= high
    assert np.abs(found.numbers[:, 0]).max() <= float(np.float32(1.58))
    assert np.abs(found.numbers[:, 3:7]).max() < 1.0


def test_a_lost_sensor_degrades_and_then_stops_the_pumps(built: tuple[Header, list[str], Path]) -> None:
    made, command, _ = built
    constants = values(made.literals)
    hold, low = int(constants["CALIB_HOLD_TICKS"]), constants["CALIB_PUMP_LOW_PWM"]
    still = _still(made)
    for lost, flag in (({"marker_seen": False}, MARKER_HELD), ({"imu_read": False}, IMU_HELD)):
        ticks = [still] * 2000 + [replace(still, **lost)] * (hold + 50) + [still] * 50
        found = run(command, ticks)
        held = slice(2000, 2000 + hold)
        assert ((found.flags[held] & flag) != 0).all()
        assert ((found.flags[held] & STALE) == 0).all()
        # What is left of the sensors keeps angle and length where they were.
        assert np.ptp(found.numbers[held, 0]) < 5e-3
        assert np.ptp(found.numbers[held, 5:7]) < 2e-4
        stopped = slice(2000 + hold, 2050 + hold)
        assert ((found.flags[stopped] & STALE) != 0).all()
        assert (found.numbers[stopped, 7:] == low).all()
        assert ((found.flags[-50:] & STALE) == 0).all()


def test_another_marker_is_left_out_until_it_stays(built: tuple[Header, list[str], Path]) -> None:
    made, command, _ = built
    still, patience = _still(made, MODE_OFF), int(values(made.literals)["CALIB_FUSED_PATIENCE"])
    far = replace(still, v_px=still.v_px + 25.0)
    found = run(command, [still] * 100 + [far] + [still] * 50 + [far] * 60)
    rejected = (found.flags & REJECTED) != 0
    assert np.flatnonzero(rejected).tolist() == [100, *range(151, 151 + patience)]
    assert found.extra[-1, 6] == 1 + patience
    length = found.numbers[:, 5:7].mean(axis=1)
    assert np.ptp(length[60 : 151 + patience]) < 1e-4
    assert abs(length[-1] - length[140]) > 5e-3


def test_the_first_angle_is_the_accelerometers(built: tuple[Header, list[str], Path]) -> None:
    made, command, _ = built
    ticks = coherent(values(made.literals), 40)
    blind = [replace(ticks[30], marker_seen=False, gz_radps=0.0)] * 3
    found = run(command, blind)
    assert found.numbers[0, 0] == pytest.approx(_angle(made, ticks[30]), abs=1e-6)
    fall = replace(blind[0], ax_mps2=0.1, ay_mps2=0.1)
    assert run(command, [fall]).numbers[0, 0] == 0.0


def _angle(made: Header, given: Inputs) -> float:
    c = values(made.literals)
    A, B = (
        c[f"CALIB_FUSED_ACCEL_{i}1"] * given.ax_mps2
        + c[f"CALIB_FUSED_ACCEL_{i}2"] * given.ay_mps2
        - c[f"CALIB_FUSED_ACCEL_{i}"]
        for i in (1, 2)
    )
    return math.atan2(B, A)


@pytest.mark.parametrize("mean_rate", [False, True])
def test_the_reference_is_the_projects_estimator(mean_rate: bool) -> None:
    """Fed with calibrated readings, `calib.stages.estimator.constant_gain` gives the same angle and
    length."""
    made, whole = header("fused"), rig("fused")
    constants = values(made.literals)
    section = whole.estimator
    assert section is not None and section.constant_gain is not None and whole.align is not None
    gains = Gains(**section.constant_gain.model_dump())
    ticks = list(coherent(constants, 700))
    for k in (90, 91, 300, 420):
        ticks[k] = replace(ticks[k], marker_seen=False)
    for k in (100, 350, 351):
        ticks[k] = replace(ticks[k], imu_read=False)
    for k in (130, 500):
        ticks[k] = replace(ticks[k], u_px=ticks[k].u_px - 25.0)
    reference = FusedReference(constants, mean_rate=mean_rate)
    outs = [reference.step(one) for one in ticks]
    c, K_a = reference.c, reference.c["FUSED_ACCEL_GAIN"]
    rows = np.array([[c[f"FUSED_ACCEL_{i}{j}"] for j in (1, 2)] for i in (1, 2)])
    raw = np.array([[one.ax_mps2, one.ay_mps2] for one in ticks])
    offset = np.array([c["FUSED_ACCEL_1"], c["FUSED_ACCEL_2"]])
    accel = (raw @ rows.T - offset) * 9.81 / K_a
    rate = np.array([c["FUSED_HALF_BIAS_RAD"] - c["FUSED_HALF_DT_S"] * one.gz_radps for one in ticks]) * 120.0
    lost = np.array([not one.imu_read for one in ticks])
    accel[lost], rate[lost] = np.nan, np.nan
    places = np.array([out.marker_m if not out.flags & MARKER_HELD else (np.nan, np.nan) for out in outs])
    sensor = np.zeros(13)
    sensor[6] = c["MARKER_OFFSET_M"]
    head = np.array([0.0, c["REST_LENGTH_M"], 0.0, 0.0, 0.0, 0.0])
    setup = Setup(np.zeros(24), np.zeros(11), Start(sensor, np.zeros(13), head), c["BELLOWS_RADIUS_M"])
    found = run_gains(gains, setup, Ticks(np.arange(700) / 60.0, places, accel, rate), mean_rate)
    phi, length = np.array([[out.phi_rad, 0.5 * sum(out.q_m)] for out in outs]).T
    # The header's constants are rounded to binary32.
    np.testing.assert_allclose(found[:, 0], phi, atol=2e-6)
    np.testing.assert_allclose(found[:, 1], length, atol=3e-8)


def test_a_mean_rate_is_taken_as_it_is(tmp_path: Path) -> None:
    made = header("fused")
    write(tmp_path, made)
    ticks = directed_fused(values(made.literals), 1500)
    found = run(host(tmp_path, "-DCALIB_FUSED=1", "-DCALIB_RATE_IS_MEAN=1"), ticks)
    worst, _ = compare(made, ticks, found, fused=True, mean_rate=True)
    assert (worst <= LIMITS).all(), worst


def test_the_self_test_of_the_estimator_passes(built: tuple[Header, list[str], Path], tmp_path: Path) -> None:
    import subprocess

    made, _, folder = built
    main = '#include "calib_selftest.h"\nint main(void) { return calib_selftest() != 0; }\n'
    text = (folder / "calib_constants.h").read_text()
    name = "CALIB_FUSED_MOVING_RATE"
    wrong = text.replace(f"{name} {made.literals[name]}", f"{name} 0.02f")
    assert wrong != text
    codes = []
    for constants in (text, wrong):
        write(tmp_path, made)
        (tmp_path / "calib_constants.h").write_text(constants)
        (tmp_path / "main.c").write_text(main)
        call = ["gcc", "-std=c99", "-DCALIB_FUSED=1", "-o", "main", "main.c", "-lm"]
        subprocess.run(call, cwd=tmp_path, check=True)
        codes.append(subprocess.run([tmp_path / "main"], check=False).returncode)
    assert codes == [0, 1]
