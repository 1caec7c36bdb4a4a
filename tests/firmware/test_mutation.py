"""Every constant matters: 0.1 % more in any of them fails a comparison with float64 or with the rig."""

from __future__ import annotations

import math
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from firmware_build import LIMITS, NATIVE, need, run, write
from firmware_rigs import header, rig

from calib.io.serial import MODE_ORIENTATION, MODE_POSITION, Inputs
from calib.stages.firmware.conformance import FusedReference, Reference
from calib.stages.firmware.header import float_literal, values
from calib.stages.firmware.vectors import binary32, coherent, directed, directed_fused, find_pixel

# Not reached by any marker inside the picture; test_pipeline.py has a plane whose horizon is.
UNREACHED = {"CALIB_PLANE_LEAST_PER_M", "CALIB_PLANE_RAW_LEAST_PER_M"}


def _stimulus(constants: dict[str, float]) -> list[Inputs]:
    """Directed ticks, and ticks just inside and outside of every limit."""
    base = binary32(Inputs(150.0, 90.0, 9.81, 0.3, 0.1, (0.08, 0.08), mode=MODE_POSITION))
    ticks = [replace(base, marker_seen=False)] * 3 + directed(constants, 1200)
    edges = [
        ("ax_mps2", "CALIB_IMU_ACCEL_LIMIT_MPS2"),
        ("gz_radps", "CALIB_IMU_RATE_LIMIT_RADPS"),
        ("u_px", "CALIB_CAMERA_GREATEST_U_PX"),
        ("v_px", "CALIB_CAMERA_GREATEST_V_PX"),
    ]
    for field, limit in edges:
        for factor in (1.0005, 0.9995):
            ticks.append(binary32(replace(base, **{field: constants[limit] * factor})))
    bias = constants["CALIB_IMU_ACCEL_BIAS_X_MPS2"], constants["CALIB_IMU_ACCEL_BIAS_Y_MPS2"]
    for factor in (1.0005, 0.9995):
        weak = factor * constants["CALIB_IMU_ACCEL_WEAK_MPS2"]
        ticks.append(binary32(replace(base, ax_mps2=weak + bias[0], ay_mps2=bias[1])))
        # On the side whose length is near, where the feedback leaves room for it.
        ticks.append(binary32(replace(base, reference=(0.08, factor * constants["CALIB_FF_FROM_M"]))))
        ticks.append(binary32(replace(base, reference=(factor * constants["CALIB_FF_TABLE_FROM_M"], 0.08))))
    # The wanted lengths past both ends of the feed-forward, slowly, near the measured ones.
    for k in range(600):
        q = constants["CALIB_REST_LENGTH_M"] * (0.97 + 0.8 * k / 600)
        ticks.append(binary32(replace(base, u_px=60.0 + 0.3 * k, reference=(q, q + 0.01))))
    # The same in front of a marker at rest, so that the feedback takes some of the feed-forward's limit.
    for k in range(500):
        q = 0.094 + 0.06 * k / 500
        ticks.append(binary32(replace(base, v_px=155.0, reference=(q, q))))
    # Head down: angle and integral run to their limits, the angle controller to both of its own.
    for k in range(400):
        turned = replace(base, ax_mps2=-8.0, ay_mps2=5.0, reference=(1.3 + 0.1 * math.sin(0.1 * k), 0.0))
        ticks.append(binary32(replace(turned, mode=MODE_ORIENTATION)))
    for k in range(400):
        small = replace(base, ay_mps2=0.1, reference=(0.05 + 0.05 * math.sin(0.03 * k), 0.0))
        ticks.append(binary32(replace(small, mode=MODE_ORIENTATION)))
    return ticks


