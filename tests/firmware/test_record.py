"""`calib record --do` on a simulated board and rig: from bare to flashed, and pumps that stop."""

from __future__ import annotations

import json
import math
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from firmware_board import Board as SimulatedBoard
from firmware_board import serve
from firmware_build import Built, link, sketch
from firmware_rigs import header

from calib.core.errors import BadInputError
from calib.core.rig import Rig
from calib.io.experiments import (
    EXPERIMENTS,
    PROGRAMME,
    Board,
    Done,
    Experiment,
    _wait_for_release,
    experiment,
    perform,
)
from calib.io.logs import read_log
from calib.io.serial import ALIVE, CLEAR, GUARD_FAULT, GUARD_RUN, Decoder, Frame, ImuSample, setting
from calib.stages.firmware.header import make_header

SILENT_MS = 284.0
"""A lost computer stops the pumps within this: CALIB_LINK_SILENT_MS, up to a tick until a frame is read,
and up to one until the silence is seen; 273 ms at most of the moments tried. The manual says 300."""


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """The sketch for a rig of which nothing is known yet."""
    return sketch(tmp_path_factory.mktemp("bare"), "OFF", made=make_header(Rig(), "rig.yaml"))


def _do(
    simulated: SimulatedBoard,
    plan: Experiment,
    path: Path,
    level: float = 1.0,
    between: Callable[[], None] = lambda: None,
    waits_s: float = 0.0,
) -> tuple[Done, list[str]]:
    """Record an experiment, begun late; what was told. `between` runs with each line of the log."""
    words: list[str] = []

    def tell(said: str) -> None:
        words.append(said)
        simulated.hear(said)

    board = Board(simulated, "board")
    simulated.hear(plan.asks)
    simulated.run(waits_s)
    began_s = simulated.time_s
    with path.open("w") as stream:

        def write(text: str) -> None:
            stream.write(text)
            between()

        done = perform(board, plan, level, write, tell)
    # Nothing of what came before it began is in the log.
    assert simulated.time_s - began_s >= done.seconds
    return done, words


def test_steps_of_the_pumps_are_recorded_with_the_boards_own_times(bare: Built, tmp_path: Path) -> None:
    simulated, drives = SimulatedBoard(bare), []
    plan = replace(EXPERIMENTS["steps"], seconds=4.0)
    done, _ = _do(simulated, plan, tmp_path / "log.csv", 0.8, lambda: drives.append(simulated.duty))
    assert (done.lost, done.damaged, done.overruns) == (0, 0, 0)
    log = read_log(tmp_path / "log.csv")
    for name, rate_hz in (("ax_mps2", 100.0), ("gx_radps", 100.0), ("u_px", 60.0), ("pwm1", 60.0)):
        t = log.t_s[~np.isnan(log.columns[name])]
        assert len(t) / plan.seconds == pytest.approx(rate_hz, abs=2.0), name
        # Times of the board's clock: a tick delays a sample, and no period is made up.
        assert np.diff(t).max() < (0.05 if name == "u_px" else 1.7 / rate_hz), name
    pwm = log.columns["pwm1"]
    assert set(pwm[~np.isnan(pwm)]) == {0.0, round(0.8 * 250 * 0.55)} == {first for first, _ in drives}
    assert simulated.duty == (0, 0)


@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_no_sample_of_the_imu_comes_twice(bare: Built, tmp_path: Path, seed: int) -> None:
    """Whatever the sensor's clock is: it starts with 100 new rates a second, as many as are read."""
    simulated, drives = SimulatedBoard(bare, seed=seed), []
    plan = replace(EXPERIMENTS["static"], seconds=4.0)
    _do(simulated, plan, tmp_path / "log.csv", between=lambda: drives.append(simulated.duty), waits_s=1.0)
    # At rest, without commands, the pumps stay off.
    assert set(drives) == {(0, 0)}
    columns = read_log(tmp_path / "log.csv").columns
    rates = np.column_stack([columns[name] for name in ("gx_radps", "gy_radps", "gz_radps")])
    rates = rates[~np.isnan(rates[:, 0])]
    # Rounded to whole units, two readings in a hundred agree by chance.
    twice = float((np.diff(rates, axis=0) == 0.0).all(axis=1).mean())
    print(f"{twice:.1%} of {len(rates)} rates are those of the sample before")
    assert twice < 0.04


