"""The pipeline on the ATmega328P: the same values, what they cost, loops it closes, and the sketch."""

from __future__ import annotations

import contextlib
import math
import re
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from firmware_build import (
    LIMITS,
    NATIVE,
    Process,
    Simulated,
    avr,
    budget,
    compare,
    host,
    need,
    pack,
    run,
    sketch,
    write,
)
from firmware_rigs import header, rig

from calib.core.rig import Rig
from calib.io.serial import MODE_ORIENTATION, MODE_POSITION, Inputs
from calib.stages.actuator.simulate import rig_at_rest
from calib.stages.control.references import Ellipse
from calib.stages.firmware.conformance import make_reference
from calib.stages.firmware.header import make_header, verbatim
from calib.stages.firmware.vectors import binary32, coherent, directed, directed_fused
from calib.twin.rig import SimulatedRig
from calib.twin.simulate import Seen, simulate

TICK_CYCLES = 266_667
STAGES = ("", "angle", "plane", "offset", "low-pass", "lengths", "control")


@pytest.mark.few(1, 6, 9)
@pytest.mark.parametrize("progmem", [False, True])
@pytest.mark.parametrize("undistort", [0, 1])
@pytest.mark.parametrize("kind", ["nominal", "full", "levelling"])
def test_the_same_values_as_in_float64(tmp_path: Path, kind: str, undistort: int, progmem: bool) -> None:
    made = header(kind)
    write(tmp_path, made)
    command, sizes = avr(
        tmp_path, f"-DCALIB_UNDISTORT={undistort}", *(["-DCALIB_PROGMEM"] if progmem else [])
    )
    ticks = directed(made.values, 1500)
    found = run(command, ticks)
    worst, undecided = compare(made, ticks, found, bool(undistort))
    print(f"{kind}, undistort {undistort}: differences {worst}, {sizes}, stack {found.stack}")
    assert (worst <= LIMITS).all(), worst
    assert undecided <= 0.01
    assert sizes["flash"] <= 8192
    tables = 4 * 17 * 4 * (kind == "levelling" and not progmem)
    assert sizes["ram"] + found.stack <= 300 + 60 * (kind != "nominal") + tables + 20 * (kind == "levelling")


@pytest.mark.few(3)
@pytest.mark.parametrize("undistort", [0, 1])
@pytest.mark.parametrize("kind", ["fused", "full"])
def test_the_fused_estimator_gives_the_same_values(tmp_path: Path, kind: str, undistort: int) -> None:
    made = header(kind)
    write(tmp_path, made)
    command, sizes = avr(tmp_path, "-DCALIB_FUSED=1", f"-DCALIB_UNDISTORT={undistort}")
    ticks = directed_fused(made.values, 1500, bool(undistort))
    found = run(command, ticks)
    worst, undecided = compare(made, ticks, found, bool(undistort), fused=True)
    print(f"{kind}, fused, undistort {undistort}: differences {worst}, {sizes}, stack {found.stack}")
    assert (worst <= LIMITS).all(), worst
    assert undecided <= 0.01
    assert sizes["flash"] <= 8192
    assert sizes["ram"] + found.stack <= 300


@pytest.mark.few(2)
@pytest.mark.parametrize("kind", ["nominal", "fused", "full"])
def test_the_self_test_passes_on_the_board(tmp_path: Path, kind: str) -> None:
    write(tmp_path, header(kind))
    switch = ["-DCALIB_FUSED=1"] if kind == "fused" else []
    command, sizes = avr(tmp_path, "-DCALIB_SELFTEST", "-DCALIB_PROGMEM", *switch)
    found = run(command, [_thesis_ticks([(0.08, 0.08)])[0]])
    print(f"self-test: {sizes}, stack {found.stack}, {found.extra[0, 7] / 16e6:.3f} s")
    assert found.flags[0] == 0
    path = tmp_path / "calib_constants.h"
    radius = f"CALIB_BELLOWS_RADIUS_M {header(kind).literals['CALIB_BELLOWS_RADIUS_M']}"
    assert radius in path.read_text()
    path.write_text(path.read_text().replace(radius, "CALIB_BELLOWS_RADIUS_M 0.0127f"))
    command, _ = avr(tmp_path, "-DCALIB_SELFTEST", "-DCALIB_PROGMEM", *switch)
    assert run(command, [_thesis_ticks([(0.08, 0.08)])[0]]).flags[0] > 0


