"""Constants of the header: found again in the world, compiled to NumPy's bits, one header for one rig."""

from __future__ import annotations

import copy
import math
import re
import struct
import subprocess
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from estimatorlogs import NOISE
from firmware_build import need, warnings, write
from firmware_rigs import header, rig
from hypothesis import given
from hypothesis import strategies as st

from calib.core.errors import BadInputError
from calib.core.rig import Provenance, Rig
from calib.stages.actuator.parameters import Stiffness
from calib.stages.actuator.pump import ElongationForce
from calib.stages.align.section import LogCheck
from calib.stages.camera.model import project, undistort
from calib.stages.estimator.constant_gain import design, tick_noise
from calib.stages.estimator.kinematic import Setup, Start
from calib.stages.estimator.sensors import sensor_values, view_coefficients
from calib.stages.firmware.conformance import Reference
from calib.stages.firmware.constants import PlaneConstants, plane_constants
from calib.stages.firmware.header import (
    VERBATIM,
    comment_text,
    float_literal,
    literals,
    make_header,
    verbatim,
)
from calib.twin.pictures import CAMERA, PLANE

HOSTILE = {"*/ int x; /*": "1", "??/\n#error": "2", 'quote".png': "3", "ünï\u202e.png": "4", "\\": "5"}
COMPILERS = [
    ("gcc", "-std=c99"),
    ("gcc", "-std=c11"),
    ("gcc", "-std=c17"),
    ("clang", "-std=c99"),
    ("clang", "-std=c11"),
    ("clang", "-std=c17"),
    ("g++", "-std=c++11"),
    ("g++", "-std=c++17"),
    ("g++", "-std=c++20"),
    ("avr-gcc", "-std=c99"),
    ("avr-gcc", "-std=c99 -DCALIB_PROGMEM"),
    ("avr-gcc", "-std=c++11 -DCALIB_PROGMEM"),
]


