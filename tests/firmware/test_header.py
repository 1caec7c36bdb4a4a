"""The header: same rig, same bytes; compiles everywhere to NumPy's bits; its guards speak."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from firmware_build import need, warnings, write
from firmware_rigs import header, rig

from calib.core.errors import BadInputError
from calib.stages.firmware.header import header_of, header_text, identity_of

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


def test_same_rig_same_bytes() -> None:
    again = header_of(rig().model_copy(deep=True), "elsewhere/rig.yaml")
    assert header_text(again) == header_text(header())
    assert identity_of(again) == identity_of(header())


def test_another_value_another_id() -> None:
    identities = {
        re.search(r"CALIB_ID 0x([0-9A-F]{8})UL", header_text(header(k)))[1] for k in ("nominal", "full")
    }
    assert len(identities) == 2
    assert identity_of(header())[:8].upper() in identities


def test_every_float_has_a_comment_and_defaults_are_named() -> None:
    text = header_text(header())
    assert not re.findall(r"^#define CALIB_\w+ -?\d+\.\S+f *$", text, re.M)
    for key in (
        "orientation_filter.Kp_per_s",
        "actuator.bellows_radius_m",
        "controller.position.Kp_pwm_per_m",
    ):
        assert re.search(rf"Defaults.*{re.escape(key)}", text)
    full = header_text(header("full"))
    assert "orientation_filter.Kp_per_s" not in full
    assert "actuator.bellows_radius_m" not in full


@pytest.mark.parametrize("fused", [0, 1])
@pytest.mark.parametrize(("compiler", "flags"), COMPILERS, ids=lambda v: v.replace(" ", ""))
def test_every_constant_compiles_to_numpys_bits(
    tmp_path: Path, compiler: str, flags: str, fused: int
) -> None:
    made = replace(header("full"), inputs=HOSTILE)
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
    fits = "#define CALIB_EXPECT_SCHEMA 3\n#define CALIB_EXPECT_TICK_RATE_MHZ 60000\n"
    fits += "#define CALIB_EXPECT_PUMP_HIGH 255\n"
    done = _compiled(tmp_path, "gcc", "-std=c99", f'{fits}#include "calib_pipeline.h"\n')
    assert done.returncode == 0, done.stderr


def test_a_rig_without_what_the_fused_estimator_needs_does_not_compile(tmp_path: Path) -> None:
    bare = header_of(rig("fused").model_copy(update={"align": None}), "rig.yaml")
    write(tmp_path, bare)
    assert "Fused estimator: none. rig.yaml lacks align." in (tmp_path / "calib_constants.h").read_text()
    for fused in (0, 1):
        unit = '#include "calib_pipeline.h"\n'
        done = _compiled(tmp_path, "gcc", f"-std=c99 -DCALIB_FUSED={fused}", unit)
        assert (done.returncode == 0) == (fused == 0)
    assert "rig.yaml lacks what CALIB_FUSED needs" in done.stderr


def test_a_header_without_a_plane_has_no_pipeline(tmp_path: Path) -> None:
    bare = header_of(rig().model_copy(update={"plane": None}), "rig.yaml")
    write(tmp_path, header())
    (tmp_path / "calib_constants.h").write_text(header_text(bare))
    done = _compiled(tmp_path, "gcc", "-std=c99", '#include "calib_pipeline.h"\n')
    assert done.returncode != 0
    assert "has no plane yet" in done.stderr


def test_a_self_test_of_another_rig_does_not_compile(tmp_path: Path) -> None:
    write(tmp_path, header())
    (tmp_path / "calib_constants.h").write_text(header_text(header("full")))
    done = _compiled(tmp_path, "gcc", "-std=c99", '#include "calib_selftest.h"\n')
    assert done.returncode != 0
    assert "another rig" in done.stderr


def test_a_controller_for_another_tick_is_refused() -> None:
    control = rig("full").controller
    assert control is not None
    other = rig("full").model_copy(update={"controller": control.model_copy(update={"tick_s": 0.02})})
    with pytest.raises(BadInputError, match=r"controller\.tick_s is 0\.02 s, but the low-pass runs at 60 Hz"):
        header_of(other, "rig.yaml")


def test_cppcheck_finds_nothing(tmp_path: Path) -> None:
    need("cppcheck")
    write(tmp_path, header("full"))
    unit = '#include "calib_selftest.h"\nint main(void) { return (int)calib_selftest(); }\n'
    (tmp_path / "unit.c").write_text(unit)
    call = ["cppcheck", "--std=c99", "--enable=warning,performance,portability", "--inline-suppr", "--force"]
    call += ["--error-exitcode=1", "--quiet", "-DCALIB_STAGE(n)=", "unit.c"]
    for fused in (0, 1):
        own = [*call, f"-DCALIB_FUSED={fused}"]
        done = subprocess.run(own, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
