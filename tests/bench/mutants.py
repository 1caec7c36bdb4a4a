"""What a board's self-test sees: random mutants of pipeline, guard and constants, and the share caught.

    python tests/bench/mutants.py [COUNT] [SEED]

Each mutant changes one operator, number or condition, or leaves out one assignment or call, in
calib_pipeline.h, calib_guard.h or a constant that they read. It is caught where `calib_selftest` or
`calib_guard_selftest` fails, for a rig with every section, with CALIB_FUSED 0 or 1, for the nominal one, or
for one with the levelling filter.
Of the others each that changes what a program gives by more than the self-test's tolerances, in runs with
sound, lost, frozen, absurd and hostile sensors, is observable, and printed. COUNT is 200 by default. The
exit code is 1 when one of these was not caught.

What is known to remain: 2 % more of CALIB_FUSED_MOVING_M, which moves a length by 0.09 mm for two ticks; of
the last coefficient of calib_atan2, 5 urad; of CALIB_FUSED_SLOW and _STILL_M, nothing in these runs; the last
step of the levelling's gains, after half a minute. Without any effect: an array that is longer, a limit that
is compared at equality, a truth of 2, an index past a memory that is written over in the same tick, and one
tick of a minute in open loop.
"""

from __future__ import annotations

import random
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import _here
import numpy as np
from firmware_build import LIMITS, NATIVE, Ticks, hostile, run, write
from firmware_rigs import header

from calib.io.serial import MODE_OFF, MODE_ORIENTATION, MODE_POSITION, Inputs
from calib.stages.firmware.vectors import binary32, coherent, directed

BUILDS = (("full", 0), ("full", 1), ("nominal", 0), ("levelling", 0), ("plain", 0))
UNIT = """
#include "calib_guard.h"
#include "calib_selftest.h"
int main(void) { return calib_selftest() != 0 || calib_guard_selftest() != 0; }
"""
SWAPS = {"<=": "<", ">=": ">", "<": "<=", ">": ">=", "==": "!=", "!=": "==", "&&": "||", "||": "&&",
         "+": "-", "-": "+", "*": "/", "+=": "-=", "-=": "+=", "++": "--", "--": "++"}  # fmt: skip
_OPERATOR = re.compile(r"(?<= )(<=|>=|<|>|==|!=|&&|\|\||\+=|-=|\+|-|\*)(?= )|(?<=\w)(\+\+|--)(?=;)")
_NUMBER = re.compile(r"(?<![\w.])(\d+\.\d+(?:e-?\d+)?f|\d+u?)(?![\w.])")
_ASSIGNMENT = re.compile(
    r"^\s+(?:state|guard|out|own|phi|flags|\*?\w+)[\w>.\[\]*-]* [-+]?= [^;{]*;$|^\s+\w+\(.*\);$"
)
_CONDITION = re.compile(r"\bif \(")


@dataclass(frozen=True)
class Mutant:
    """A line of a file, as it was and as it is."""

    name: str
    line: int
    before: str
    after: str


def _changed(number: str) -> str:
    if number.endswith("f"):
        return f"{1.02 * float(number[:-1]):.9g}f" if float(number[:-1]) else "1.0f"
    return str(int(number.rstrip("u")) + 1) + ("u" if number.endswith("u") else "")


def _mutants_of(name: str, line: int, text: str) -> Iterator[Mutant]:
    code = re.sub(r"/\*.*?(\*/|$)", "", text)
    if "CALIB_STAGE(" in code:
        return
    for pattern in (_OPERATOR, _NUMBER):
        for at in pattern.finditer(code):
            new = SWAPS[at[0]] if pattern is _OPERATOR else _changed(at[0])
            yield Mutant(name, line, text, text[: at.start()] + new + text[at.end() :])
    for at in _CONDITION.finditer(code):
        yield Mutant(name, line, text, text[: at.end()] + "!" + text[at.end() :])
    if _ASSIGNMENT.match(code) and not code.lstrip().startswith(("return", "float", "uint", "(void)")):
        yield Mutant(name, line, text, "")


