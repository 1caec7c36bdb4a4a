"""The pipeline in C on this machine against float64: recorded motion, random and hostile ticks."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from armlogs import Arm, swung
from firmware_build import LIMITS, compare, host, hostile, run, selftest, strew, write
from firmware_rigs import header, rig
from source_model import head_from_marker, inverse_series
from ticks import Ticks, run_gains

import calib
from calib.core.errors import BadInputError
from calib.io.serial import MODE_OFF, MODE_ORIENTATION, MODE_POSITION, Inputs
from calib.stages.camera.model import Camera, undistort
from calib.stages.control.laws import Channel, FeedForward, Pid, feed_forward
from calib.stages.estimator.kinematic import Setup, Start
from calib.stages.firmware.conformance import (
    ACCEL_WEAK,
    ANGLE_LIMIT,
    BAD_REFERENCE,
    CLAMPED,
    HORIZON,
    IMU_HELD,
    MARKER_HELD,
    MOVING,
    REJECTED,
    SATURATED,
    STALE,
    FusedReference,
    Reference,
)
from calib.stages.firmware.header import Header, make_header
from calib.stages.firmware.vectors import (
    FUSED_TICKS,
    MOST_TIMES,
    PERIOD,
    Motion,
    binary32,
    coherent,
    directed,
    directed_fused,
    vectors,
)
from calib.stages.imu.levelling import Levelling
from calib.stages.imu.mahony import advance, filter_log
from calib.stages.lowpass.filters import Design, design_lowpass, filter_signal
from calib.stages.lowpass.section import LowPassSection
from calib.twin.pictures import CAMERA, PLANE
from calib.twin.rig import SimulatedRig


class Made(NamedTuple):
    """A header and the program for this machine, with the fused estimator or without."""

    header: Header
    fused: bool
    command: list[str]

    def directed(self, count: int) -> list[Inputs]:
        """Ticks that reach every branch."""
        return (directed_fused if self.fused else directed)(self.header.values, count)

    def check(self, ticks: list[Inputs]) -> None:
        """Hold what the program makes of ticks against float64; flags agree at every tick."""
        found = run(self.command, ticks)
        assert np.isfinite(found.numbers).all()
        worst, undecided = compare(self.header, ticks, found, fused=self.fused)
        print(f"{len(ticks)} ticks: differences {worst}, undecided {undecided:.2g} PWM")
        assert (worst <= LIMITS).all(), worst
        assert undecided <= 0.01


PLAIN = [(kind, False) for kind in ("nominal", "full", "levelling", "fisheye")]
FUSED = [("fused", True), ("full", True)]


@pytest.fixture(scope="module", params=[*PLAIN, *FUSED], ids=str)
def built(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Made:
    kind, fused = request.param
    folder = tmp_path_factory.mktemp(kind)
    write(folder, header(kind))
    return Made(header(kind), fused, host(folder, f"-DCALIB_FUSED={fused:d}"))


@cache
def _logged(ticks: int, seed: int) -> list[Inputs]:
    """Ticks of two simulated experiments, each with the newest IMU sample."""
    from calib.twin.scenarios import make_scenario, run_scenario

    made: list[Inputs] = []
    for name, mode in (("ellipse", MODE_POSITION), ("orientation", MODE_ORIENTATION)):
        plan = make_scenario(name, {})
        record = run_scenario(plan, SimulatedRig(), seed, "sensors", 0.5 * ticks / 60.0)
        newest = np.clip(np.searchsorted(record.sensors.imu.taken_s, record.t_s, side="right") - 1, 0, None)
        for k, (u, v) in enumerate(record.sensors.pixels.tolist()):
            (ax, ay, _), gz = (
                record.sensors.accel_mps2[newest[k]].tolist(),
                float(record.sensors.gyro_radps[newest[k], 2]),
            )
            turn = 0.3 * math.sin(0.01 * k)
            reference = (
                (0.078 + 0.0126 * turn, 0.078 - 0.0126 * turn) if mode == MODE_POSITION else (2.0 * turn, 0.0)
            )
            made.append(binary32(Inputs(u, v, ax, ay, gz, reference, not math.isnan(u), True, mode)))
    return made


def test_directed_ticks(built: Made) -> None:
    built.check(built.directed(2000))


@pytest.mark.slow
def test_a_hundred_thousand_ticks(built: Made) -> None:
    """Motion with random and hostile values strewn in."""
    recorded = [] if built.fused else _logged(10_000, 3)
    ticks = [*recorded, *(10 * built.directed(10_000))[len(recorded) :]]
    strew(ticks, np.random.default_rng(6), losses=30)
    built.check(ticks)


def test_nothing_is_ever_nan(built: Made) -> None:
    """Every value of every input hostile at once, and then with pictures from anywhere."""
    constants, rng = built.header.values, np.random.default_rng(7)
    ticks = hostile(rng, 20_000)
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
    found = run(built.command, ticks)
    assert np.isfinite(found.numbers).all()
    assert found.numbers[:, 7:].min() >= constants["CALIB_PUMP_LOW_PWM"]
    assert found.numbers[:, 7:].max() <= constants["CALIB_PUMP_HIGH_PWM"]
    assert (found.duty == np.floor(found.numbers[:, 7:] + 0.5)).all()
    assert np.abs(found.numbers[:, 0]).max() <= float(np.float32(1.58))
    if built.fused:
        assert np.abs(found.numbers[:, 3:7]).max() < 1.0


def _still(mode: int = MODE_POSITION) -> Inputs:
    return binary32(Inputs(158.0, 80.0, 9.81, 0.0, 0.0, (0.08, 0.08), mode=mode))


@pytest.mark.parametrize("built", PLAIN, ids=str, indirect=True)
def test_a_lost_sensor_holds_and_then_stops_the_pumps(built: Made) -> None:
    made, _, command = built
    hold = int(made.values["CALIB_HOLD_TICKS"])
    low = made.values["CALIB_PUMP_LOW_PWM"]
    for lost, flag in (({"marker_seen": False}, MARKER_HELD), ({"imu_read": False}, IMU_HELD)):
        ticks = [_still()] * 200 + [replace(_still(), **lost)] * (hold + 50) + [_still()] * 50
        found = run(command, ticks)
        held = found.flags[200 : 200 + hold]
        assert ((held & flag) != 0).all()
        assert ((held & STALE) == 0).all()
        assert (found.numbers[200 : 200 + hold, 7:] > low).all()
        assert ((found.flags[200 + hold : 250 + hold] & STALE) != 0).all()
        assert (found.numbers[200 + hold : 250 + hold, 7:] == low).all()
        assert ((found.flags[-50:] & STALE) == 0).all()
        assert found.extra[-1, 3] == 50


def test_the_horizon_is_a_lost_marker(tmp_path: Path) -> None:
    """A plane whose horizon runs through the picture; the marker above it is held and counted."""
    made = header()
    text = dict(made.literals)
    write(tmp_path, made)
    path = tmp_path / "calib_constants.h"
    # 1/s becomes small towards the right edge of the picture.
    least = f"#define CALIB_PLANE_LEAST_PER_M {text['CALIB_PLANE_LEAST_PER_M']}"
    assert least in path.read_text()
    path.write_text(path.read_text().replace(least, "#define CALIB_PLANE_LEAST_PER_M 3.65f"))
    found = run(host(tmp_path), [_still(), replace(_still(), u_px=300.0), replace(_still(), u_px=10.0)])
    assert bool(found.flags[0] & HORIZON) != bool(found.flags[2] & HORIZON) or found.flags[1] & HORIZON
    behind = (found.flags & HORIZON) != 0
    assert behind.any()
    assert not behind.all()
    assert found.extra[-1, 1] == behind.sum()


@pytest.mark.parametrize(
    ("kind", "fused", "name"),
    [
        ("levelling", 0, "CALIB_BELLOWS_RADIUS_M"),
        ("fisheye", 0, "CALIB_BELLOWS_RADIUS_M"),
        ("tilted", 0, "CALIB_BELLOWS_RADIUS_M"),
        ("full", 1, "CALIB_FUSED_MOVING_RATE"),
    ],
)
def test_the_self_test_passes_and_sees_a_wrong_constant(
    tmp_path: Path, kind: str, fused: int, name: str
) -> None:
    made = header(kind)
    write(tmp_path, made)
    wrong = made.text.replace(f"{name} {made.literals[name]}", f"{name} 0.02f")
    assert wrong != made.text
    for constants, passes in ((made.text, True), (wrong, False)):
        (tmp_path / "calib_constants.h").write_text(constants)
        assert selftest(tmp_path, "selftest", f"-DCALIB_FUSED={fused}") == passes


@pytest.mark.few(0)
@pytest.mark.parametrize("rate_hz", [12.0, 30.0, 150.0])
def test_the_self_test_passes_at_other_ticks(tmp_path: Path, rate_hz: float) -> None:
    """At 15 Hz and below the head turned on beyond what a float follows, and the fused board never ran."""
    whole = rig("twin")
    whole = whole.with_sections({"lowpass": calib.lowpass(whole, rate_hz=rate_hz)})
    write(tmp_path, make_header(whole, "rig.yaml"))
    for fused in (0, 1):
        assert selftest(tmp_path, "selftest", f"-DCALIB_FUSED={fused}")


@pytest.mark.parametrize("rate_hz", [400.0, 1000.0])
def test_a_fast_board_holds_a_sensor_for_more_ticks_than_a_row_of_the_self_test_counts(
    tmp_path: Path, rate_hz: float
) -> None:
    whole = rig("nominal")
    whole = whole.with_sections({"lowpass": calib.lowpass(whole, rate_hz=rate_hz)})
    made = make_header(whole, "rig.yaml")
    assert made.values["CALIB_HOLD_TICKS"] > MOST_TIMES
    write(tmp_path, made)
    assert selftest(tmp_path, "selftest")


def test_a_lens_that_is_undone_in_a_part_of_the_picture_only_is_refused() -> None:
    """Beyond what its polynomial was fitted to, the powers of a wide brown5 passed any float."""
    tilted = {"CALIB_PLANE_NORMALISED_31": 1.0, "CALIB_PLANE_NORMALISED_32": -1.0}
    constants = header("full").values | tilted | {"CALIB_LENS_INVERSE_C5": 1e30}
    with pytest.raises(BadInputError, match=r"camera: .* without bound at pixel \(\d+, \d+\), expected"):
        vectors(constants, limits=True)


@pytest.mark.parametrize("fused", [0, 1])
def test_a_controller_without_integral_has_none_that_follows_the_limits(tmp_path: Path, fused: int) -> None:
    """A PD beside the back-calculation of `calib control tune`: board, reference and simulation agree."""
    tuned = rig("full").controller
    assert tuned is not None
    assert tuned.orientation.back_calculation_s > 0.0
    plain = tuned.orientation.model_copy(update={"Ki_pwm_per_rad_s": 0.0})
    whole = rig("full").with_sections({"controller": tuned.model_copy(update={"orientation": plain})})
    write(tmp_path, make_header(whole, "rig.yaml"))
    assert selftest(tmp_path, "selftest", f"-DCALIB_FUSED={fused}")


def test_signs_of_the_imus_axes(tmp_path: Path) -> None:
    """An IMU that is mounted the other way round, by hand in the header."""
    made = header()
    write(tmp_path, made)
    path = tmp_path / "calib_constants.h"
    constants = dict(made.values)
    text = path.read_text()
    for axis in ("AX", "AY", "GZ"):
        constants[f"CALIB_IMU_SIGN_{axis}"] = -1.0
        text = text.replace(f"#define CALIB_IMU_SIGN_{axis} 1 ", f"#define CALIB_IMU_SIGN_{axis} -1 ")
    path.write_text(text)
    upright = directed(constants, 600)
    turned = [replace(t, ax_mps2=-t.ax_mps2, ay_mps2=-t.ay_mps2, gz_radps=-t.gz_radps) for t in upright]
    found = run(host(tmp_path), turned)
    plain = tmp_path / "plain"
    plain.mkdir()
    write(plain, made)
    assert np.array_equal(found.numbers, run(host(plain), upright).numbers)
    reference = Reference(constants)
    wanted = np.array([reference.step(t, int(f)).numbers for t, f in zip(turned, found.flags, strict=True)])
    assert (np.abs(found.numbers - wanted).max(axis=0) <= LIMITS).all()


@pytest.mark.few(1)
@pytest.mark.parametrize("order", [2, 5, 8])
def test_low_passes_of_every_order(tmp_path: Path, order: int) -> None:
    section = rig("full").lowpass
    assert section is not None
    rows = design_lowpass(Design(3.0, 60.0, order)).sections.tolist()
    sections = [LowPassSection(b=row[:3], a=row[3:]) for row in rows]
    other = section.model_copy(update={"order": order, "cutoff_hz": 3.0, "sections": sections})
    made = make_header(rig().with_sections({"lowpass": other}), "rig.yaml")
    write(tmp_path, made)
    Made(made, False, host(tmp_path)).check(directed(made.values, 1500))


def _still_fused(made: Header, mode: int = MODE_POSITION) -> Inputs:
    return replace(coherent(made.values, PERIOD)[-1], reference=(0.08, 0.08), mode=mode)


@pytest.mark.parametrize("built", FUSED, ids=str, indirect=True)
def test_a_lost_sensor_degrades_and_then_stops_the_pumps(built: Made) -> None:
    made, _, command = built
    constants = made.values
    hold, low = int(constants["CALIB_HOLD_TICKS"]), constants["CALIB_PUMP_LOW_PWM"]
    still = _still_fused(made)
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


@pytest.mark.parametrize("built", FUSED, ids=str, indirect=True)
def test_another_marker_is_left_out_until_it_stays(built: Made) -> None:
    made, _, command = built
    still, patience = (
        _still_fused(made, MODE_OFF),
        int(made.values["CALIB_FUSED_PATIENCE"]),
    )
    far = replace(still, v_px=still.v_px + 25.0)
    found = run(command, [still] * 100 + [far] + [still] * 50 + [far] * 60)
    rejected = (found.flags & REJECTED) != 0
    assert np.flatnonzero(rejected).tolist() == [100, *range(151, 151 + patience)]
    assert found.extra[-1, 6] == 1 + patience
    length = found.numbers[:, 5:7].mean(axis=1)
    assert np.ptp(length[60 : 151 + patience]) < 1e-4
    assert abs(length[-1] - length[140]) > 5e-3


@pytest.mark.parametrize("mean_rate", [False, True])
def test_the_reference_is_the_projects_estimator(mean_rate: bool) -> None:
    """Fed with calibrated readings, `calib.stages.estimator.constant_gain` gives the same angle and
    length."""
    made, whole = header("fused"), rig("fused")
    constants = made.values
    section = whole.estimator
    assert section is not None and section.constant_gain is not None and whole.align is not None
    gains = section.constant_gain
    ticks = coherent(constants, 700, lateness=lambda k: 0.0)
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


TICKS = 600


def _ticks(mode: int) -> list[Inputs]:
    made = []
    for k in range(TICKS):
        phi = 0.9 * math.sin(0.02 * k)
        made.append(
            binary32(
                Inputs(
                    158.0 + 60.0 * math.sin(0.017 * k),
                    130.0 + 40.0 * math.cos(0.011 * k),
                    9.81 * math.cos(phi) + 0.4 * math.sin(0.5 * k),
                    9.81 * math.sin(phi) + 0.4 * math.cos(0.7 * k),
                    -0.9 * 0.02 * 60.0 * math.cos(0.02 * k),
                    (0.085 + 0.02 * math.sin(0.03 * k), 0.08)
                    if mode == MODE_POSITION
                    else (0.7 * math.sin(0.01 * k), 0),
                    mode=mode,
                )
            )
        )
    return made


def _true_marker(camera: Camera, u: float, v: float) -> np.ndarray:
    """The point of the plane that the camera shows at a pixel, by the ray through it."""
    x, y = undistort(camera, np.array([[u, v]]))[0]
    R, t = np.array(PLANE.R_CW), np.array(PLANE.t_m)
    normal = R[:, 2]
    ray = np.array([x, y, 1.0])
    return np.asarray((R.T @ (ray * (normal @ t) / (normal @ ray) - t))[:2])


def _levelled(arm: Arm, lost: slice = slice(0)) -> np.ndarray:
    """Angles (n,) of the levelling filter with a calibrated sensor that gives nothing in these ticks."""
    constants = dict(header("levelling").values) | {
        "CALIB_IMU_ACCEL_BIAS_X_MPS2": 0.0,
        "CALIB_IMU_ACCEL_BIAS_Y_MPS2": 0.0,
        "CALIB_IMU_ACCEL_RATIO": 1.0,
        "CALIB_IMU_MOUNT_ANGLE_RAD": 0.0,
        "CALIB_MM_GYRO_BIAS_DT_RAD": 0.0,
        "CALIB_MM_DT_S": 1.0 / 60.0,
    }
    reference, read = Reference(constants), np.ones(len(arm.t_s), dtype=bool)
    read[lost] = False
    given = [
        Inputs(100.0, 100.0, ax, ay, gz, (0.078, 0.078), True, came, MODE_POSITION)
        for ax, ay, gz, came in zip(*(x.tolist() for x in (arm.ax, arm.ay, arm.gz, read)), strict=True)
    ]
    return np.array([reference.step(one).phi_rad for one in given])


@pytest.mark.parametrize("seed", range(2))
def test_the_levelling_filter_is_the_projects_own(seed: int) -> None:
    """But for gains that stand in a table of 17 instead of changing with every tick."""
    arm = swung(seed, rate_hz=60.0, duration_s=60.0, bias_radps=0.02)
    wanted = filter_log(Levelling(1.5, 0.05), arm.t_s, arm.phi_acc, -arm.gz)[0]
    error, late = np.degrees(_levelled(arm) - wanted), arm.t_s > 5.0
    assert np.abs(error).max() < 0.2
    assert error[late].std() < 0.05 * np.degrees((wanted - arm.phi)[late].std())


@pytest.mark.few(1)
@pytest.mark.parametrize(("lost_s", "most_deg"), [(0.05, 0.6), (0.2, 0.6), (2.0, 1.4)])
def test_an_imu_that_was_lost_in_motion_leaves_no_error_in_the_levelled_angle(
    lost_s: float, most_deg: float
) -> None:
    """A few ticks are bridged by the rates about them; seconds make a new start with the bias found."""
    for seed in range(4):
        arm = swung(seed, rate_hz=60.0, duration_s=40.0, rest_s=-5.0, bias_radps=0.03)
        back = 1800 + round(60.0 * lost_s)
        error = np.degrees(_levelled(arm, slice(1800, back)) - arm.phi)[back:]
        assert np.sqrt(np.mean(error[:60] ** 2)) < most_deg
        assert np.sqrt(np.mean(error[120:300] ** 2)) < most_deg


@pytest.mark.parametrize("mode", [MODE_ORIENTATION, MODE_POSITION])
def test_every_stage_is_the_projects_own(mode: int) -> None:
    """Stage by stage, each fed with what the reference had before it; binary32 constants cost 1e-6."""
    constants = header().values
    reference = Reference(constants)
    angle: tuple[float, float] | None = None
    lowpass, heads = design_lowpass(Design()).exact, []
    turning, stretching = (
        (Channel(pid), Channel(pid))
        for pid in (Pid(1000.0, 1000.0, 10.0, clamping=True), Pid(15000.0, 0.0, 150.0))
    )
    for given in _ticks(mode):
        out = reference.step(given)
        phi_acc = math.atan2(given.ay_mps2, given.ax_mps2)
        if angle is None:
            angle = phi_acc, 0.0
        else:
            angle = advance(*angle, phi_acc, -given.gz_radps, 1.0 / 60.0, 3.0, 3.0)
        assert out.phi_rad == pytest.approx(angle[0], abs=2e-6)
        # The polynomial undoes the lens to 0.01 px, 0.3 mm/px.
        assert np.abs(np.array(out.marker_m) - _true_marker(CAMERA, given.u_px, given.v_px)).max() < 5e-6
        head = head_from_marker(np.array(out.marker_m), np.array(out.phi_rad))
        heads.append(head)
        assert out.head_m == pytest.approx(filter_signal(lowpass, np.array(heads))[-1], abs=3e-7)
        q = inverse_series(np.array([*out.head_m, out.phi_rad]), 0.0126)
        assert out.q_m == pytest.approx(q, abs=1e-8)
        if mode == MODE_POSITION:
            errors = np.subtract(given.reference, out.q_m).tolist()
            u = [channel.step(e) for channel, e in zip(stretching, errors, strict=True)]
            u = np.add(u, feed_forward(FeedForward(), given.reference))
        else:
            error = given.reference[0] - out.phi_rad
            u = [turning[0].step(error), turning[1].step(-error)]
        assert out.pwm == pytest.approx(np.clip(u, 0.0, 255.0), abs=1e-3)


@pytest.mark.few(1, 3)
@pytest.mark.parametrize(("kind", "fused"), [*PLAIN[:2], *FUSED])
def test_the_self_tests_ticks_reach_every_branch(kind: str, fused: bool) -> None:
    """But for the limit of the angle, which the pipeline without the fused estimator does not reach."""
    made = vectors(header(kind).values, FUSED_TICKS, fused=True) if fused else vectors(header(kind).values)
    flags = [vector.wanted.flags for vector in made]
    seen = np.bitwise_or.reduce(flags)
    of_fused = (ACCEL_WEAK, REJECTED, MOVING) if fused else ()
    for flag in (MARKER_HELD, IMU_HELD, BAD_REFERENCE, *SATURATED, *of_fused):
        assert seen & flag, hex(flag)
    if fused:
        assert sum(not one & (MOVING | MARKER_HELD) for one in flags) > 10
    else:
        assert not seen & ANGLE_LIMIT
    if kind == "nominal":
        assert seen & (CLAMPED[0] | CLAMPED[1])


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", ["fused", "full"])
def test_the_estimator_follows_the_motion(kind: str) -> None:
    """Pictures, gyroscope and accelerometer tell one story: the estimate is near the motion they are of."""
    constants = header(kind).values
    reference = FusedReference(constants)
    motion = Motion(constants["CALIB_REST_LENGTH_M"], PERIOD, 0.0)
    off = []
    for k, given in enumerate(coherent(constants, 2 * PERIOD)):
        out = reference.step(given)
        phi, length = motion.at(k)
        off.append((out.phi_rad - phi, 0.5 * sum(out.q_m) - length))
    worst = np.abs(np.array(off)[PERIOD // 2 :]).max(axis=0)
    assert worst[0] < 0.05
    # A steady acceleration a leaves the length a / K_v behind; here 0.15 l0 (2 pi / ticks)^2.
    behind = 0.15 * constants["CALIB_REST_LENGTH_M"] * (2.0 * np.pi / (0.55 * PERIOD)) ** 2
    assert worst[1] < behind / constants["CALIB_FUSED_MOVING_RATE"]
