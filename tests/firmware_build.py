"""Compiling the firmware for this machine and for an ATmega328P, and running both on the same records."""

from __future__ import annotations

import atexit
import ctypes
import re
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from firmware_rigs import header

from calib.io.serial import Inputs
from calib.stages.firmware.conformance import binary32, make_reference
from calib.stages.firmware.header import VERBATIM, Header, verbatim
from calib.stages.firmware.vectors import TOLERANCE

__all__ = [
    "HOSTILE",
    "LIMITS",
    "NATIVE",
    "Built",
    "Process",
    "Simulated",
    "Ticks",
    "avr",
    "budget",
    "compare",
    "host",
    "hostile",
    "link",
    "need",
    "pack",
    "run",
    "selftest",
    "sketch",
    "strew",
    "warnings",
    "write",
]

LIMITS = np.array([TOLERANCE["phi_rad"], *[TOLERANCE["marker_m"]] * 2, *[TOLERANCE["q_m"]] * 4, *[0.01] * 2])
"""What the nine numbers of a tick may differ by from float64."""

HOSTILE = [0.0, -0.0, 1e-45, -1e-38, 1e-20, 0.5, 3.14159, 400.0, 401.0, 1e9, -1e20, 3.4e38, -3.4e38]
HOSTILE += [float("nan"), float("inf"), -float("inf")]

NATIVE = Path(__file__).parent / "firmware" / "native"

warnings = [
    *("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wdouble-promotion", "-Wfloat-conversion"),
    *("-Wundef", "-Wshadow", "-Werror"),
]


ARDUINO = Path("/usr/share/arduino/hardware/arduino/avr")
"""The Arduino core, as Debian's package arduino-core-avr puts it."""


def need(tool: str) -> None:
    """Skip without a tool."""
    if tool == "arduino":
        if not ARDUINO.exists():
            pytest.skip("arduino-core-avr is not installed")
        return
    there = Path("/usr/include/simavr/sim_avr.h").exists() if tool == "simavr" else shutil.which(tool)
    if tool == "avr-gcc" and there:
        there = Path("/usr/lib/avr/include/avr/io.h").exists()
    if not there:
        pytest.skip(f"{tool} is not installed")


@cache
def budget(most: int) -> int:
    """What cycles or bytes are held to: `most` with avr-gcc 5, else a twentieth more.

    The manual's figures are of avr-gcc 5.4; it says what 14.2 makes of them.
    """
    said = subprocess.run(["avr-gcc", "-dumpversion"], capture_output=True, text=True, check=True).stdout
    return most if said.startswith("5.") else most + most // 20


def write(folder: Path, header: Header) -> None:
    """The header's files, as `calib firmware` writes them."""
    (folder / "calib_constants.h").write_text(header.text)
    for name in VERBATIM:
        (folder / name).write_text(verbatim(name))
    (folder / "calib_selftest.h").write_text(header.selftest)


def _compile(command: Sequence[str | Path]) -> None:
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def host(folder: Path, *flags: str, compiler: str = "gcc") -> list[str]:
    """Compile program.c with the headers in a folder; the command that runs it."""
    need(compiler)
    made = folder / f"host-{compiler}"
    strict = ["-std=c99", "-O2", "-ffp-contract=off", *warnings, *flags]
    _compile([compiler, *strict, f"-I{folder}", "-o", made, NATIVE / "program.c", "-lm"])
    return [str(made)]


def selftest(folder: Path, which: str, *flags: str, compiler: str = "gcc") -> bool:
    """Whether the self-test of the headers in a folder passes on this machine: "selftest" or "guard"."""
    need(compiler)
    made, source = folder / f"{which}-{compiler}", folder / f"{which}.c"
    call = "calib_guard_selftest" if which == "guard" else "calib_selftest"
    source.write_text(f'#include "calib_{which}.h"\nint main(void) {{ return {call}() != 0; }}\n')
    language = "c++" if "++" in compiler else "c"
    _compile([compiler, *flags, f"-I{folder}", "-x", language, source, "-lm", "-o", made])
    return subprocess.run([made], check=False).returncode == 0


