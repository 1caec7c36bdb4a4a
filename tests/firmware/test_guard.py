"""The guard: every fault stops the pumps in its time, on the real instruction set and Arduino core."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from firmware_board import Board
from firmware_build import Built, host, run, selftest, sketch, warnings, write
from firmware_rigs import header, rig

from calib.core.rig import Rig
from calib.io.serial import FAULTS as FAULT_WORDS
from calib.io.serial import GUARD_FAULT, GUARD_RUN, MODE_POSITION, Decoder, Frame, Inputs
from calib.stages.firmware.check import check_frames
from calib.stages.firmware.conformance import binary32
from calib.stages.firmware.header import make_header, verbatim
from calib.stages.firmware.vectors import coherent
from calib.twin.pictures import CAMERA, PLANE

IMU_LOST, IMU_FROZEN, CAMERA_LOST, CAMERA_FROZEN, APART, REFERENCE = range(1, 7)
LATE, HOST, REACH, RATE, FULL_POWER, SELFTEST, WATCHDOG = 7, 8, 16, 17, 18, 19, 20
AT_MS, UNTIL_MS, END_MS = 3800.0, 5300.0, 8300.0


@dataclass(frozen=True)
class Ended:
    """A run of the board.

    Attributes
    ----------
    on_before_ms, on_during_ms : with a pump on before the fault, and from 400 ms after its beginning.
    off_after_ms : when both were off for good, -1 for never. runs : whether a pump is on at the end.
    """

    on_before_ms: float
    on_during_ms: float
    off_after_ms: float
    runs: bool
    frames: list[Frame]

    @property
    def faults(self) -> set[int]:
        """That were told."""
        return {f.guard.fault for f in self.frames if f.guard is not None} - {0}


def _marker(length_m: float) -> list[str]:
    R, t = np.array(PLANE.R_CW), np.array(PLANE.t_m)
    seen = CAMERA.K @ (R[:, :2] @ np.array([0.0, length_m + 0.015]) + t)
    return [f"{value:.2f}" for value in seen[:2] / seen[2]]


def marker_places() -> list[str]:
    """Pixels of the marker at the rest length and 40 mm beyond, as the simulated rig wants them."""
    return [*_marker(0.065), *_marker(0.105)]


def _frames(stream: bytes) -> list[Frame]:
    return [message for message in Decoder().feed(stream) if isinstance(message, Frame)]


def _run(
    board: Built, fault: str, at_ms: float = AT_MS, until_ms: float = UNTIL_MS, end_ms: float = END_MS
) -> Ended:
    times = [f"{value:.3f}" for value in (at_ms, until_ms, end_ms)]
    done = subprocess.run([*board.command, fault, *times, *marker_places()], capture_output=True, check=True)
    found = re.search(rb"result (\S+) (\S+) (\S+) (\d)", done.stderr)
    assert found is not None
    before, during, after = (float(value) for value in found.groups()[:3])
    return Ended(before, during, after, found.group(4) == b"1", _frames(done.stdout))


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """The sketch in position mode, in the simulator."""
    return sketch(tmp_path_factory.mktemp("board"), "POSITION")


FAULTS: dict[str, tuple[int | None, bool, int | None]] = {
    # fault: ms until the pumps are off, None for one to be borne; whether it works again; what the guard says
    "bus_hang": (230, True, IMU_LOST),
    "imu_nack": (230, True, IMU_LOST),
    "imu_slow": (230, True, IMU_LOST),
    # Weightless for as long as it stands still, which is told a tick sooner.
    "imu_zero": (230, True, IMU_LOST),
    "imu_frozen": (230, True, IMU_FROZEN),
    "imu_page": (230, True, IMU_FROZEN),
    "rate_frozen": (1300, True, IMU_FROZEN),
    "force_frozen": (1300, True, IMU_FROZEN),
    "imu_saturated": (230, True, IMU_LOST),
    "imu_garbage": (300, True, IMU_LOST),
    "imu_brown_out": (230, True, IMU_LOST),
    "imu_tilted": (700, True, APART),
    "gyro_biased": (700, True, APART),
    "blob_lost": (280, True, CAMERA_LOST),
    "blob_elsewhere": (600, True, APART),
    "many_blobs": (280, True, CAMERA_LOST),
    "bad_checksum": (280, True, CAMERA_LOST),
    "pixy_error": (280, True, CAMERA_LOST),
    "pixy_nack": (280, True, CAMERA_LOST),
    "pixy_garbage": (280, True, CAMERA_LOST),
    "camera_slow": (280, True, CAMERA_LOST),
    "marker_frozen": (400, True, CAMERA_FROZEN),
    "beyond_reach": (200, False, REACH),
    "reset": (1, True, None),
    "supply_reset": (1, True, None),
    "none": (None, True, None),
    "serial_garbage": (None, True, None),
    "pixy_shifted": (None, True, None),
    "stop_hang": (None, True, None),
}
"""Times follow from the table at the head of calib_guard.h: ticks in a row, and two for the loop."""


def at_many_moments(
    board: Built, moments: int, step_ms: float, faults: Sequence[str]
) -> Iterator[tuple[str, list[float], bool]]:
    """Each fault with the times until both pumps are off [ms], -1 for never, and whether it works again.

    The board goes on from the same moments with each fault; its clock begins anew in the middle of them.
    """
    names = subprocess.run(["avr-nm", board.program], capture_output=True, text=True, check=True).stdout
    overflows, millis = (
        re.search(rf"^\w*(\w{{4}}) \w timer0_{name}$", names, re.M) for name in ("overflow_count", "millis")
    )
    assert overflows is not None and millis is not None
    clock = f"CLOCK@{overflows.group(1)}:{millis.group(1)}"
    words = [clock, f"{AT_MS}", f"{step_ms}", f"{moments}", *marker_places(), *faults]
    done = subprocess.run([*board.command, *words], capture_output=True, text=True, check=True)
    head, *lines = map(str.split, done.stdout.splitlines())
    assert float(head[1]) > 300.0, "the pumps did not run before"
    for fault in faults:
        rows = [line for line in lines if line[0] == fault]
        assert len(rows) == moments
        yield fault, [float(row[2]) for row in rows], rows[0][3] == "1"


def kept(fault: str, off_ms: list[float], again: bool) -> bool:
    """Whether a fault went as it has to."""
    within_ms, works, _ = FAULTS[fault]
    in_time = (after < 0.0 if within_ms is None else 0.0 <= after <= within_ms for after in off_ms)
    return all(in_time) and again == works


def test_without_a_fault_it_starts_and_runs(board: Built) -> None:
    ended = _run(board, "none", 3800.0, 3800.0, 4800.0)
    assert ended.runs and ended.on_before_ms > 500.0
    assert not ended.faults
    # Frames say what drove the pumps, which stood still until the sensors had been sound.
    driven = [f.guard.duty for f in ended.frames if f.guard is not None and f.guard.state == GUARD_RUN]
    assert driven and max(map(max, driven)) > 50
    still = [f.guard.duty for f in ended.frames if f.guard is not None and f.guard.state != GUARD_RUN]
    assert len(still) > 30 and set(still) == {(0, 0)}
    # And what was computed is what Python computes.
    result = check_frames(header(), ended.frames, "board")
    assert result.verdict.ok and result.ticks > 200 and result.worst["q_m"] < 2e-7


@pytest.mark.slow
def test_a_camera_with_nearly_the_ticks_rate_is_not_lost(board: Built) -> None:
    """Pictures come with the ticks: for three seconds each third tick has none. The limit is a fifth."""
    simulated = Board(board, frame_hz=60.1)
    simulated.run(8.0)
    frames = [one for one in Decoder().feed(simulated.everything()) if isinstance(one, Frame)]
    missing = np.convolve([not one.given.marker_seen for one in frames], np.ones(120), "valid")
    assert missing.max() > 36
    states = [one.guard.state for one in frames if one.guard is not None]
    assert set(states[states.index(GUARD_RUN) :]) == {GUARD_RUN}


@pytest.mark.few(0)
@pytest.mark.parametrize("fault", ["bus_hang", "marker_frozen", "beyond_reach"])
def test_a_fault_stops_the_pumps(board: Built, fault: str) -> None:
    ended = _run(board, fault)
    assert ended.on_before_ms > 300.0
    assert kept(fault, [ended.off_after_ms], ended.runs)
    assert FAULTS[fault][2] in ended.faults


@pytest.mark.few(0)
@pytest.mark.parametrize("fault", ["bus_hang", "stop_hang"])
def test_the_watchdog_ends_what_has_no_time_out(tmp_path: Path, fault: str) -> None:
    """At a stop the bus' own interrupt waits, where the watchdog's does not come: the next one resets."""
    ended = _run(sketch(tmp_path, "POSITION", "-DCALIB_I2C_LIMIT_US=0"), fault)
    assert ended.on_before_ms > 300.0
    assert 0.0 <= ended.off_after_ms <= 150.0 and ended.runs
    if fault == "bus_hang":
        assert ended.frames[-1].guard is not None and ended.frames[-1].guard.kept == WATCHDOG


@pytest.mark.slow
def test_a_fault_at_any_time_stops_the_pumps(board: Built) -> None:
    """At moments spread over five ticks, so that the bus is cut at different bytes."""
    for fault, off_ms, again in at_many_moments(board, 12, 7.3, list(FAULTS)):
        print(f"{fault}: {min(off_ms):.0f} to {max(off_ms):.0f} ms, {'works' if again else 'stands'} again")
        assert kept(fault, off_ms, again), fault


@pytest.mark.slow
def test_a_bus_that_hangs_from_the_start_keeps_the_pumps_off(board: Built) -> None:
    ended = _run(board, "bus_hang", 0.0, 2000.0, 5500.0)
    assert ended.off_after_ms == pytest.approx(0.0, abs=1.0)
    assert ended.runs


def test_a_sensor_that_is_deaf_at_first_is_started_later(board: Built) -> None:
    ended = _run(board, "deaf_start", 5000.0, 5000.0, 5000.0)
    assert ended.runs


def test_another_chip_is_not_believed(board: Built) -> None:
    ended = _run(board, "wrong_id", 0.0, 4000.0, 4000.0)
    assert not ended.runs and ended.on_during_ms == 0.0


@pytest.mark.slow
def test_a_pump_at_full_power_without_effect_is_stopped(board: Built) -> None:
    ended = _run(board, "stuck", 0.0, 7500.0, 7500.0)
    assert not ended.runs and ended.faults == {FULL_POWER}
    assert ended.on_during_ms <= 3100.0
    assert ended.frames[-1].guard is not None and ended.frames[-1].guard.state == GUARD_FAULT


def test_every_fault_is_tried_by_the_self_test_in_all_builds(tmp_path: Path) -> None:
    write(tmp_path, header("fused"))
    for compiler, standard in (("gcc", "c99"), ("clang", "c99"), ("g++", "c++11")):
        for fused in (0, 1):
            flags = [*warnings, f"-std={standard}", "-O2", f"-DCALIB_FUSED={fused}"]
            assert selftest(tmp_path, "guard", *flags, compiler=compiler)


@pytest.mark.parametrize(
    ("envelope", "high_pwm"),
    [
        (
            {
                "angle_rad": 0.01,
                "apart_m": 0.0005,
                "rate_mps": 0.01,
                "full_power_s": 0.01,
                "open_loop_s": 0.01,
            },
            255,
        ),
        ({"angle_rad": 0.08, "open_loop_pwm": 1.0}, 100),
        (
            {"angle_rad": 1.5, "apart_m": 0.5, "rate_mps": 10.0, "full_power_s": 600.0, "open_loop_s": 600.0},
            2,
        ),
    ],
)
def test_the_self_test_passes_in_any_envelope(
    tmp_path: Path, envelope: dict[str, float], high_pwm: int
) -> None:
    tuned = rig("full").controller
    assert tuned is not None
    whole = Rig.of({"envelope": envelope}, "rig.yaml").with_sections(
        {"controller": tuned.model_copy(update={"pwm_low": 0.0, "pwm_high": float(high_pwm)})}
    )
    made_of = make_header(whole, "rig.yaml")
    assert made_of.values["CALIB_ENVELOPE_OPEN_HIGH"] <= made_of.values["CALIB_PUMP_HIGH"] == high_pwm
    write(tmp_path, made_of)
    assert selftest(tmp_path, "guard")


def test_a_slow_pump_may_fill_its_bellows_at_full_power() -> None:
    def full_s(sections: dict[str, dict[str, object]]) -> float:
        made = make_header(Rig.of(sections, "rig.yaml"), "rig.yaml").values
        return made["CALIB_ENVELOPE_FULL_TICKS"] / made["CALIB_TICK_RATE_HZ"]

    slow, fast = ({"pump": {"verdict": "ok", "lag_s": lag_s}} for lag_s in (2.0, 0.7))
    assert (full_s({"envelope": {}}), full_s(fast)) == (3.0, 3.0)
    # Four lags: the force is 2 % from where it settles.
    assert full_s(slow) == 8.0
    assert full_s({**slow, "envelope": {"full_power_s": 1.0}}) == 1.0


@pytest.mark.parametrize("aside_px", [0.0, 15.0, -30.0])
def test_the_fused_angle_does_not_follow_another_thing_for_long(tmp_path: Path, aside_px: float) -> None:
    """It followed it for 12 s, and the marker agreed with that angle: lengths were 20 mm off."""
    write(tmp_path, header("fused"))
    command = host(tmp_path, "-DCALIB_FUSED=1", "-DCALIB_GUARDED=1")
    rested = coherent(header("fused").values, 480, lateness=lambda _: 0.0)[-1]
    # A little longer, so that pumps run below full power.
    still = replace(rested, reference=(0.0693, 0.0693), mode=MODE_POSITION)

    def at(k: int) -> Inputs:
        shaken = 0.02 * (-1) ** k * (1 + k % 5)
        u = still.u_px + 0.1 * (k % 3) + (aside_px if k >= 300 else 0.0)
        return binary32(
            replace(still, u_px=u, ax_mps2=still.ax_mps2 + shaken, gz_radps=still.gz_radps + 0.01 * shaken)
        )

    duty = run(command, [at(k) for k in range(480)]).duty
    assert duty[290].any()
    # Eighty ticks, and none runs on.
    assert duty[380:].any() == (aside_px == 0.0)


def test_a_swing_before_a_slow_camera_is_no_other_thing(tmp_path: Path) -> None:
    """Pictures are eight ticks late; the marker is where the angle was."""
    whole = rig("fused")
    assert whole.align is not None
    late = whole.align.model_copy(update={"time_offset_s": 8.0 / 60.0})
    made = make_header(whole.with_sections({"align": late}), "rig.yaml")
    write(tmp_path, made)
    ticks = coherent(made.values, 480, lateness=lambda _: 0.0)
    given = [binary32(replace(one, reference=(0.07, 0.07), mode=MODE_POSITION)) for one in ticks]
    duty = run(host(tmp_path, "-DCALIB_GUARDED=1"), given).duty
    assert duty[60:130].any(axis=1).mean() > 0.9


def test_a_log_knows_every_fault_of_the_guard() -> None:
    names = re.findall(r"#define CALIB_FAULT_(\w+) (\d+)", verbatim("calib_guard.h"))
    numbers = {int(number) for name, number in names if name not in ("NONE", "STAYS")}
    assert numbers == set(FAULT_WORDS)


_MUTANTS = [
    ("guard->imu_bad >= CALIB_GUARD_IMU_BAD", "0"),
    ("if (calib_guard_frozen(guard)) {", "if (0) {"),
    (
        "guard->fault >= CALIB_FAULT_STAYS || fault == CALIB_FAULT_REFERENCE",
        "guard->fault >= CALIB_FAULT_STAYS",
    ),
    ("guard->camera_bad >= CALIB_GUARD_CAMERA_BAD", "0"),
    ("guard->frozen >= CALIB_GUARD_FROZEN)", "0)"),
    ("guard->apart >= CALIB_GUARD_APART", "0"),
    ("guard->reach >= CALIB_GUARD_REACH", "0"),
    ("guard->rate >= CALIB_GUARD_RATE", "0"),
    (">= CALIB_ENVELOPE_FULL_TICKS", ">= 65535u"),
    ("calib_guard_fault(guard, fault);", "(void)fault;"),
    ("out->duty[0] = 0;", ""),
    ("out->duty[0] = 0;", "out->duty[0] = 255;"),
    ("guard->state = CALIB_FAULT;\n", "\n"),
    ("guard->quiet >= CALIB_GUARD_QUIET_TICKS)", "1)"),
    ("calib_guard_length(reference[0]) && calib_guard_length(reference[1])", "1"),
    ("#define CALIB_GUARD_SAME 12", "#define CALIB_GUARD_SAME 200"),
    ("#define CALIB_GUARD_IMU_BAD (12 *", "#define CALIB_GUARD_IMU_BAD (60 *"),
]


@pytest.mark.parametrize("at", range(len(_MUTANTS)))
def test_a_guard_that_is_broken_fails_its_self_test(tmp_path: Path, at: int) -> None:
    write(tmp_path, header())
    path, (before, after) = tmp_path / "calib_guard.h", _MUTANTS[at]
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after, 1))
    assert not selftest(tmp_path, "guard")
