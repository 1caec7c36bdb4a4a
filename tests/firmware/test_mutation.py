"""Every constant matters: 0.1 % more in any of them fails a comparison with float64 or with the rig."""

from __future__ import annotations

import math
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from firmware_build import NATIVE, need, numbers, run, write
from firmware_rigs import header

from calib.firmware.conformance import MODE_ORIENTATION, MODE_POSITION, Inputs, Reference
from calib.firmware.header import header_text
from calib.firmware.literals import float_literal, values
from calib.firmware.vectors import TOLERANCE, binary32, directed

LIMITS = np.array([TOLERANCE["phi_rad"], *[TOLERANCE["marker_m"]] * 2, *[TOLERANCE["q_m"]] * 4, *[0.01] * 2])

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
        ticks.append(binary32(replace(base, reference=(factor * constants["CALIB_FF_FROM_M"], 0.08))))
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
    for stem, unit in (("ORIENTATION", "RAD"), ("POSITION", "M")):
        KPDI, KD, half = (c[f"CALIB_{stem}_{n}_PWM_PER_{unit}"] for n in ("KPDI", "KD_PER_DT", "KI_HALF_DT"))
        E0, E1, E2 = (c[f"CALIB_{stem}_E{i}_PWM_PER_{unit}"] for i in range(3))
        ok += [near(E0, KPDI), near(E2, KD), near(E1, 2.0 * half - KPDI - KD)]
    fx, fy, skew = c["CALIB_CAMERA_FX_PX"], c["CALIB_CAMERA_FY_PX"], c["CALIB_CAMERA_SKEW_PX"]
    K = np.array([[fx, skew, c["CALIB_CAMERA_CX_PX"]], [0, fy, c["CALIB_CAMERA_CY_PX"]], [0, 0, 1]])
    inverse, normalised, raw = (
        np.array([[c[f"CALIB_PLANE_{name}_{i}{j}"] for j in (1, 2, 3)] for i in (1, 2, 3)])
        for name in ("INVERSE", "NORMALISED", "RAW")
    )
    ok.append(bool(np.allclose(inverse @ K, normalised, rtol=1e-4, atol=2e-6)))
    del raw
    ok += [near(fx * c["CALIB_CAMERA_PER_FX"], 1.0), near(fy * c["CALIB_CAMERA_PER_FY"], 1.0)]
    rate = c["CALIB_TICK_RATE_HZ"]
    ok += [near(rate * c["CALIB_TICK_PERIOD_S"], 1.0), near(1e3 * rate, c["CALIB_TICK_RATE_MHZ"])]
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
    at, offset, slope = c["CALIB_FF_FROM_M"], c["CALIB_FF_OFFSET_PWM"], c["CALIB_FF_SLOPE_PWM_PER_M"]
    ok.append(near(c["CALIB_FF_MINUS_PWM"] + offset, slope * at))
    bias = c["CALIB_IMU_GYRO_BIAS_RADPS"] * c["CALIB_MM_DT_S"]
    ok += [near(bias, c["CALIB_MM_GYRO_BIAS_DT_RAD"]), near(c["CALIB_PUMP_HIGH"], c["CALIB_PUMP_HIGH_PWM"])]
    ok.append(near(c["CALIB_PUMP_DEAD_ZONE_PWM"] * c["CALIB_PUMP_SUPPLY_V"], 255.0 * 4.7))
    whole = c["CALIB_TIME_OFFSET_TICKS"] / rate + c["CALIB_TIME_OFFSET_REST_S"]
    ok.append(abs(whole - (0.035 if c["CALIB_TIME_OFFSET_TICKS"] else 0.0)) < 1e-6)
    # A thousandth of the series' last coefficient is 7e-8 m at the largest angle: checked against (3.14).
    ok.append(near(c["CALIB_INVERSE_F3_PER_RAD6"], 31.0 / 483840.0))
    # The camera of the two rigs.
    ok += [near(c["CALIB_CAMERA_K1"], -0.2201), near(c["CALIB_CAMERA_K2"], 0.5494), near(fx, 273.4)]
    return all(ok)


def _build(folder: Path, text: str, undistort: int) -> list[str]:
    (folder / "calib_constants.h").write_text(text)
    flags = ["-std=c99", "-O0", f"-DCALIB_UNDISTORT={undistort}", f"-I{folder}"]
    subprocess.run(["gcc", *flags, "-o", folder / "host", NATIVE / "program.c", "-lm"], check=True)
    return [str(folder / "host")]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "undistort"), [("nominal", 0), ("nominal", 1), ("full", 1)])
def test_a_constant_that_is_off_by_a_thousandth_is_seen(tmp_path: Path, kind: str, undistort: int) -> None:
    need("gcc")
    made = header(kind)
    constants, text = values(made.literals), header_text(made)
    assert _coherent(constants)
    write(tmp_path, made)
    ticks = _stimulus(constants)
    reference = Reference(constants, bool(undistort))
    plain = run(_build(tmp_path, text, undistort), ticks)
    wanted = [reference.step(t, int(f)) for t, f in zip(ticks, plain.flags, strict=True)]
    table = np.array([numbers(out) for out in wanted])
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
        if any(part in name for part in idle_here):
            continue
        changed = float_literal(1.001 * constants[name], name)
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
        if not seen(_build(tmp_path, mutated, undistort)):
            unseen.append(name)
    line = ("CALIB_FF_FROM_M", "CALIB_FF_OFFSET_PWM", "CALIB_FF_SLOPE_PWM_PER_M", "CALIB_FF_LIMIT_PWM")
    table_names = ("calib_ff_table_pwm", "CALIB_FF_TABLE")
    idle = (*line, "CALIB_FF_MINUS_PWM") if constants["CALIB_FF_USE_TABLE"] else table_names
    assert not [name for name in unseen if not name.startswith(idle)]