def _coherent(c: dict[str, float]) -> bool:
    """Constants that are there to be read follow from those that the pipeline uses, to 1e-4."""

    def near(a: float, b: float) -> bool:
        return abs(a - b) <= 1e-4 * max(abs(a), abs(b)) + 1e-12

    ok = []
    fx, fy, skew = c["CALIB_CAMERA_FX_PX"], c["CALIB_CAMERA_FY_PX"], c["CALIB_CAMERA_SKEW_PX"]
    K = np.array([[fx, skew, c["CALIB_CAMERA_CX_PX"]], [0, fy, c["CALIB_CAMERA_CY_PX"]], [0, 0, 1]])
    inverse, normalised = (
        np.array([[c[f"CALIB_PLANE_{name}_{i}{j}"] for j in (1, 2, 3)] for i in (1, 2, 3)])
        for name in ("INVERSE", "NORMALISED")
    )
    ok.append(bool(np.allclose(inverse @ K, normalised, rtol=1e-4, atol=2e-6)))
    ok += [near(fx * c["CALIB_CAMERA_PER_FX"], 1.0), near(fy * c["CALIB_CAMERA_PER_FY"], 1.0)]
    rate = c["CALIB_TICK_RATE_HZ"]
    ok.append(near(1e3 * rate, c["CALIB_TICK_RATE_MHZ"]))
    pairs, single = int(c["CALIB_LOWPASS_PAIRS"]), int(c["CALIB_LOWPASS_SINGLES"])
    for i in range(1, pairs + single + 1):
        b = [c[f"CALIB_LOWPASS_{i}_B{j}"] for j in range(3)]
        a1, a2 = c[f"CALIB_LOWPASS_{i}_A1"], c[f"CALIB_LOWPASS_{i}_A2"]
        ok.append(abs(sum(b) - 1.0 - a1 - a2) < 1e-6)
        if i > pairs:
            ok += [near(b[0], b[1]), near(c["CALIB_LOWPASS_SINGLE_G"], b[0])]
        else:
            A1, A2, A3 = (c[f"CALIB_LOWPASS_PAIR{i}_A{n}"] for n in (1, 2, 3))
            # D = 1 / A1, g^2 = A3 / A1; a1 = 2 (g^2 - 1) / D, and g from A2.
            ok += [near(b[1], 2.0 * b[0]), near(b[2], b[0]), near(A3, b[0]), near(A2 * A2, A1 * A3)]
            ok.append(near(a1, 2.0 * (A3 - A1)))
    bias = c["CALIB_IMU_GYRO_BIAS_RADPS"] * c["CALIB_MM_DT_S"]
    ok += [near(bias, c["CALIB_MM_GYRO_BIAS_DT_RAD"]), near(c["CALIB_PUMP_HIGH"], c["CALIB_PUMP_HIGH_PWM"])]
    # The limits are whole numbers; a thousandth of 5 PWM is below what a command may be off by.
    ok.append(near(c["CALIB_PUMP_LOW_PWM"], round(c["CALIB_PUMP_LOW_PWM"])))
    # A thousandth of the series' last coefficient is 7e-8 m at the largest angle: checked against (3.14).
    ok.append(near(c["CALIB_INVERSE_F3_PER_RAD6"], 31.0 / 483840.0))
    # The camera of the two rigs.
    ok += [near(c["CALIB_CAMERA_K1"], -0.2201), near(c["CALIB_CAMERA_K2"], 0.5494), near(fx, 273.4)]
    return all(ok)


def _build(folder: Path, text: str, flag: str) -> list[str]:
    (folder / "calib_constants.h").write_text(text)
    flags = ["-std=c99", "-O0", flag, f"-I{folder}"]
    subprocess.run(["gcc", *flags, "-o", folder / "host", NATIVE / "program.c", "-lm"], check=True)
    return [str(folder / "host")]


def _stimulus_fused(constants: dict[str, float]) -> list[Inputs]:
    """Directed ticks, then rest, a long creep, and a tick on either side of each limit of the estimator."""
    c, reference = {name.removeprefix("CALIB_"): v for name, v in constants.items()}, Reference(constants)
    ticks = directed_fused(constants, 2400)
    period = coherent(constants, 240)
    # With the feedback alone at work.
    for _ in range(4):
        ticks += [replace(one, mode=MODE_POSITION, reference=(0.072, 0.072)) for one in period]
    rest = replace(period[-1], mode=MODE_POSITION, reference=(0.069, 0.069))
    # The rate that a stop leaves decays without pictures.
    ticks += period[:60] + [replace(period[60], marker_seen=False)] * 30
    # Without the IMU the pictures' share alone, after a start the greater one.
    ticks += [replace(one, imu_read=False) for one in period[:120]] + period[:100]
    ticks += [rest] * 200 + [replace(rest, u_px=rest.u_px + 40.0)] * 40
    # Head on: the marker is along the chord, and the residual is what it is moved by.
    still = replace(rest, gz_radps=c["MM_GYRO_BIAS_DT_RAD"] / c["MM_DT_S"])
    Y = c["REST_LENGTH_M"] + c["MARKER_OFFSET_M"]

    def along(by_m: float) -> Inputs:
        u, v = find_pixel(reference, 0.0, Y + by_m)
        return replace(still, u_px=u, v_px=v)

    creep = 0.85 * c["FUSED_REST_LENGTH"] * c["FUSED_MOVING_M"]
    ticks += [along(0.0)] * 400 + [along(creep * k) for k in range(700)]
    # After a start nothing is left of former residuals.
    lost = replace(still, marker_seen=False)
    for limit in (c["FUSED_GATE_M"], c["FUSED_MOVING_M"] / c["FUSED_SLOW"]):
        for factor in (0.9995, 1.0005):
            ticks += [lost] * 70 + [along(0.0)] * 20 + [along(factor * limit)]
    weak = c["FUSED_ACCEL_WEAK"]
    for factor in (0.9995, 1.0005):
        rows = np.array([[c[f"FUSED_ACCEL_{i}{j}"] for j in (1, 2)] for i in (1, 2)])
        offset = np.array([c["FUSED_ACCEL_1"], c["FUSED_ACCEL_2"]])
        ax, ay = np.linalg.solve(rows, offset + np.array([factor * weak, 0.0])).tolist()
        ticks.append(replace(along(0.0), ax_mps2=ax, ay_mps2=ay))
    return list(map(binary32, ticks))