@pytest.mark.parametrize(
    "after_ms", [0.0, *(pytest.param(ms, marks=pytest.mark.slow) for ms in (4.0, 8.0, 12.0))]
)
def test_a_computer_that_is_cut_off_stops_the_pumps(bare: Built, tmp_path: Path, after_ms: float) -> None:
    simulated = SimulatedBoard(bare)

    def unplug() -> None:
        if simulated.time_s > 2.8 + 1e-3 * after_ms:
            simulated.cut = True
            raise ConnectionError

    with pytest.raises(ConnectionError):
        _do(simulated, EXPERIMENTS["ellipse"], tmp_path / "log.csv", between=unplug)
    assert min(simulated.duty) > 0
    simulated.run(1e-3 * SILENT_MS)
    assert simulated.duty == (0, 0)
    for _ in range(100):
        simulated.run(0.02)
        assert simulated.duty == (0, 0)


def test_the_guard_holds_open_loop_to_the_envelope(tmp_path: Path) -> None:
    narrow = Rig.of({"envelope": {"angle_rad": 0.08}}, "rig.yaml")
    board = sketch(tmp_path, "OFF", made=make_header(narrow, "rig.yaml"))
    simulated = SimulatedBoard(board)
    sides = replace(EXPERIMENTS["ellipse"], seconds=8.0)
    with pytest.raises(
        BadInputError, match=r"after .* s the guard stopped the pumps: the actuator was beyond"
    ):
        _do(simulated, sides, tmp_path / "log.csv")
    assert simulated.duty == (0, 0)
    # What came before stays readable, and tells why it ended.
    *_, state, fault, _ = (tmp_path / "log.csv").read_text().split("\n")[-2].split(",")
    assert (int(state), int(fault)) == (GUARD_FAULT, 16)


def test_a_command_beyond_the_envelope_drives_nothing(tmp_path: Path) -> None:
    low = Rig.of({"envelope": {"open_loop_pwm": 100.0, "open_loop_s": 1.0}}, "rig.yaml")
    simulated = SimulatedBoard(sketch(tmp_path, "OFF", made=make_header(low, "rig.yaml")))
    board = Board(simulated, "board")
    assert board.hello.open_high == 100
    board.pumps((101, 0))
    for _ in range(400):
        next(board.messages())
        assert simulated.duty == (0, 0)
    with pytest.raises(BadInputError, match="a pump was on for too long in open loop"):
        _do(simulated, replace(EXPERIMENTS["steps"], seconds=3.0), tmp_path / "log.csv")
    assert simulated.duty == (0, 0)
    # The last fault is told after a reset, until a person has looked.
    for kept in (21, 0):
        simulated.everything()
        simulated.reset()
        assert Board(simulated, "board").hello.kept == kept
        # The first may be taken for the rest of a frame that the full buffer of a board that starts has cut.
        simulated.write(CLEAR + CLEAR)
        simulated.run(0.1)


def test_without_a_computer_that_it_needs_nothing_begins(tmp_path: Path) -> None:
    simulated = SimulatedBoard(sketch(tmp_path, "POSITION", "-DCALIB_EXAMPLE_HEARTBEAT=1"), 25.0)
    for _ in range(40):
        simulated.run(0.04)
        assert simulated.duty == (0, 0)
    on, decoder, faults = [], Decoder(), set()
    for alive in (True, False, True):
        for _ in range(40):
            simulated.run(0.04)
            for one in decoder.feed(simulated.everything()):
                faults |= {one.guard.fault} if isinstance(one, Frame) and one.guard is not None else set()
            if alive:
                simulated.write(ALIVE)
            on.append(max(simulated.duty) > 0)
    # After half a second, and after a silence in between after a whole one: the one at first was no fault.
    assert all(on[25:40]) and not any(on[50:80]) and all(on[115:])
    assert faults == {0, 8}