def _compiled(folder: Path, compiler: str, flags: str, text: str) -> subprocess.CompletedProcess[str]:
    need(compiler)
    words = flags.split()
    words += ["-x", "c++" if "++" in flags else "c"]
    if compiler == "avr-gcc":
        words += ["-mmcu=atmega328p", "-Os"]
    (folder / "unit.c").write_text(text)
    call = [compiler, *words, *warnings, "-c", "unit.c", "-o", "unit.o"]
    return subprocess.run(call, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(("compiler", "flags"), COMPILERS[:2], ids=lambda v: v.replace(" ", ""))
def test_the_frames_compile_as_c(tmp_path: Path, compiler: str, flags: str) -> None:
    """Beside the Arduino core's Serial, whatever has one."""
    write(tmp_path, header())
    text = (
        '#include "calib_constants.h"\n#include "calib_pipeline.h"\n'
        "static struct { void (*write)(uint8_t); } Serial;\n"
        '#include "calib_link.h"\n'
    )
    done = _compiled(tmp_path, compiler, flags, text)
    assert done.returncode == 0, done.stderr


def test_same_rig_same_bytes() -> None:
    again = make_header(copy.deepcopy(rig()), "elsewhere/rig.yaml")
    assert again.text == header().text
    assert again.digest == header().digest


@pytest.mark.few(0, 9, 12, 21)
@pytest.mark.parametrize("fused", [0, 1])
@pytest.mark.parametrize(("compiler", "flags"), COMPILERS, ids=lambda v: v.replace(" ", ""))
def test_every_constant_compiles_to_numpys_bits(
    tmp_path: Path, compiler: str, flags: str, fused: int
) -> None:
    whole = copy.deepcopy(rig("full"))
    whole.provenance.inputs["camera"] = HOSTILE
    made = make_header(whole, "rig.yaml")
    write(tmp_path, made)
    floats = {n: v for n, v in made.literals.items() if v.endswith("f")}
    body = ",\n".join(name for name in floats if "[" not in name)
    unit = (
        '#include "calib_pipeline.h"\n#include "calib_selftest.h"\n'
        f"extern const float values[];\nconst float values[] = {{\n{body}\n}};\n"
        "extern unsigned wrong(void);\nunsigned wrong(void) { return calib_selftest(); }\n"
        "extern float entry(int i);\n"
        "float entry(int i) { return CALIB_TABLE_READ(&calib_ff_table_pwm[i]); }\n"
    )
    done = _compiled(tmp_path, compiler, f"{flags} -DCALIB_FUSED={fused}", unit)
    assert done.returncode == 0, done.stderr
    thing = (tmp_path / "unit.o").read_bytes()
    scalars = [np.float32(v[:-1]) for n, v in floats.items() if "[" not in n]
    table = [np.float32(v[:-1]) for n, v in floats.items() if "[" in n]
    assert np.array(scalars, dtype="<f4").tobytes() in thing
    assert np.array(table, dtype="<f4").tobytes() in thing


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("#define CALIB_EXPECT_SCHEMA 99", "another schema"),
        ("#define CALIB_EXPECT_TICK_RATE_MHZ 100000", "tick rate"),
        ("#define CALIB_EXPECT_PUMP_HIGH 200", "beyond what the program allows its pumps"),
        ("#include <float.h>\n#undef FLT_MANT_DIG\n#define FLT_MANT_DIG 53", "IEEE 754 binary32"),
    ],
)
def test_what_does_not_fit_does_not_compile(tmp_path: Path, line: str, message: str) -> None:
    write(tmp_path, header())
    done = _compiled(tmp_path, "gcc", "-std=c99", f'{line}\n#include "calib_constants.h"\n')
    assert done.returncode != 0
    assert message in done.stderr
    fits = "#define CALIB_EXPECT_SCHEMA 8\n#define CALIB_EXPECT_TICK_RATE_MHZ 60000\n"
    fits += "#define CALIB_EXPECT_PUMP_HIGH 255\n"
    done = _compiled(tmp_path, "gcc", "-std=c99", f'{fits}#include "calib_pipeline.h"\n')
    assert done.returncode == 0, done.stderr


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", ["nominal", "full", "levelling"])
def test_every_macro_is_read_or_says_what_it_is_for(kind: str) -> None:
    """The firmware reads it, or its comment or that of its group tells that a person's program may."""
    text = header(kind).text
    readers = "".join(map(verbatim, (*VERBATIM, "calib_example.ino", "calib_selftest.h.j2")))
    readers += "".join(
        line for line in text.splitlines(True) if line.startswith(("#if", "#define CALIB_LENS_INV"))
    )
    for group in text.split("\n\n"):
        for name in re.findall(r"^#define (CALIB_\w+)", group, re.M):
            mentioned = len(re.findall(rf"\b{name}\b", readers)) > name.startswith("CALIB_LENS_INV")
            assert mentioned or "programs of your own" in group or name == "CALIB_LENS_INVERSE_ORDER", name


@pytest.mark.slow
def test_cppcheck_finds_what_the_manual_gives_reasons_for(tmp_path: Path) -> None:
    """Nothing by its own rules, and of MISRA C's those alone that stand in the manual."""
    need("cppcheck")
    write(tmp_path, header("full"))
    (tmp_path / "unit.c").write_text(
        '#include "calib_guard.h"\n#include "calib_selftest.h"\n'
        "int main(void) { return calib_selftest() + calib_guard_selftest(); }\n"
    )
    # The limits of binary32 stand in a header of the compiler's, which cppcheck does not read.
    given = ["FLT_RADIX=2", "FLT_MANT_DIG=24", "FLT_MAX_EXP=128", "FLT_MIN_EXP=-125", "FLT_MIN=1.2e-38f"]
    call = [
        "cppcheck",
        "--std=c99",
        "--addon=misra",
        "--enable=style",
        "--quiet",
        "--template={id} {severity} {line}",
    ]
    call += [f"-D{one}" for one in (*given, "CALIB_STAGE(n)=", "CALIB_I_KNOW=1")]
    found: list[str] = []
    for fused in (0, 1):
        own = [*call, f"-DCALIB_FUSED={fused}", "unit.c"]
        found += subprocess.run(
            own, cwd=tmp_path, capture_output=True, text=True, check=False
        ).stderr.splitlines()
    misra = {line.split()[0].removeprefix("misra-c2012-") for line in found if line.startswith("misra")}
    # Newer ones tell besides how many branches they look at.
    assert not [
        line
        for line in found
        if not line.startswith(("misra", "normalCheckLevelMaxBranches")) and " style " not in line
    ]
    page = resources.files("calib.docs").joinpath("howto/wire-and-flash.md").read_text("utf-8")
    assert misra == set(re.findall(r"^\| (\d+\.\d+) \|", page, re.M))