def _thesis_ticks(reference: list[tuple[float, float]]) -> list[Inputs]:
    """Motion through the workspace with both controllers' parts at work and nothing lost."""
    made = []
    for k, wanted in enumerate(reference):
        phi = 1.2 * math.sin(0.013 * k)
        made.append(
            binary32(
                Inputs(
                    158.0 + 90.0 * math.sin(0.017 * k),
                    104.0 + 70.0 * math.cos(0.011 * k),
                    9.81 * math.cos(phi) + 0.4 * math.sin(0.5 * k),
                    9.81 * math.sin(phi) + 0.4 * math.cos(0.7 * k),
                    -1.2 * 0.013 * 60.0 * math.cos(0.013 * k),
                    wanted,
                    mode=MODE_POSITION,
                    late_ticks=0.9,
                )
            )
        )
    return made


def _told(name: str, cycles: np.ndarray) -> int:
    most = int(cycles[2:, 7].max())
    parts = ", ".join(f"{stage} {int(cycles[2:, i].max())}" for i, stage in enumerate(STAGES) if stage)
    print(f"{name}: {int(cycles[2:, 7].mean())} cycles on average, {most} at most ({parts})")
    print(f"  {100.0 * most / TICK_CYCLES:.1f} % of a 60 Hz tick at 16 MHz")
    return most


@pytest.mark.slow
def test_the_budget_of_the_thesis_tick(tmp_path: Path) -> None:
    """Angle filter, homography, low-pass, inverse kinematics, PD with feed-forward, in every tick."""
    still = [(0.08, 0.085)] * 1200
    moving = [(0.015 * math.sin(0.02 * k), 0.078 - 0.01 * math.cos(0.02 * k)) for k in range(1200)]
    write(tmp_path, header())
    command, sizes = avr(tmp_path, "-DCALIB_UNDISTORT=0")
    assert _told("constant reference", run(command, _thesis_ticks(still)).extra) <= budget(15_000)
    command, sizes = avr(tmp_path, "-DCALIB_UNDISTORT=0", "-DCALIB_MOVING")
    assert _told("moving reference", run(command, _thesis_ticks(moving)).extra) <= budget(19_000)
    assert sizes["flash"] <= 8192
    write(tmp_path, header("twin"))
    command, _ = avr(tmp_path, "-DCALIB_UNDISTORT=0")
    assert _told("aligned rig, constant reference", run(command, _thesis_ticks(still)).extra) <= budget(
        15_500
    )
    command, _ = avr(tmp_path, "-DCALIB_UNDISTORT=0", "-DCALIB_MOVING")
    assert _told("aligned rig, moving reference", run(command, _thesis_ticks(moving)).extra) <= budget(19_500)
    section = rig("levelling").orientation_filter
    write(tmp_path, make_header(rig("twin").with_sections({"orientation_filter": section}), "rig.yaml"))
    command, _ = avr(tmp_path, "-DCALIB_UNDISTORT=0")
    assert _told("levelling, constant reference", run(command, _thesis_ticks(still)).extra) <= budget(17_500)
    integral = _with_integral(rig())
    write(tmp_path, make_header(integral, "rig.yaml"))
    command, sizes = avr(tmp_path, "-DCALIB_UNDISTORT=0")
    cycles = run(command, _thesis_ticks(still)).extra
    assert _told("constant reference, integral part as well", cycles) <= budget(15_500)
    write(tmp_path, header())
    command, sizes = avr(tmp_path, "-DCALIB_UNDISTORT=1", "-DCALIB_MOVING")
    assert _told("moving reference and undistortion", run(command, _thesis_ticks(moving)).extra) <= budget(
        23_000
    )