@pytest.mark.slow
def test_a_computer_that_clears_every_fault_at_once_does_not_keep_a_pump_at_full_power(
    tmp_path: Path,
) -> None:
    simulated = SimulatedBoard(sketch(tmp_path, "OFF"), 30.0)
    on = []
    for _ in range(1000):
        simulated.write(CLEAR + setting(True, (255, 255)))
        simulated.run(0.02)
        on.append(max(simulated.duty) == 255)
    assert sum(on[:400]) > 100
    # 3 s of envelope.full_power_s once, then no longer than off.
    assert sum(on[500:]) <= 260


def test_a_board_that_restarts_ends_the_recording(bare: Built, tmp_path: Path) -> None:
    simulated, done = SimulatedBoard(bare), False

    def reset() -> None:
        nonlocal done
        if simulated.time_s > 3.5 and not done:
            done = True
            simulated.reset()

    with pytest.raises(BadInputError, match=r"the board restarted after 1\.\d s; record this again"):
        _do(simulated, EXPERIMENTS["ellipse"], tmp_path / "log.csv", between=reset)
    assert simulated.duty == (0, 0)
    assert len(read_log(tmp_path / "log.csv")) > 100


@pytest.mark.slow
def test_the_head_is_let_go_when_it_is_held_still_and_not_before(bare: Built, tmp_path: Path) -> None:
    simulated = SimulatedBoard(bare)
    done, words = _do(simulated, EXPERIMENTS["swing"], tmp_path / "log.csv")
    assert [word for word in words if "degrees" not in word or "pull" in word] == [
        "pull the head aside by 20 to 30 degrees, and hold it",
        "let go",
    ]
    log = read_log(tmp_path / "log.csv")
    spin = np.abs(log.columns["gz_radps"])
    # The log begins just before the head does.
    assert 0.0 < log.t_s[np.nanargmax(spin > 0.5)] < 0.2 and done.seconds >= 5.0


@pytest.mark.parametrize(("slow", "again"), [(1, 0), (20, 90)])
def test_a_head_that_is_slow_for_a_sample_is_let_go(slow: int, again: int) -> None:
    """One sample at the release is between still and gone; 0.2 s of them are a hand that slips."""
    now_s, words = 0.0, []

    def samples() -> Iterator[ImuSample]:
        nonlocal now_s
        for angle, rate, count in (
            (0.0, 0.0, 60), (0.4, 0.0, 90), (0.4, 0.3, slow), (0.4, 0.0, again), (0.4, 1.0, 1),
        ):  # fmt: skip
            for _ in range(count):
                now_s += 0.01
                force = (9.8 * math.cos(angle), 9.8 * math.sin(angle), 0.0)
                yield ImuSample(0, 0, force, (0.0, 0.0, rate))

    board = SimpleNamespace(name="board", port=SimpleNamespace(now_s=lambda: now_s), messages=samples)
    last = _wait_for_release(cast("Board", board), words.append)[-1]
    assert isinstance(last, ImuSample) and last.rate[2] == 1.0
    assert ("it moved slowly: hold it" in words) == (again > 0)