@pytest.mark.parametrize("compiler", ["gcc", "avr-gcc"])
def test_constants_that_may_not_drive_a_rig_do_not_compile_for_a_board(tmp_path: Path, compiler: str) -> None:
    """Simulated ones, and those of a section that is not ok; a bare rig's do, since they drive nothing."""
    align = rig("full").align
    assert align is not None
    poor = align.model_copy(update={"word_": "poor"})
    twin = {"twin": {"imu": {"mount_angle_rad": 0.1}}}
    kinds = {
        "ok": rig("full"),
        "poor": rig("full").with_sections({"align": poor}),
        "simulated": rig("full").with_sections({"twin": Rig.of(twin, "rig.yaml").twin}),
        "bare": Rig.of(twin, "rig.yaml"),
    }
    board = "" if compiler == "avr-gcc" else " -DARDUINO=10819"
    for kind, whole in kinds.items():
        write(tmp_path, make_header(whole, "rig.yaml"))
        for known in (False, True):
            flags = f"-std=c99{board}{' -DCALIB_I_KNOW=1' if known else ''}"
            done = _compiled(tmp_path, compiler, flags, '#include "calib_guard.h"\n')
            compiles = known or kind in ("ok", "bare")
            assert (done.returncode == 0) == compiles, (kind, known, done.stderr)
            assert compiles or "CALIB_I_KNOW 1 takes them" in done.stderr


@given(st.floats(width=32, allow_nan=False, allow_infinity=False, allow_subnormal=False))
def test_literals_read_back_bit_for_bit(value: float) -> None:
    literal = float_literal(value)
    assert re.fullmatch(r"-?\d+\.\d+(e[+-]\d+)?f", literal)
    assert struct.pack("f", np.float32(literal[:-1])) == struct.pack("f", np.float32(value) + np.float32(0.0))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e39, 1e-40])
def test_what_a_float_cannot_hold_is_refused_by_name(value: float) -> None:
    with pytest.raises(BadInputError, match=r"CALIB_CAMERA_K1"):
        literals(f"#define CALIB_CAMERA_K1 {float_literal(value)} /* lens */")


@given(st.text())
def test_no_text_leaves_its_comment(text: str) -> None:
    safe = comment_text(text)
    assert "*/" not in safe
    assert "/*" not in safe
    assert "??" not in safe
    assert "\\" not in safe
    assert "\n" not in safe
    assert safe.isascii()


def _made(**align: object) -> PlaneConstants:
    section = rig("full").align
    assert section is not None
    moved = {"align": section.model_copy(update=align)} if align else {}
    made = plane_constants(rig().with_sections(moved), "rig.yaml")
    assert made is not None
    return made


def _points() -> tuple[np.ndarray, np.ndarray]:
    world = np.stack(np.meshgrid(np.linspace(-0.05, 0.05, 11), np.linspace(0.05, 0.1, 6)), axis=-1).reshape(
        -1, 2
    )
    R, t = np.array(PLANE.R_CW), np.array(PLANE.t_m)
    return world, project(CAMERA, world @ R[:, :2].T + t)


