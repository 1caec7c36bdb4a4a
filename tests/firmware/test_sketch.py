"""The example sketch: compiles for the board and, with a made-up bus, runs here; its stream is checked."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from firmware_build import NATIVE, need, write
from firmware_rigs import header

from calib.io.serial import Decoder
from calib.stages.firmware.check import check_frames
from calib.stages.firmware.header import verbatim


def _sketch(folder: Path) -> Path:
    write(folder, header())
    path = folder / "sketch.ino"
    path.write_text(verbatim("calib_example.ino"))
    return path


def test_it_compiles_for_the_board(tmp_path: Path) -> None:
    need("avr-gcc")
    flags = ["-mmcu=atmega328p", "-Os", "-DF_CPU=16000000UL", "-std=gnu++11", "-Wall", "-Wextra", "-Werror"]
    call = [
        "avr-g++",
        *flags,
        f"-I{NATIVE / 'arduino'}",
        "-x",
        "c++",
        "-c",
        _sketch(tmp_path),
        "-o",
        tmp_path / "o",
    ]
    done = subprocess.run([str(word) for word in call], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    sizes = subprocess.run(["avr-size", tmp_path / "o"], capture_output=True, text=True, check=True).stdout
    text, data, bss = map(int, sizes.splitlines()[1].split()[:3])
    print(f"sketch without the Arduino core: flash {text + data}, RAM {data + bss}")
    assert data + bss <= 300


@pytest.mark.parametrize("mode", ["OFF", "ORIENTATION", "POSITION"])
def test_what_it_sends_is_what_python_computes(tmp_path: Path, mode: str) -> None:
    need("g++")
    flags = ["-std=c++11", "-O1", "-ffp-contract=off", f"-DCALIB_EXAMPLE_MODE=CALIB_MODE_{mode}"]
    call = [
        "g++",
        *flags,
        f"-I{NATIVE / 'arduino'}",
        "-o",
        tmp_path / "board",
        "-x",
        "c++",
        _sketch(tmp_path),
    ]
    done = subprocess.run(
        [str(word) for word in [*call, NATIVE / "board.cpp"]], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    stream = subprocess.run([tmp_path / "board", "300"], capture_output=True, check=True).stdout
    decoder = Decoder()
    frames = list(decoder.feed(stream))
    assert (len(frames), decoder.skipped, decoder.damaged) == (300, 0, 0)
    assert frames[10].rate_mhz == 60000
    assert [not f.given.marker_seen for f in frames].count(True) == 6
    assert [k for k, f in enumerate(frames) if not f.given.imu_read] == list(range(70, 80))
    result = check_frames(header(), frames, "board")
    assert result.ticks == 300
    assert result.reasons == []
    assert result.worst["q_m"] < 2e-7