def _coherent_fused(c: dict[str, float]) -> bool:
    """What is too small to be seen in a tick follows from the rig: the biases' share, 1e-5 rad for 0.1 %, and
    the gain at rest, which leaves 4e-7 m of a residual unless it changes the length by its last digit.
    """
    section = rig("fused").estimator
    assert section is not None
    assert section.constant_gain is not None
    bias, rest = np.array([0.1, 0.1]), section.constant_gain.rest_length
    rows = np.array([[c[f"CALIB_FUSED_ACCEL_{i}{j}"] for j in (1, 2)] for i in (1, 2)])
    told = np.array([c["CALIB_FUSED_ACCEL_1"], c["CALIB_FUSED_ACCEL_2"]])
    near = abs(c["CALIB_FUSED_REST_LENGTH"] / rest - 1.0) < 1e-4
    return near and bool(np.allclose(rows @ bias, told, rtol=1e-4))


@pytest.mark.slow
def test_a_constant_of_the_fused_estimator_that_is_off_is_seen(tmp_path: Path) -> None:
    """By a thousandth, or by one where it counts ticks: off by five times what rounding gives."""
    need("gcc")
    made = header("fused")
    constants, text = made.values, made.text
    write(tmp_path, made)
    ticks = _stimulus_fused(constants)
    plain = run(_build(tmp_path, text, "-DCALIB_FUSED=1"), ticks)
    reference = FusedReference(constants)
    wanted = [reference.step(t, int(f)) for t, f in zip(ticks, plain.flags, strict=True)]
    table = np.array([out.numbers for out in wanted])
    rounding = np.abs(plain.numbers - table).max(axis=0)
    assert (rounding <= LIMITS).all(), rounding
    assert _coherent_fused(constants)
    unseen = []
    for name, literal in made.literals.items():
        if not name.startswith("CALIB_FUSED_"):
            continue
        whole = not literal.endswith("f")
        changed = str(int(literal) + 1) if whole else float_literal(1.001 * constants[name])
        if not _coherent_fused({**constants, name: values({name: changed})[name]}):
            continue
        mutated = text.replace(f"#define {name} {literal} ", f"#define {name} {changed} ")
        assert mutated != text, name
        found = run(_build(tmp_path, mutated, "-DCALIB_FUSED=1"), ticks)
        off = np.abs(found.numbers - table).max(axis=0)
        if not ((off > 5.0 * rounding).any() or (found.flags != plain.flags).any()):
            unseen.append((name, float((off / rounding).max())))
    assert not unseen


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "undistort"), [("nominal", 0), ("nominal", 1), ("full", 1)])
def test_a_constant_that_is_off_by_a_thousandth_is_seen(tmp_path: Path, kind: str, undistort: int) -> None:
    need("gcc")
    made = header(kind)
    constants, text, flag = made.values, made.text, f"-DCALIB_UNDISTORT={undistort}"
    assert _coherent(constants)
    write(tmp_path, made)
    ticks = _stimulus(constants)
    reference = Reference(constants, bool(undistort))
    plain = run(_build(tmp_path, text, flag), ticks)
    wanted = [reference.step(t, int(f)) for t, f in zip(ticks, plain.flags, strict=True)]
    table = np.array([out.numbers for out in wanted])
    flags = np.array([out.flags for out in wanted])

    def seen(command: list[str]) -> bool:
        found = run(command, ticks)
        return bool(
            (np.abs(found.numbers - table).max(axis=0) > LIMITS).any() or (found.flags != flags).any()
        )

    assert not seen([str(tmp_path / "host")])
    unseen = []
    for name, literal in made.literals.items():
        idle_here = ("PLANE_RAW",) if undistort else ("PLANE_NORMALISED", "LENS_INVERSE")
        if not literal.endswith("f") or constants[name] == 0.0 or name in UNREACHED:
            continue
        # The guard's envelope is of no tick; test_guard.py and tests/bench/mutants.py change it.
        if any(part in name for part in (*idle_here, "CALIB_FUSED_", "CALIB_ENVELOPE_")):
            continue
        changed = float_literal(1.001 * constants[name])
        if not _coherent({**constants, name: values({name: changed})[name]}):
            continue
        if "[" in name:
            index = int(name.split("[")[1][:-1])
            head, tail = text.split("CALIB_IN_FLASH = {", 1)
            entries = tail.split("};", 1)[0].replace("\n", " ").split(",")
            entries[index] = changed
            mutated = f"{head}CALIB_IN_FLASH = {{{','.join(entries)}}};{tail.split('};', 1)[1]}"
        else:
            mutated = text.replace(f"#define {name} {literal} ", f"#define {name} {changed} ")
        assert mutated != text, name
        if not seen(_build(tmp_path, mutated, flag)):
            unseen.append(name)
    line = ("CALIB_FF_FROM_M", "CALIB_FF_SLOPE_PWM_PER_M", "CALIB_FF_LIMIT_PWM")
    table_names = ("calib_ff_table_pwm", "CALIB_FF_TABLE")
    idle = (*line, "CALIB_FF_MINUS_PWM") if constants["CALIB_FF_USE_TABLE"] else table_names
    assert not [name for name in unseen if not name.startswith(idle)]