def _calib(*words: object, cwd: Path) -> str:
    call = [sys.executable, "-m", "calib", *map(str, words)]
    done = subprocess.run(call, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr + done.stdout
    return done.stdout


@pytest.mark.slow
def test_from_a_bare_board_to_a_flashed_header(tmp_path: Path, project_root: Path) -> None:
    """calib firmware, record --do all, run: what is flashed then holds the actuator where it should."""
    _calib("firmware", "-o", "bare", cwd=tmp_path)
    simulated = SimulatedBoard(link(tmp_path / "bare", tmp_path / "bare" / "bare.ino"))
    rig = tmp_path / "rig"
    (rig / "logs").mkdir(parents=True)
    for name in PROGRAMME:
        done, _ = _do(simulated, experiment(name), rig / "logs" / f"{name}.csv")
        print(f"{name}: {done.words}")
        assert done.lost == 0
    shutil.copytree(project_root / "images", rig / "images")
    answer = _calib("run", "rig", "-o", "result", cwd=tmp_path)
    print(answer)
    # Whether the replays' noise is well guessed is no matter of the recorder.
    assert (
        "can it be flashed? yes" in answer
        or "what the firmware uses is sound, but look at “States”" in answer
    )
    for flags in ((), ("-DCALIB_FUSED=1",)):
        made = link(
            tmp_path / "result" / "firmware",
            tmp_path / "result" / "firmware" / "firmware.ino",
            "-DCALIB_EXAMPLE_MODE=CALIB_MODE_POSITION",
            *flags,
        )
        flashed = SimulatedBoard(made)
        flashed.run(8.0)
        frames = [one for one in Decoder().feed(flashed.everything()) if isinstance(one, Frame)]
        last = frames[-1]
        assert last.guard is not None and last.guard.state == GUARD_RUN
        q = np.array(flashed.states[-1][:2])
        print(f"{flags}: lengths {1e3 * q} mm, wanted {1e3 * np.array(last.given.reference)} mm")
        assert np.abs(q - last.given.reference).max() < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_a_recorder_that_is_killed_stops_the_pumps(bare: Built, tmp_path: Path, how: signal.Signals) -> None:
    """The command itself, on a terminal of this machine."""
    simulated = SimulatedBoard(bare)
    process: subprocess.Popen[str] | None = None
    killed_s = off_s = None

    def start(name: str) -> None:
        nonlocal process
        call = [sys.executable, "-m", "calib", "record", name, "-o", "log.csv", "--do", "ellipse", "--yes"]
        process = subprocess.Popen(call, cwd=tmp_path, stderr=subprocess.PIPE, text=True)

    def ended() -> bool:
        nonlocal killed_s, off_s
        assert process is not None
        if killed_s is None and min(simulated.duty) > 0 and len(simulated.states) > 400:
            process.send_signal(how)
            killed_s = simulated.time_s
        if killed_s is not None and off_s is None and simulated.duty == (0, 0):
            off_s = simulated.time_s
        assert simulated.time_s < 60.0
        return off_s is not None and simulated.time_s > off_s + 2.0

    serve(simulated, ended, start)
    assert process is not None and killed_s is not None and off_s is not None
    words = process.communicate(timeout=30)[1]
    print(f"{how.name}: off {1e3 * (off_s - killed_s):.0f} ms after; it said:\n{words}")
    assert off_s - killed_s <= 1e-3 * SILENT_MS + 0.02
    assert simulated.duty == (0, 0)
    assert "ellipse, 20 s; hoses on" in words
    assert len(read_log(tmp_path / "log.csv")) > 100


@pytest.mark.slow
def test_a_recording_by_the_command(bare: Built, tmp_path: Path) -> None:
    simulated = SimulatedBoard(bare)
    process: subprocess.Popen[str] | None = None

    def start(name: str) -> None:
        nonlocal process
        words = ["-o", "log.csv", "--do", "steps", "--duration", "3s", "--level", "60", "--yes", "--json"]
        call = [sys.executable, "-m", "calib", "record", name, *words]
        process = subprocess.Popen(
            call, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    serve(simulated, lambda: process is not None and process.poll() is not None, start)
    assert process is not None
    out, words = process.communicate(timeout=30)
    assert process.returncode == 0, words
    told = json.loads(out)["record"]["logs"][0]
    assert told["log"] == "log.csv" and told["lost"] == 0 and told["imu"] > 250
    assert "BNO055, Pixy2 on SPI, constants" in words and "without a plane" in words


@pytest.mark.slow
def test_constants_of_a_whole_rig_record_as_well(tmp_path: Path) -> None:
    """With a plane the guard sees lengths too; ticks come again when samples are no more wanted."""
    simulated = SimulatedBoard(sketch(tmp_path, "OFF", made=header("twin")))
    done, _ = _do(simulated, replace(EXPERIMENTS["steps"], seconds=2.0), tmp_path / "log.csv", 0.6)
    assert done.imu > 190
    simulated.write(setting(False))
    simulated.run(0.5)
    assert any(isinstance(one, Frame) for one in Decoder().feed(simulated.everything()))
