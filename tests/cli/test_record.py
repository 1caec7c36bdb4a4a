"""`calib record` over a pseudo-terminal, and the log that it writes checked by `calib firmware --check`."""

from __future__ import annotations

import json
import os
import pty
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from calib.core.rig import read_rig
from calib.io.logs import read_log
from calib.io.serial import Frame, encoded
from calib.stages.firmware.header import Header, header_of, identity_of
from calib.stages.firmware.vectors import vectors

serial = pytest.importorskip("serial")


def _stream(header: Header, ticks: int = 90) -> bytes:
    identity, out = int(identity_of(header)[:8], 16), b"\x00\xa5\x5a\x4ehalf a frame"
    for k, vector in enumerate(vectors(header, ticks)):
        w = vector.wanted
        frame = Frame(
            identity, 60000, k, vector.given, w.phi_rad, w.marker_m, w.head_m, w.q_m, w.pwm, w.flags
        )
        out += encoded(frame)
        if k % 20 == 10:
            out += b"\xa5\xa5\x5a\xff noise"
    return out


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[bytes], str]]:
    """A pseudo-terminal whose other end sends a stream in portions, once it has been opened; its name."""
    opened = threading.Event()

    class Port(serial.Serial):
        def __init__(self, *words: object, **more: object) -> None:
            super().__init__(*words, **more)
            opened.set()

    monkeypatch.setattr(serial, "Serial", Port)
    ends: list[int] = []
    threads: list[threading.Thread] = []

    def plug(stream: bytes) -> str:
        master, slave = pty.openpty()
        tty.setraw(slave)
        ends.extend((master, slave))

        def send() -> None:
            # Opening a port throws away what came before.
            opened.wait(30.0)
            left = stream
            while left:
                # A terminal may take a part only.
                left = left[os.write(master, left[:200]) :]
                time.sleep(0.002)

        threads.append(threading.Thread(target=send, daemon=True))
        threads[-1].start()
        return os.ttyname(slave)

    yield plug
    for thread in threads:
        thread.join(5.0)
    for end in ends:
        os.close(end)


def test_a_board_is_recorded_and_checked(calib, rig: Path, tmp_path: Path, board) -> None:
    header = header_of(read_rig(rig), "rig.yaml")
    log = tmp_path / "log.csv"
    ended = calib("record", board(_stream(header)), "-o", log, "--ticks", "90", "--duration", "30s", "--json")
    assert ended.code == 0, ended.err
    told = json.loads(ended.out)["record"]
    assert (told["ticks"], told["lost"], told["restarts"]) == (90, 0, 0)
    assert told["bytes_skipped"] > 0
    # A log like any other.
    known = read_log(log)
    assert len(known) == 90
    assert {"u_px", "ax_mps2", "gz_radps", "pwm1"} <= set(known.columns)
    ended = calib("firmware", "--check", log, "--rig", rig)
    assert ended.code == 0, ended.err
    assert "90 ticks compared" in ended.out
    assert "verdict: ok" in ended.out


def test_a_board_that_computes_something_else_fails(calib, rig: Path, tmp_path: Path, board) -> None:
    header = header_of(read_rig(rig), "rig.yaml")
    log = tmp_path / "log.csv"
    assert calib("record", board(_stream(header)), "-o", log, "--ticks", "90", "--duration", "30s").code == 0
    lines = log.read_text().splitlines()
    names = lines[0].split(",")
    cells = lines[20].split(",")
    cells[names.index("board_q1_m")] = "0.1"
    lines[20] = ",".join(cells)
    log.write_text("\n".join(lines) + "\n")
    ended = calib("firmware", "--check", log, "--rig", rig, "--json")
    assert ended.code == 1
    assert json.loads(ended.out)["check"]["gate"] == ["tick 19 is the first that differs, in q_m"]


def test_a_port_that_is_not_there(calib, tmp_path: Path) -> None:
    ended = calib("record", tmp_path / "ttyNone", "-o", tmp_path / "log.csv")
    assert ended.code == 3
    assert "ttyNone: cannot be opened" in ended.sentence


def test_a_port_that_says_nothing_of_use(calib, tmp_path: Path, board) -> None:
    ended = calib("record", board(b"hello " * 100), "-o", tmp_path / "log.csv", "--duration", "0.5s")
    assert ended.code == 3
    assert "no frame came, expected the example sketch at 115200 baud" in ended.sentence
    assert not (tmp_path / "log.csv").exists()