def _mapped(H: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    out = np.column_stack([points, np.ones(len(points))]) @ H.T
    return out[:, :2] / out[:, 2:], out[:, 2]


def test_both_ways_through_the_plane_find_the_world() -> None:
    made = _made()
    world, pixels = _points()
    found, W = _mapped(made.normalised, undistort(CAMERA, pixels))
    assert np.abs(found - world).max() < 1e-9
    # 1/s of (2.12) is the reciprocal depth.
    depth = (world @ np.array(PLANE.R_CW)[2, :2]) + PLANE.t_m[2]
    assert np.allclose(W * depth, 1.0)
    assert made.raw is not None
    raw, _ = _mapped(made.raw, pixels)
    assert 1e-5 < np.linalg.norm(raw - world, axis=1).max() < made.raw_error_m
    # The farthest corner in the picture is as far off as the header says.
    x0, y0, x1, y1 = rig().workspace_m
    corners = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x0, y1, 0.0], [x1, y1, 0.0]])
    pixels = project(CAMERA, corners @ np.array(PLANE.R_CW).T + PLANE.t_m)
    seen = ((pixels > -0.5) & (pixels < np.array(CAMERA.image_size_px) - 0.5)).all(axis=1)
    raw, _ = _mapped(made.raw, pixels[seen])
    off = np.linalg.norm(raw - corners[seen, :2], axis=1).max()
    assert off == pytest.approx(made.raw_error_m, rel=1e-6)


def test_a_fisheye_lens_is_undone_over_the_workspace() -> None:
    """By the header's polynomial alone, to a hundredth of a pixel of the ideal picture."""
    made, section = make_header(rig("fisheye"), "rig.yaml"), rig("fisheye").camera
    assert section is not None
    assert made.verdict.word == "ok", made.verdict.reasons
    reference = Reference(made.values)
    assert reference.undistort
    camera, (world, _) = section.optics, _points()
    R, t = np.array(PLANE.R_CW), np.array(PLANE.t_m)
    rays = world @ R[:, :2].T + t
    found = np.array([reference.undistorted(u, v) for u, v in project(camera, rays)])
    assert 164.5 * np.abs(found - rays[:, :2] / rays[:, 2:]).max() < 0.01


@pytest.mark.parametrize("workspace_m", [None, [-0.05, 0.03, 0.06, 0.12]])
def test_an_alignments_shift_and_stretch_are_undone(workspace_m: list[float] | None) -> None:
    """Places that the calibrated plane shows as the estimator's model of it does come out right."""
    from calib.core.rig import Geometry
    from calib.stages.estimator.read import Periods, setup_from_rig

    shift, stretch = (3e-4, -2e-4), 2e-2
    section = rig("full").align
    assert section is not None
    moved = rig().with_sections(
        {
            "align": section.model_copy(update={"plane_shift_m": list(shift), "plane_stretch": stretch}),
            "geometry": None if workspace_m is None else Geometry(workspace_m=workspace_m),
        }
    )
    setup, _ = setup_from_rig(moved, Path("rig.yaml"), Periods(0.02, 0.01, 1.0, False, 100, 200))
    world, _ = _points()
    shown = world + np.array(shift) + stretch * (world - setup.view[22:24])
    R, t = np.array(PLANE.R_CW), np.array(PLANE.t_m)
    pixels = project(CAMERA, shown @ R[:, :2].T + t)
    right = plane_constants(moved, "rig.yaml")
    assert right is not None
    found, W = _mapped(right.normalised, undistort(CAMERA, pixels))
    assert np.abs(found - world).max() < 1e-9
    assert (W > 0.0).all()


def test_the_horizon_lies_beyond_the_workspace() -> None:
    made = _made()
    world, pixels = _points()
    assert made.raw is not None
    for H, points, least in (
        (made.normalised, undistort(CAMERA, pixels), made.least),
        (made.raw, pixels, made.raw_least),
    ):
        assert 0.0 < least < 0.2 * _mapped(H, points)[1].min()
    assert len(world)