def _all(folder: Path) -> Iterator[Mutant]:
    for name, begin, end in (
        ("calib_pipeline.h", "static inline void calib_count", "#endif /* CALIB_PIPELINE_H"),
        ("calib_guard.h", "#define CALIB_GUARD_QUIET_TICKS", "/* What the self-test turns"),
    ):
        inside = comment = False
        for k, text in enumerate((folder / name).read_text().splitlines()):
            inside = (inside or text.startswith(begin)) and not text.startswith(end)
            comment = comment or text.startswith("/*")
            if (
                inside
                and not comment
                and (not text.startswith("#") or text.startswith("#define CALIB_GUARD"))
            ):
                yield from _mutants_of(name, k, text)
            comment = comment and "*/" not in text
    readers = (folder / "calib_pipeline.h").read_text() + (folder / "calib_guard.h").read_text()
    for k, text in enumerate((folder / "calib_constants.h").read_text().splitlines()):
        at = re.match(r"#define (CALIB_\w+) (-?\S+) /\*", text)
        if at and at[1] in readers and not at[1].startswith("CALIB_HAS"):
            value = f"{1.02 * float(at[2][:-1]):.9g}" if at[2].endswith("f") else str(int(at[2]) + 1)
            value += ".0" * ("." not in value and "e" not in value) + "f" if at[2].endswith("f") else ""
            yield Mutant("calib_constants.h", k, text, f"#define {at[1]} {value}")


def _mutated(folder: Path, mutant: Mutant) -> str:
    """Put the mutant into its file; the text as it was."""
    path = folder / mutant.name
    text = path.read_text()
    lines = text.splitlines()
    if mutant.name == "calib_constants.h":
        # The same constant of this folder's rig.
        name = mutant.before.split()[1]
        lines = [mutant.after if line.startswith(f"#define {name} ") else line for line in lines]
    else:
        lines[mutant.line] = mutant.after
    path.write_text("\n".join(lines) + "\n")
    return text