@cache
def _scratch() -> Path:
    """A folder for what is compiled once in a run of tests."""
    folder = Path(tempfile.mkdtemp(prefix="calib-core-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@cache
def _simulator(name: str) -> Path:
    """A simulated board as a program, and beside it as a library."""
    need("simavr")
    need("gcc")
    made = _scratch() / name
    for target, flags in ((made, ()), (f"{made}.so", ("-fPIC", "-shared"))):
        _compile(["gcc", "-O2", *flags, "-o", target, NATIVE / f"{name}.c", "-lsimavr", "-lm"])
    return made


def avr(folder: Path, *flags: str) -> tuple[list[str], dict[str, int]]:
    """The same for the ATmega328P, in the simulator; the command and the sizes in bytes."""
    need("avr-gcc")
    made, runner = folder / "program.elf", _simulator("runner")
    target = ["-std=c99", "-Os", "-mmcu=atmega328p", "-DF_CPU=16000000UL", "-DCALIB_MEASURE"]
    _compile(["avr-gcc", *target, *warnings, *flags, f"-I{folder}", "-o", made, NATIVE / "program.c", "-lm"])
    listing = subprocess.run(["avr-nm", made], capture_output=True, text=True, check=True).stdout
    places = {name: f"0x{place}" for place, name in re.findall(r"^(\w+) \w (in|out|_end)$", listing, re.M)}
    sizes = subprocess.run(["avr-size", made], capture_output=True, text=True, check=True).stdout
    text, data, bss = map(int, sizes.splitlines()[1].split()[:3])
    command = [str(runner), str(made), places["in"], places["out"], places["_end"]]
    return command, {"flash": text + data, "ram": data + bss}


@dataclass(frozen=True)
class Built:
    """The sketch with the Arduino core: the command that runs it, and its sizes in bytes.

    Attributes
    ----------
    library : the simulated board for a caller of its own, see `Board`.
    """

    command: list[str]
    flash: int
    ram: int
    library: str

    @property
    def program(self) -> str:
        """The sketch as a file of the linker's."""
        return self.command[1]


_STANDARD = ARDUINO / "variants" / "standard"
_LIBRARIES = [ARDUINO / "libraries" / name / "src" for name in ("Wire", "SPI")]
_TARGET = ["-mmcu=atmega328p", "-Os", "-DF_CPU=16000000UL", "-DARDUINO=10819", "-DARDUINO_ARCH_AVR",
           "-ffunction-sections", "-fdata-sections", "-fno-exceptions",
           *(f"-I{path}" for path in (ARDUINO / "cores" / "arduino", _STANDARD, *_LIBRARIES)),
           f"-I{ARDUINO / 'libraries' / 'Wire' / 'src' / 'utility'}"]  # fmt: skip


@cache
def _core() -> tuple[Path, ...]:
    """The simulated rig, and the Arduino core compiled: once in a run of tests."""
    for tool in ("avr-gcc", "arduino"):
        need(tool)
    core, wire = ARDUINO / "cores" / "arduino", ARDUINO / "libraries" / "Wire" / "src"
    names = ("main", "HardwareSerial", "HardwareSerial0", "Print", "Stream", "abi", "new")
    cpp = [*(core / f"{name}.cpp" for name in names), wire / "Wire.cpp", _LIBRARIES[1] / "SPI.cpp"]
    plain = [*sorted(core.glob("wiring*.c")), core / "hooks.c", wire / "utility" / "twi.c"]
    objects = []
    for path in (*cpp, *plain):
        objects.append(_scratch() / f"{path.name}.o")
        tool = ["avr-gcc"] if path.suffix == ".c" else ["avr-g++", "-std=gnu++11", "-fno-threadsafe-statics"]
        _compile([*tool, *_TARGET, "-w", "-c", path, "-o", objects[-1]])
    return _simulator("rig"), *objects


def sketch(folder: Path, mode: str, *flags: str, made: Header | None = None) -> Built:
    """The example sketch for the ATmega328P with the Arduino core, and the simulated rig around it."""
    write(folder, made or header())
    (folder / "sketch.cpp").write_text(verbatim("calib_example.ino"))
    return link(folder, folder / "sketch.cpp", f"-DCALIB_EXAMPLE_MODE=CALIB_MODE_{mode}", *flags)


def link(folder: Path, source: Path, *flags: str) -> Built:
    """A sketch in a folder of headers, linked with the Arduino core."""
    rig, *objects = _core()
    made, unit = source.with_suffix(".elf"), source.with_suffix(".o")
    ours = ["-std=gnu++11", "-Wall", "-Wextra", "-Werror", "-DCALIB_I_KNOW=1", f"-I{folder}", *flags]
    _compile(["avr-g++", *_TARGET, *ours, "-fno-threadsafe-statics", "-x", "c++", "-c", source, "-o", unit])
    _compile(["avr-gcc", *_TARGET[:2], "-Wl,--gc-sections", "-o", made, unit, *objects, "-lm"])
    sizes = subprocess.run(["avr-size", made], capture_output=True, text=True, check=True).stdout
    text, data, bss = map(int, sizes.splitlines()[1].split()[:3])
    return Built([str(rig), str(made)], text + data, data + bss, f"{rig}.so")


def pack(given: Inputs) -> bytes:
    """The record that program.c takes."""
    return struct.pack("<8f3B", *given.numbers, given.marker_seen, given.imu_read, given.mode)


@dataclass(frozen=True)
class Ticks:
    """What a program gave.

    Attributes
    ----------
    numbers : (n, 9) phi, marker, head, lengths, commands. flags : (n,). duty : (n, 2).
    extra : (n, m) the counters of the host, or cycles by stage of the AVR.
    stack : deepest stack of the AVR in bytes, 0 of a host.
    """

    numbers: np.ndarray
    flags: np.ndarray
    duty: np.ndarray
    extra: np.ndarray
    stack: int


def _unpacked(data: bytes, on_avr: bool, stack: int = 0) -> Ticks:
    more = np.dtype(("<u4", 8)) if on_avr else np.dtype(("<u2", 7))
    kind = np.dtype([("numbers", "<f4", 9), ("flags", "<u2"), ("duty", "u1", 2), ("extra", more)])
    rows = np.frombuffer(data, dtype=kind)
    return Ticks(rows["numbers"].astype(float), rows["flags"].astype(int), rows["duty"], rows["extra"], stack)


def run(command: Sequence[str], ticks: Sequence[Inputs]) -> Ticks:
    """All ticks through a program, from its start."""
    done = subprocess.run(command, input=b"".join(map(pack, ticks)), capture_output=True, check=True)
    stack = re.search(rb"stack (\d+)", done.stderr)
    found = _unpacked(done.stdout, len(command) > 1, int(stack.group(1)) if stack else 0)
    assert len(found.flags) == len(ticks)
    return found


class Simulated:
    """The AVR's program in a simulator that lives in this process; one at a time in a folder.

    Attributes
    ----------
    record : (35,) bytes of the next tick's inputs, as `pack` makes them. result : (72,) bytes.
    """

    def __init__(self, command: Sequence[str]) -> None:
        # A library of its own, since the simulator lives in its variables.
        library = ctypes.CDLL(shutil.copy(f"{command[0]}.so", f"{command[1]}.so"))
        addresses = [int(word, 0) & 0xFFFF for word in command[2:5]]
        assert library.runner_open(command[1].encode(), *addresses) == 0
        self.record, self.result = np.zeros(35, dtype=np.uint8), np.zeros(72, dtype=np.uint8)
        self._tick = library.runner_tick
        self._places = (ctypes.c_void_p(self.record.ctypes.data), ctypes.c_void_p(self.result.ctypes.data))

    def tick(self) -> None:
        """From `record` to `result`."""
        assert self._tick(*self._places) == 0


class Process:
    """A program on this machine that gets one tick at a time."""

    def __init__(self, command: Sequence[str]) -> None:
        self.process = subprocess.Popen(
            [*command, "flush"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )

    def send(self, given: Inputs) -> None:
        """Begin a tick."""
        assert self.process.stdin is not None
        self.process.stdin.write(pack(given))
        self.process.stdin.flush()

    def receive(self) -> Ticks:
        """Wait for its end."""
        assert self.process.stdout is not None
        return _unpacked(self.process.stdout.read(54), False)

    def close(self) -> None:
        """End the program."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(timeout=60)
        self.process.stdout.close()


def compare(
    header: Header,
    ticks: Sequence[Inputs],
    found: Ticks,
    undistort: bool | None = None,
    fused: bool = False,
    mean_rate: bool = False,
) -> tuple[np.ndarray, float]:
    """Largest differences (9,) from the reference, and of undecided outputs [PWM]; flags have to agree.

    What the fused estimator may have decided otherwise lies within a micrometre of its limits.
    """
    constants = header.values
    reference = make_reference(constants, undistort, fused, mean_rate)
    wanted, undecided = [], 0.0
    for k, given in enumerate(ticks):
        out = reference.step(given, int(found.flags[k]))
        said = f"tick {k}: flags {found.flags[k]:#x}, wanted {out.flags:#x}, {given}"
        assert out.flags == found.flags[k], said
        undecided = max(undecided, out.undecided_pwm)
        assert out.undecided_m <= 1e-6, (k, out.undecided_m)
        wanted.append(out.numbers)
    return np.abs(found.numbers - np.array(wanted)).max(axis=0), undecided


def strew(ticks: list[Inputs], rng: np.random.Generator, losses: int) -> None:
    """Put hostile values into some of the ticks, and let a sensor fall silent `losses` times."""
    for k in rng.choice(len(ticks), 3000, replace=False).tolist():
        field = rng.choice(["u_px", "v_px", "ax_mps2", "ay_mps2", "gz_radps", "late_ticks"])
        ticks[k] = binary32(replace(ticks[k], **{str(field): float(rng.choice(HOSTILE))}))
    for k in rng.choice(len(ticks), 300, replace=False).tolist():
        ticks[k] = binary32(
            replace(ticks[k], reference=(float(rng.choice(HOSTILE)), float(rng.choice(HOSTILE))))
        )
    for k in rng.choice(len(ticks) - 100, losses, replace=False).tolist():
        lost = {"marker_seen": False} if rng.random() < 0.5 else {"imu_read": False}
        for j in range(k, k + int(rng.integers(5, 90))):
            ticks[j] = replace(ticks[j], **lost)


def hostile(rng: np.random.Generator, count: int) -> list[Inputs]:
    """Ticks in which every value is hostile at once."""
    draw = rng.choice(HOSTILE, (count, 8)).tolist()
    modes = rng.integers(0, 5, len(draw)).tolist()
    seen = rng.integers(0, 2, (len(draw), 2)).tolist()
    return [
        binary32(Inputs(*row[:5], (row[5], row[6]), bool(a), bool(b), mode, row[7]))
        for row, mode, (a, b) in zip(draw, modes, seen, strict=True)
    ]