def test_the_nominal_table_holds_the_lengths_of_the_pump() -> None:
    """PWM values of the table give the table's elongations by (2.13)."""
    c = header().values
    size, pump = int(c["CALIB_FF_TABLE_SIZE"]), ElongationForce()
    pwm = np.array([c[f"calib_ff_table_pwm[{i}]"] for i in range(size)])
    reached = 1e-3 * np.polyval(pump.elongation_mm, pump.supply_V * pwm / 255.0)
    inside = pwm < 253.0
    assert inside.sum() >= 12
    assert np.abs(np.maximum(reached, 0.0) - 0.002 * np.arange(size))[inside].max() < 2e-5
    assert (np.diff(pwm) > 0.0).all()


def test_the_tuned_table_balances_the_springs() -> None:
    c, tuned = header("full").values, rig("full").controller
    assert tuned is not None
    assert c["CALIB_FF_USE_TABLE"] == 1.0
    force, pwm = np.array(tuned.feedforward.force_pwm).T
    spring = Stiffness((47.7, 1092.9))
    for i in range(3, int(c["CALIB_FF_TABLE_SIZE"]) - 1):
        eps = 0.002 * i
        wanted = spring.secant(eps) * eps / 0.99
        assert np.interp(c[f"calib_ff_table_pwm[{i}]"], pwm, force) == pytest.approx(wanted, rel=1e-5)


def test_pumps_without_strength_are_refused_by_their_key() -> None:
    document = rig("full").values()
    document["controller"]["feedforward"]["strength"] = [1.0, 0.0]
    with pytest.raises(BadInputError, match=r"controller\.feedforward\.strength\.1 is 0, expected above 0"):
        Rig.of(document, "rig.yaml")


def _with(section: str, **changes: object) -> Rig:
    whole = rig("fused")
    return whole.with_sections({section: getattr(whole, section).model_copy(update=changes)})


_IMU = {
    "rate_hz": 100.0,
    "gyro_bias_radps": [0.0, 0.0, 0.021],
    **{
        f"{kind}_{what}": [0.1, 0.1, 0.1]
        for kind, whats in (
            (
                "gyro",
                ("noise_radps_per_sqrt_Hz", "instability_radps", "walk_radps2_per_sqrt_Hz", "step_radps"),
            ),
            (
                "accel",
                ("noise_mps2_per_sqrt_Hz", "instability_mps2", "walk_mps3_per_sqrt_Hz", "step_mps2"),
            ),
        )
        for what in whats
    },
    "accel_mean_mps2": [9.8, 0.0, 0.0],
    "verdict": "ok",
}


def test_gains_for_an_imu_that_nobody_has_measured_are_poor() -> None:
    whole = rig("full")
    assert "neither imu nor align" not in str(make_header(whole, "rig.yaml").verdict.reasons)
    bare = whole.only([name for name in whole.sections if name not in ("imu", "align", "estimator")])
    assert "neither imu nor align" in str(make_header(bare, "rig.yaml").verdict.reasons)


@pytest.mark.parametrize(
    ("accel_mps2", "told"), [([9.8, 0.5], False), ([0.1, 9.8], True), ([-9.8, 0.1], True)]
)
def test_an_imu_that_is_turned_and_not_aligned_is_poor(accel_mps2: list[float], told: bool) -> None:
    whole = rig("full")
    imu = Rig.of({"imu": {**_IMU, "accel_mean_mps2": [*accel_mps2, 0.0]}}, "rig.yaml").imu
    bare = whole.only([name for name in whole.sections if name not in ("align", "estimator")])
    reasons = make_header(bare.with_sections({"imu": imu}), "rig.yaml").verdict.reasons
    assert ("which the board takes for bending" in str(reasons)) is told


def test_a_section_that_was_taken_away_is_missed() -> None:
    """Its defaults are of another rig than the gains."""
    inputs = {"controller": {"actuator": "", "align": "1" * 64}}
    whole = rig("full").with_sections({"provenance": Provenance(inputs=inputs)})
    assert "not there" not in str(make_header(whole, "rig.yaml").verdict.reasons)
    reasons = make_header(whole.with_sections({"align": None}), "rig.yaml").verdict.reasons
    assert "align, with which controller was computed, is not there: the header has defaults" in reasons