def test_the_budget_of_the_fused_tick(tmp_path: Path) -> None:
    """Undistortion, fused estimator, reference point and PD with feed-forward, in every tick."""
    made = header("fused")
    still, moving = (0.08, 0.085), [(0.015 * math.sin(0.02 * k), 0.078) for k in range(1200)]
    ticks = coherent(made.values, len(moving))
    write(tmp_path, made)
    for name, flags, wanted, most in (
        ("fused, undistortion, constant reference", (), [still] * len(moving), 20_000),
        ("fused, undistortion, moving reference", ("-DCALIB_MOVING",), moving, 23_000),
        ("the same, guarded", ("-DCALIB_MOVING", "-DCALIB_GUARDED", "-DCALIB_I_KNOW"), moving, 24_000),
    ):
        command, sizes = avr(tmp_path, "-DCALIB_FUSED=1", "-DCALIB_UNDISTORT=1", *flags)
        given = [replace(t, reference=w, mode=MODE_POSITION) for t, w in zip(ticks, wanted, strict=True)]
        found = run(command, list(map(binary32, given)))
        assert _told(name, found.extra) <= budget(most)
        print(f"  {sizes}, stack {found.stack}")
        assert sizes["flash"] <= (10_240 if "-DCALIB_GUARDED" in flags else 8192)
        assert sizes["ram"] + found.stack <= 310


def _with_integral(plain: Rig) -> Rig:
    control = rig("full").controller
    assert control is not None
    return plain.with_sections({"controller": control})


def test_a_moving_reference_is_that_of_the_set_points(tmp_path: Path) -> None:
    """calib_reference_point against the exact inverse kinematics that the set-points use."""
    ellipse, times = Ellipse(), np.linspace(0.0, 20.0, 400)
    wanted = ellipse.bellows_m(times, header().values["CALIB_BELLOWS_RADIUS_M"])
    pose = ellipse.pose(times)
    write(tmp_path, header())
    command, _ = avr(tmp_path, "-DCALIB_UNDISTORT=1", "-DCALIB_MOVING")
    ticks = _thesis_ticks([(float(x), float(y)) for x, y in pose[:, :2]])
    moved = run(command, ticks)
    again = run(
        avr(tmp_path, "-DCALIB_UNDISTORT=1")[0], [_with(t, q) for t, q in zip(ticks, wanted, strict=True)]
    )
    assert np.abs(moved.numbers - again.numbers)[:, 7:].max() < 0.01


def _with(tick: Inputs, q: np.ndarray) -> Inputs:
    return binary32(replace(tick, reference=(float(q[0]), float(q[1]))))


Processor = Callable[[Inputs], Sequence[float]]
"""Commands of both pumps for a tick's readings."""


def _host(process: Process) -> Processor:
    """A program on this machine, through its pipes."""

    def tick(given: Inputs) -> Sequence[float]:
        process.send(given)
        return process.receive().numbers[0, 7:].tolist()

    return tick


def _avr(command: list[str]) -> Processor:
    """The AVR in a simulator within this process."""
    program = Simulated(command)

    def tick(given: Inputs) -> Sequence[float]:
        program.record[:] = np.frombuffer(pack(given), dtype=np.uint8)
        program.tick()
        return program.result[28:36].view("<f4").tolist()

    return tick


def closed(processor: Processor, wanted: np.ndarray, mode: int) -> np.ndarray:
    """Lengths (n, 2) at the ticks of a loop that the processor closes; `wanted` (n, 2)."""
    record = Inputs(0.0, 0.0, 9.81, 0.0, 0.0, mode=mode)

    def law(k: int, seen: Seen) -> tuple[float, float]:
        nonlocal record
        u, v = seen.marker_px
        ax, ay, gz = seen.imu[-1] if seen.imu else (record.ax_mps2, record.ay_mps2, record.gz_radps)
        there, (first, second) = not math.isnan(u), wanted[k].tolist()
        if not there:
            u, v = record.u_px, record.v_px
        record = binary32(Inputs(u, v, ax, ay, gz, (first, second), there, True, mode))
        low, high = processor(record)
        return low, high

    machine = SimulatedRig()
    return simulate(machine, rig_at_rest(machine.plant, machine.pump), law, len(wanted), seed=5).states[:, :2]


