"""The pipeline in C on this machine against float64: recorded motion, random and hostile ticks.

Rounding. With eps = 2^-24 = 6e-8, coordinates up to 0.3 m, and one operation losing at most eps of its
result:

- marker: numerator and denominator lose about 4 eps of their largest terms, 0.6 m / W with W >= 2.5 1/m where
  the marker can be, so 4 x 6e-8 x (0.6 + 0.3) ~ 2e-7 m at worst and a tenth of it typically: 2e-7 m.
- angle: the polynomial of the arc tangent is right to 2e-7 rad; the angle filter loses eps phi per tick and
  forgets with the time constant 1 / Kp = 20 ticks: 20 x 6e-8 x 1.5 ~ 2e-6 rad: 2e-6 rad.
- head: marker, 1e-6 d of the sine, and the low-pass, which loses eps |y| per tick and forgets in 1 / b0 = 20
  ticks: 2e-7 + 2e-8 + 20 x 6e-8 x 0.15 ~ 4e-7 m; lengths: f and r_B phi on top, 2e-6 x r_B = 3e-8: 2e-6 m.
- commands: gains of up to 24000 PWM/m on lengths that err by 1e-7 m where the marker can be: 2.4e-3, and the
  integral's rounding, eps x 255 per tick as a random walk over 1e5 ticks, 5e-3: 0.01 PWM.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from firmware_build import LIMITS, compare, host, hostile, need, numbers, run, strew, write
from firmware_rigs import header, rig

from calib.stages.firmware.conformance import (
    BAD_REFERENCE,
    HORIZON,
    IMU_HELD,
    MARKER_HELD,
    MODE_OFF,
    MODE_ORIENTATION,
    MODE_POSITION,
    STALE,
    Inputs,
    Reference,
)
from calib.stages.firmware.header import Header
from calib.stages.firmware.literals import values
from calib.stages.firmware.vectors import binary32, directed
from calib.stages.lowpass.section import LowPassSection


@pytest.fixture(scope="module", params=["nominal", "full"])
def built(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Header, list[str], Path]:
    need("gcc")
    folder = tmp_path_factory.mktemp(request.param)
    write(folder, header(request.param))
    return header(request.param), host(folder), folder


@cache
def _logged(ticks: int, seed: int) -> list[Inputs]:
    """Ticks of two simulated experiments, each with the newest IMU sample."""
    from calib.twin.rig import SimulatedRig
    from calib.twin.scenarios import make_scenario, run_scenario

    made: list[Inputs] = []
    for name, mode in (("ellipse", MODE_POSITION), ("orientation", MODE_ORIENTATION)):
        plan = make_scenario(name, {})
        record = run_scenario(plan, SimulatedRig(), seed, "sensors", 0.5 * ticks / 60.0)
        newest = np.clip(np.searchsorted(record.imu.taken_s, record.t_s, side="right") - 1, 0, None)
        for k, (u, v) in enumerate(record.pixels.tolist()):
            (ax, ay, _), gz = record.accel_mps2[newest[k]].tolist(), float(record.gyro_radps[newest[k], 2])
            turn = 0.3 * math.sin(0.01 * k)
            reference = (
                (0.078 + 0.0126 * turn, 0.078 - 0.0126 * turn) if mode == MODE_POSITION else (2.0 * turn, 0.0)
            )
            made.append(binary32(Inputs(u, v, ax, ay, gz, reference, not math.isnan(u), True, mode)))
    return made


def test_directed_ticks(built: tuple[Header, list[str], Path]) -> None:
    made, command, _ = built
    ticks = directed(values(made.literals), 4000)
    worst, undecided = compare(made, ticks, run(command, ticks))
    assert (worst <= LIMITS).all(), worst
    assert undecided <= 0.01


@pytest.mark.slow
def test_a_hundred_thousand_ticks(built: tuple[Header, list[str], Path]) -> None:
    """Recorded motion with random and hostile values strewn in; flags agree at every tick."""
    made, command, _ = built
    rng = np.random.default_rng(6)
    ticks = list(_logged(10_000, 3))
    ticks += directed(values(made.literals), 100_000 - len(ticks))
    strew(ticks, rng, losses=20)
    assert len(ticks) == 100_000
    found = run(command, ticks)
    assert np.isfinite(found.numbers).all()
    worst, undecided = compare(made, ticks, found)
    print(f"100000 ticks: differences {worst}, undecided {undecided:.2g} PWM")
    assert (worst <= LIMITS).all(), worst
    assert undecided <= 0.01


def test_nothing_is_ever_nan(built: tuple[Header, list[str], Path]) -> None:
    """Every value of every input hostile at once."""
    made, command, _ = built
    rng = np.random.default_rng(7)
    ticks = hostile(rng, 20_000)
    found = run(command, ticks)
    assert np.isfinite(found.numbers).all()
    low, high = values(made.literals)["CALIB_PUMP_LOW_PWM"], values(made.literals)["CALIB_PUMP_HIGH_PWM"]
    assert found.numbers[:, 7:].min() >= low
    assert found.numbers[:, 7:].max() <= high
    assert (found.duty == np.floor(found.numbers[:, 7:] + 0.5)).all()
    assert np.abs(found.numbers[:, 0]).max() <= float(np.float32(1.58))


def _still(mode: int = MODE_POSITION) -> Inputs:
    return binary32(Inputs(158.0, 80.0, 9.81, 0.0, 0.0, (0.08, 0.08), mode=mode))


def test_a_lost_sensor_holds_and_then_stops_the_pumps(built: tuple[Header, list[str], Path]) -> None:
    made, command, _ = built
    hold = int(values(made.literals)["CALIB_HOLD_TICKS"])
    low = values(made.literals)["CALIB_PUMP_LOW_PWM"]
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


def test_before_the_first_picture_the_pumps_are_off(built: tuple[Header, list[str], Path]) -> None:
    made, command, _ = built
    found = run(command, [replace(_still(), marker_seen=False)] * 5 + [replace(_still(MODE_OFF))] * 2)
    assert ((found.flags[:5] & STALE) != 0).all()
    rest = values(made.literals)["CALIB_REST_LENGTH_M"]
    assert found.numbers[0, 5:7].mean() == pytest.approx(rest, abs=1e-7)
    assert (found.flags[5:] & STALE == 0).all()


def test_a_bad_reference_stops_the_pumps_for_its_tick(built: tuple[Header, list[str], Path]) -> None:
    _, command, _ = built
    bad = replace(_still(), reference=(float("nan"), 0.08))
    found = run(command, [_still()] * 10 + [bad] + [_still()] * 10)
    assert [bool(f & BAD_REFERENCE) for f in found.flags] == [False] * 10 + [True] + [False] * 10


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


def test_the_self_test_passes_and_sees_a_wrong_constant(
    built: tuple[Header, list[str], Path], tmp_path: Path
) -> None:
    import subprocess

    made, _, folder = built
    main = '#include "calib_selftest.h"\nint main(void) { return calib_selftest() != 0; }\n'
    text = (folder / "calib_constants.h").read_text()
    name = "CALIB_BELLOWS_RADIUS_M"
    wrong = text.replace(f"{name} {made.literals[name]}", f"{name} 0.01f")
    assert wrong != text
    codes = []
    for constants in (text, wrong):
        write(tmp_path, made)
        (tmp_path / "calib_constants.h").write_text(constants)
        (tmp_path / "main.c").write_text(main)
        subprocess.run(["gcc", "-std=c99", "-o", "main", "main.c", "-lm"], cwd=tmp_path, check=True)
        codes.append(subprocess.run([tmp_path / "main"], check=False).returncode)
    assert codes == [0, 1]


def test_signs_of_the_imus_axes(tmp_path: Path) -> None:
    """An IMU that is mounted the other way round, by hand in the header."""
    made = header()
    write(tmp_path, made)
    path = tmp_path / "calib_constants.h"
    constants = values(made.literals)
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
    wanted = np.array([numbers(reference.step(t, int(f))) for t, f in zip(turned, found.flags, strict=True)])
    assert (np.abs(found.numbers - wanted).max(axis=0) <= LIMITS).all()


@pytest.mark.parametrize("order", [2, 5, 8])
def test_low_passes_of_every_order(tmp_path: Path, order: int) -> None:
    from calib.stages.firmware.header import header_of
    from calib.stages.lowpass.filters import Design, design_lowpass

    section = rig("full").lowpass
    assert section is not None
    rows = design_lowpass(Design(3.0, 60.0, order)).sections.tolist()
    sections = [LowPassSection(b=row[:3], a=row[3:]) for row in rows]
    other = section.model_copy(update={"order": order, "cutoff_hz": 3.0, "sections": sections})
    made = header_of(rig().model_copy(update={"lowpass": other}), "rig.yaml")
    write(tmp_path, made)
    ticks = directed(values(made.literals), 1500)
    worst, _ = compare(made, ticks, run(host(tmp_path), ticks))
    assert (worst <= LIMITS).all(), worst