def test_a_camera_slower_than_the_tick_is_poor() -> None:
    """The guard counts each tick without a picture."""
    one = LogCheck(name="a.csv", duration_s=9.0, stretches=1, pictures=500, outliers=0, samples=900)
    for rate_hz, told in ((60.1, False), (50.0, False), (30.0, True)):
        seen = [one.model_copy(update={"camera_rate_hz": rate_hz})]
        reasons = str(make_header(_with("align", logs=seen), "rig.yaml").verdict.reasons)
        assert ("takes a tick without a picture for a lost marker" in reasons) is told


@pytest.mark.parametrize(("offset_s", "ticks"), [(0.0255, 1.53), (0.0, 0.0), (0.1, 6.0), (-0.008, 0.0)])
def test_the_delay_of_the_pictures_is_honoured_to_parts_of_a_tick(offset_s: float, ticks: float) -> None:
    made = make_header(_with("align", time_offset_s=offset_s), "rig.yaml")
    c = made.values
    assert c["CALIB_TIME_OFFSET_TICKS"] - c["CALIB_TIME_OFFSET_PART"] == pytest.approx(ticks, abs=1e-6)
    assert c["CALIB_FUSED_DELAY_TICKS"] == pytest.approx(ticks, abs=1e-6)
    assert ("8.0 ms earlier than the IMU's" in str(made.verdict.remarks)) == (offset_s < 0.0)


def test_pictures_from_before_or_long_after_the_sample_are_refused() -> None:
    for offset_s, advice in ((-0.02, "by one clock"), (0.15, r"calib lowpass --rate 53Hz$")):
        match = rf"align\.time_offset_s is .* expected pictures that are -1 to 8.*{advice}"
        with pytest.raises(BadInputError, match=match):
            make_header(_with("align", time_offset_s=offset_s), "rig.yaml")
    with pytest.raises(BadInputError, match=r"to 8 ticks late; align is unidentifiable, so that its numbers"):
        make_header(_with("align", time_offset_s=0.15, word_="unidentifiable"), "rig.yaml")


@pytest.mark.parametrize("alpha", [0.0, 0.05, -1.2, 2.5])
def test_the_accelerometers_map_undoes_bias_scale_and_mount(alpha: float) -> None:
    whole = _with("align", mount_angle_rad=alpha, accel_scale=[0.01, -0.02], accel_bias_mps2=[0.2, -0.1])
    c = make_header(whole, "rig.yaml").values
    phi = 0.4
    force = 9.81 * np.array([math.cos(phi + alpha), math.sin(phi + alpha)])
    reading = force * np.array([1.01, 0.98]) + np.array([0.2, -0.1])
    A, B = (
        c[f"CALIB_FUSED_ACCEL_{i}1"] * reading[0]
        + c[f"CALIB_FUSED_ACCEL_{i}2"] * reading[1]
        - c[f"CALIB_FUSED_ACCEL_{i}"]
        for i in (1, 2)
    )
    gain = c["CALIB_FUSED_ACCEL_GAIN"]
    assert np.array([A, B]) == pytest.approx(gain * np.array([math.cos(phi), math.sin(phi)]), abs=1e-6 * gain)