def experiment(name: str) -> tuple[np.ndarray, int]:
    """References (n, 2) at the ticks, and the controller's mode."""
    times = np.arange(0.0, 20.0 if name == "ellipse" else 5.0, 1.0 / 60.0)
    if name == "ellipse":
        return Ellipse().bellows_m(times, SimulatedRig().plant.bellows_radius_m), MODE_POSITION
    return np.full((len(times), 2), 0.7), MODE_ORIENTATION


@pytest.mark.few(5)
@pytest.mark.parametrize("name", ["ellipse", "step"])
@pytest.mark.parametrize(
    ("where", "kind", "fused"),
    [("host", "nominal", False), ("avr", "nominal", False), ("avr", "twin", True)],
)
def test_the_loop_closed_by_the_processor_is_that_of_float64(
    tmp_path: Path, name: str, where: str, kind: str, fused: bool
) -> None:
    write(tmp_path, header(kind))
    switch = ["-DCALIB_FUSED=1"] if fused else []
    wanted, mode = experiment(name)
    reference = make_reference(header(kind).values, fused=fused)
    expected = closed(lambda given: reference.step(given).pwm, wanted, mode)
    if where == "avr":
        found = closed(_avr(avr(tmp_path, *switch)[0]), wanted, mode)
    else:
        with contextlib.closing(Process(host(tmp_path, *switch))) as process:
            found = closed(_host(process), wanted, mode)
    difference = np.abs(found - expected).max()
    print(f"{name} on {where}, {'fused' if fused else 'MM'}: lengths differ by {difference:.2g} m at most")
    assert difference < 1e-6
    # The loop did something.
    assert np.ptp(expected[:, 0]) > 0.005


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("kind", "flags", "most"),
    [
        ("full", (), 27_648),
        ("fused", ("-DCALIB_FUSED=1",), 27_648),
        ("full", ("-DCALIB_FUSED=1",), 28_160),
    ],
)
def test_the_sketch_fits(tmp_path: Path, kind: str, flags: tuple[str, ...], most: int) -> None:
    """Beside the bootloader of old Nanos are 30,720 bytes; 2.5 KiB of them are left to one's own lines."""
    built = sketch(tmp_path, "POSITION", *flags, made=header(kind))
    print(f"{kind} {' '.join(flags)}: {built.flash} bytes of {budget(most)}")
    assert built.flash <= budget(most)


@pytest.mark.parametrize(
    "flags",
    [(), ("-DCALIB_IMU_MPU6050=1", "-DCALIB_PIXY2_I2C=1", "-DCALIB_FUSED=1")],
    ids=["default", "others"],
)
def test_the_sketch_compiles_for_a_cortex_m4(tmp_path: Path, flags: tuple[str, ...]) -> None:
    """A Nano 33 BLE, with a stub of the Arduino API."""
    need("arm-none-eabi-g++")
    write(tmp_path, header("fused"))
    (tmp_path / "sketch.cpp").write_text(verbatim("calib_example.ino"))
    target = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-Os", "-std=gnu++14"]
    target += ["-DARDUINO=10819", "-DARDUINO_ARCH_NRF52840", "-DCALIB_I_KNOW=1", "-ffp-contract=off"]
    call = ["arm-none-eabi-g++", *target, "-Wall", "-Wextra", "-Wdouble-promotion", "-Werror", *flags]
    call += [f"-I{NATIVE / 'arduino'}", f"-I{tmp_path}", "-c", tmp_path / "sketch.cpp", "-o", tmp_path / "o"]
    done = subprocess.run([str(word) for word in call], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    symbols = subprocess.run(["arm-none-eabi-nm", tmp_path / "o"], capture_output=True, text=True, check=True)
    # Nothing computes in double precision.
    assert not re.search(r"__aeabi_[df]2|__aeabi_d", symbols.stdout), symbols.stdout