def _gcc(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    call = ["gcc", "-std=c99", "-w", f"-I{folder}", *map(str, words)]
    return subprocess.run(call, check=False, capture_output=True, text=True)


def _built(folder: Path, source: Path, *flags: str) -> Path | None:
    made = folder / source.stem
    return made if _gcc(folder, "-O0", *flags, source, "-lm", "-o", made).returncode == 0 else None


def _caught(folders: dict[str, Path], mutant: Mutant) -> bool | None:
    """Whether a self-test fails; None for what does not compile or has no end."""
    for kind, fused in BUILDS:
        folder = folders[kind]
        before = _mutated(folder, mutant)
        (folder / "selftest.c").write_text(UNIT)
        try:
            made = _built(folder, folder / "selftest.c", f"-DCALIB_FUSED={fused}")
            if made is None:
                return None
            if subprocess.run([made], check=False, timeout=20).returncode != 0:
                return True
        except subprocess.TimeoutExpired:
            return True
        finally:
            (folder / mutant.name).write_text(before)
    return False


def _code(folder: Path, fused: int) -> str:
    """What an optimising compiler makes of the firmware."""
    (folder / "whole.c").write_text(UNIT)
    return _gcc(folder, "-O2", f"-DCALIB_FUSED={fused}", "-S", "-o", "-", folder / "whole.c").stdout


def _alike(folders: dict[str, Path], plain: dict[tuple[str, int], str], mutant: Mutant) -> bool:
    """Whether the machine's instructions are the same in every build: the mutant is none."""
    for kind, fused in BUILDS:
        before = _mutated(folders[kind], mutant)
        same = _code(folders[kind], fused) == plain[kind, fused]
        (folders[kind] / mutant.name).write_text(before)
        if not same:
            return False
    return True


@cache
def _stimuli(kind: str) -> list[list[Inputs]]:
    """Sound ticks, then 150 with something wrong, then sound ones again; directed and hostile ones."""
    values = header(kind).values
    period = [replace(t, mode=MODE_POSITION) for t in coherent(header("full").values, 240)]
    period = [binary32(replace(t, reference=(0.07, 0.072))) for t in period]
    still, nan, made = period[-1], float("nan"), []
    wrongs = [
        {}, {"marker_seen": False}, {"imu_read": False}, {"u_px": nan}, {"ax_mps2": nan}, {"gz_radps": nan},
        {"u_px": still.u_px + 60.0}, {"ax_mps2": 39.0}, {"ay_mps2": -39.0}, {"ax_mps2": 0.2, "ay_mps2": 0.2},
        {"reference": (0.2, 0.07)}, {"reference": (0.07, 0.01)}, {"reference": (0.112, 0.112)},
        {"reference": (nan, 0.07)}, {"mode": MODE_OFF}, {"mode": MODE_ORIENTATION, "reference": (0.3, 0.0)},
        {"mode": MODE_ORIENTATION, "reference": (1.6, 0.0)}, {"mode": 9}, {"v_px": 2.0}, {"v_px": 200.0},
        {"mode": MODE_ORIENTATION, "gz_radps": -12.0}, {"mode": MODE_ORIENTATION, "gz_radps": 12.0},
        {"mode": 3, "reference": (120.0, 90.0)}, {"mode": 3, "reference": (120.0, 300.0)},
    ]  # fmt: skip
    rng = np.random.default_rng(3)
    for wrong in wrongs:
        noise = rng.normal(0.0, 0.05, (500, 3)).tolist()
        sound = [
            replace(still, ax_mps2=still.ax_mps2 + a, ay_mps2=still.ay_mps2 + b, gz_radps=0.1 * c)
            for a, b, c in noise
        ]
        ticks = [*sound[:120], *(replace(one, **wrong) for one in sound[120:270]), *sound[270:]]
        made.append(list(map(binary32, ticks)))
    frozen = made[0][:120] + [made[0][120]] * 150 + made[0][270:]
    return [*made, frozen, [*period, *period, *period], directed(values, 800), hostile(rng, 1500)]


def _runs(folder: Path, kind: str, fused: int) -> list[Ticks] | None:
    program = _built(folder, NATIVE / "program.c", f"-DCALIB_FUSED={fused}", "-DCALIB_GUARDED")
    try:
        return None if program is None else [run([str(program)], ticks) for ticks in _stimuli(kind)]
    except subprocess.CalledProcessError:
        return []


def _observable(folders: dict[str, Path], plain: dict[tuple[str, int], list[Ticks]], mutant: Mutant) -> bool:
    """Whether numbers, flags, duty or counters differ in any run."""
    for kind, fused in BUILDS:
        before = _mutated(folders[kind], mutant)
        found = _runs(folders[kind], kind, fused)
        (folders[kind] / mutant.name).write_text(before)
        if not found:
            return True
        for one, two in zip(found, plain[kind, fused], strict=True):
            off = np.abs(one.numbers - two.numbers) > LIMITS
            near = np.abs(one.duty.astype(int) - two.duty) > 1
            if off.any() or near.any() or (one.flags != two.flags).any() or (one.extra != two.extra).any():
                return True
    return False


def main(count: int, seed: int) -> int:
    """Print the uncaught ones and the shares; the exit code."""
    draw = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folders = {kind: Path(name) / kind for kind in {kind for kind, _ in BUILDS}}
        for kind, folder in folders.items():
            folder.mkdir()
            write(folder, header(kind))
        every = list(_all(folders["full"]))
        draw.shuffle(every)
        plain = {build: _runs(folders[build[0]], *build) or [] for build in BUILDS}
        code = {(kind, fused): _code(folders[kind], fused) for kind, fused in BUILDS}
        caught = tried = silent = same = 0
        missed = []
        for mutant in every:
            seen = _caught(folders, mutant)
            if seen is None:
                continue
            tried += 1
            caught += seen
            if not seen and _alike(folders, code, mutant):
                same += 1
            elif not seen and _observable(folders, plain, mutant):
                missed.append(mutant)
                lines = f"  - {mutant.before.strip()}\n  + {mutant.after.strip()}"
                print(f"not caught: {mutant.name}:{mutant.line + 1}\n{lines}", flush=True)
            elif not seen:
                silent += 1
                print(
                    f"no effect: {mutant.name}:{mutant.line + 1}: {mutant.after.strip() or '(left out)'}",
                    flush=True,
                )
            if tried == count:
                break
    share = caught / max(tried - silent - same, 1)
    told = f"{caught} caught, {same} the same code, {silent} without effect, {len(missed)} not caught"
    told += f"; {share:.1%}"
    print(f"{tried} of {len(every)} mutants: {told} of those with an effect are caught")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(*_here.numbers(200, 1)))