def test_without_tuned_gains_they_are_for_the_noise_of_the_alignment() -> None:
    """As `calib.stages.estimator.constant_gain` finds it from the set-up, to second order in the angle."""
    whole = _with("align", jitter_px=0.3, imu_lever_m=0.006)
    whole = whole.with_sections({"estimator": None})
    made = make_header(whole, "rig.yaml")
    c = made.values
    assert " * Gains for the noise in align.\n" in made.text
    assert " * Gains of estimator.constant_gain.\n" in header("fused").text
    section = whole.align
    assert section is not None
    noise = NOISE.copy()
    noise[0], noise[3], noise[4] = 0.3, section.accel_noise_mps2[0], section.gyro_noise_radps
    values_ = {"marker_offset_m": section.marker_offset_m, "imu_lever_m": 0.006}
    start = Start(sensor_values(values_), np.zeros(13), np.array([0.0, 0.065, 0.0, 0.0, 0.0, 0.0]))
    view = view_coefficients(CAMERA, np.array(PLANE.R_CW), np.array(PLANE.t_m))
    gains = design(
        tick_noise(Setup(view, noise, start, 0.0126)), 60.0, 0.025, 0.0325 + section.marker_offset_m
    )
    for name, wanted in (
        ("MOVING_LENGTH", gains.moving_length),
        ("REST_LENGTH", gains.rest_length),
        ("ACCEL_GAIN", gains.accel_phi),
        ("PHI_PER_M", gains.camera_phi / gains.lever_m),
    ):
        assert c[f"CALIB_FUSED_{name}"] == pytest.approx(wanted, rel=0.03)


@pytest.mark.parametrize("phi", [-1.2, 0.0, 0.7])
def test_the_accelerometers_angle_is_right_at_every_angle(phi: float) -> None:
    """Biases and scales by themselves, not only what they make of the angle at rest."""
    c = header("full").values
    alpha = c["CALIB_IMU_MOUNT_ANGLE_RAD"]
    ax = 1.004 * 9.81 * math.cos(phi + alpha) + 0.1
    ay = 0.997 * 9.81 * math.sin(phi + alpha) + 0.1
    x = ax - c["CALIB_IMU_ACCEL_BIAS_X_MPS2"]
    y = (ay - c["CALIB_IMU_ACCEL_BIAS_Y_MPS2"]) * c["CALIB_IMU_ACCEL_RATIO"]
    assert math.atan2(y, x) - alpha == pytest.approx(phi, abs=1e-6)


def test_the_state_variable_form_is_the_section() -> None:
    """Impulse responses of the pipeline's form and of the difference equation that the header prints."""
    c = header("full").values
    A1, A2, A3 = (c[f"CALIB_LOWPASS_PAIR1_A{i}"] for i in (1, 2, 3))
    b, a = (
        [c[f"CALIB_LOWPASS_1_B{i}"] for i in range(3)],
        [1.0, c["CALIB_LOWPASS_1_A1"], c["CALIB_LOWPASS_1_A2"]],
    )
    from scipy.signal import lfilter

    impulse = np.zeros(400)
    impulse[0] = 1.0
    s1 = s2 = 0.0
    found = []
    for x in impulse:
        v3 = x - s2
        v1, y = A1 * s1 + A2 * v3, s2 + A2 * s1 + A3 * v3
        s1, s2 = 2.0 * v1 - s1, 2.0 * y - s2
        found.append(y)
    assert np.abs(np.array(found) - lfilter(b, a, impulse)).max() < 1e-7


def test_the_bias_of_the_imu_at_rest_is_used_without_align() -> None:
    c = make_header(Rig.of({"imu": _IMU}, "rig.yaml"), "rig.yaml").values
    assert c["CALIB_IMU_GYRO_BIAS_RADPS"] == pytest.approx(0.021)
    assert c["CALIB_MM_GYRO_BIAS_DT_RAD"] == pytest.approx(0.021 / 60.0)
    assert "imu.gyro_bias_radps" in header().text
    assert "imu.gyro_bias_radps" not in header("full").text


def test_the_shipped_header_is_that_of_the_true_camera(project_root: Path) -> None:
    """That it is what the shipped pictures give, to the byte, is the last step of `.ci/run`."""
    text = (project_root / "firmware_constants" / "calib_constants.h").read_text()
    focal = re.search(r"CALIB_CAMERA_FX_PX (\S+)f", text)
    assert focal is not None
    # The truth is in tests/truth/pictures.json: 273.4; sigma is 0.043.
    assert abs(float(focal.group(1)) - 273.4) < 0.2
