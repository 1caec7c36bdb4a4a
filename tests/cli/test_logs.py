"""`calib convert, lowpass, record` from the command line: what they write, say and refuse."""

from __future__ import annotations

import json
import os
import pty
import threading
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bags import readings, write_bag
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from identifytrials import rig_file
from sentframes import encoded

from calib.core.files import hash_of
from calib.core.result import identity
from calib.core.rig import Rig
from calib.io.columns import MEASURED
from calib.io.logs import Log, read_log, write_log
from calib.io.serial import Frame
from calib.stages.firmware.conformance import make_reference
from calib.stages.firmware.header import Header, make_header
from calib.stages.firmware.vectors import vectors

from .conftest import Run


def test_a_bag_becomes_a_table(calib: Run, tmp_path: Path) -> None:
    bag, out = write_bag(tmp_path, "folder", readings(np.random.default_rng(0))), tmp_path / "log.csv"
    topics = tmp_path / "mine.yaml"
    topics.write_text("topics:\n  /imu/data: imu\n")
    ended = calib("convert", bag, "-o", out, "--topics", topics, "--json")
    assert ended.code == 0
    told = json.loads(ended.out)["convert"]
    assert told["rows"] == 100 and told["left_out"] == ["/marker", "/pwm"] and not told["truncated"]
    assert list(read_log(out).columns) == told["columns"] == list(MEASURED[2:8])
    assert "left out: /marker, /pwm" in calib("convert", bag, "-o", out, "--topics", topics).err


def test_what_other_verbs_refuse_is_told_where_it_is_converted(calib: Run, tmp_path: Path) -> None:
    log, out = tmp_path / "log.csv", tmp_path / "si.csv"
    log.write_text("t_s,gz_radps\n0.00,0.1\n0.01,1000\n0.02,0.1\n0.00,0.1\n0.01,0.1\n0.02")
    ended = calib("convert", log, "-o", out)
    assert ended.code == 0 and "the last line is cut short and left out" in ended.err
    assert "1 cells hold more than any sensor gives (gz_radps is 1000 in line 3)" in ended.err
    assert "line 5: the time goes back to 0 s; other verbs refuse that, where it" in ended.err
    assert ",1000\n" in out.read_text()


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_table_comes_back(
    calib: Run, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """CSV to Parquet and back gives the same bytes."""
    count = data.draw(st.integers(1, 8))
    names = data.draw(st.lists(st.sampled_from(MEASURED), unique=True, min_size=1, max_size=4))
    cell = st.one_of(st.just(float("nan")), st.floats(-1e6, 1e6, allow_subnormal=False))
    columns = {name: np.array(data.draw(st.lists(cell, min_size=count, max_size=count))) for name in names}
    t_s = np.cumsum(data.draw(st.lists(st.integers(0, 10**7), min_size=count, max_size=count))) * 1e-6
    folder = tmp_path_factory.mktemp("convert")
    first, table, last = folder / "a.csv", folder / "b.parquet", folder / "c.csv"
    write_log(first, Log("x", t_s, columns, np.arange(count)))
    assert calib("convert", first, "-o", table).code == 0
    assert calib("convert", table, "-o", last).code == 0
    assert first.read_bytes() == last.read_bytes()


@pytest.mark.parametrize(
    ("text", "name", "code", "words"),
    [
        ("t_s,gz_radps\n", "out.csv", 3, "has a header but no rows"),
        ("t_s,gz_radps\n0,1\n", "out.mcap", 2, "expected a name that ends in .csv or .parquet"),
        ("t_s,gz_radps\n0,x\n", "out.csv", 3, "line 2: gz_radps is 'x', expected a number"),
        (
            "t_s,lux,wind\n0,1,2\n",
            "out.csv",
            3,
            "no column that is known beside its time, found lux, wind; say",
        ),
        ("t gz ax\n0 1\n", "out.csv", 3, "line 2: has 2 cells, expected 3 as in the header"),
    ],
)
def test_what_cannot_be_converted(
    calib: Run, tmp_path: Path, text: str, name: str, code: int, words: str
) -> None:
    log = tmp_path / "log.csv"
    log.write_text(text)
    ended = calib("convert", log, "-o", tmp_path / name)
    assert ended.code == code and words in ended.err
    assert [item.name for item in tmp_path.iterdir()] == ["log.csv"]


def test_nothing_of_the_input_but_numbers_reaches_the_table(calib: Run, tmp_path: Path) -> None:
    """Names of columns and cells that a spreadsheet would take for formulas stay behind."""
    log, out = tmp_path / "log.csv", tmp_path / "out.csv"
    log.write_text('t_s,"=cmd|\' /C calc\'!A0",@SUM(A1),gz_radps,\t+1\n0,=1+1,-2,-0.5,"=HYPERLINK(1)"\n')
    assert calib("convert", log, "-o", out).code == 0
    assert out.read_text() == "t_s,gz_radps\n0.000000,-0.5\n"
    for cell in ("=1", "@1", "+1+1", "'1"):
        log.write_text(f"t_s,gz_radps\n0,{cell}\n")
        assert calib("convert", log, "-o", out).code == 3


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A minute at 60 Hz: slow motion, jitter, whole pixels."""
    t = np.arange(3600) / 60.0
    noise = np.random.default_rng(7).normal(size=(2, 3600))
    u = np.round(158 + 40 * np.sin(0.6 * t) + 0.4 * noise[0])
    v = np.round(100 + 10 * np.cos(0.6 * t) + 0.4 * noise[1])
    path = tmp_path_factory.mktemp("logs") / "log.csv"
    write_log(path, Log("log.csv", t, {"u_px": u, "v_px": v}, np.arange(3600)))
    return path


def test_a_suggestion_in_pixels_with_figures(calib: Run, tmp_path: Path, log: Path) -> None:
    ended = calib("lowpass", "--suggest", log, "--jitter", "0.1px", "--figures", "drawn", cwd=tmp_path)
    assert ended.code == 0, ended.err
    assert "least delay for a jitter of 0.1 px" in ended.out
    assert "taken" in ended.out
    section = Rig.load(tmp_path / "rig.yaml").lowpass
    assert section is not None and section.log is not None
    assert 0.09 < max(axis.jitter_after for axis in section.log.axes.values()) < 0.102
    assert {path.name for path in (tmp_path / "drawn").iterdir()} == {
        "lowpass_log.png",
        "lowpass_response.png",
    }
    provenance = Rig.load(tmp_path / "rig.yaml").provenance.inputs["lowpass"]
    assert provenance == {"log.csv": hash_of(log)}


def test_millimetres_with_a_plane(calib: Run, rig: Path, log: Path) -> None:
    ended = calib("lowpass", "--log", log, "--rig", rig)
    assert ended.code == 0, ended.err
    assert "log jitter in" in ended.out and "mm" in ended.out
    after = Rig.load(rig)
    assert after.camera is not None and after.plane is not None and after.lowpass is not None
    assert after.provenance.inputs["lowpass"] == {
        "camera": identity(after.camera),
        "log.csv": hash_of(log),
        "plane": identity(after.plane),
    }
    ended = calib("lowpass", "--suggest", log, "--jitter", "0.1px", "--rig", rig)
    assert ended.code == 2
    assert ended.sentence == "--jitter: '0.1px' does not fit positions in millimetres"
    assert Rig.load(rig).lowpass == after.lowpass


def test_a_poor_filter_is_written_and_says_so(calib: Run, tmp_path: Path) -> None:
    ended = calib("lowpass", "--cutoff", "0.01Hz", "--order", "2", cwd=tmp_path)
    assert ended.code == 1
    assert "verdict: poor" in ended.out
    section = Rig.load(tmp_path / "rig.yaml").lowpass
    assert section is not None and section.verdict.word == "poor"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--cutoff", "31Hz"), "the cut-off is 31 Hz at 60 samples/s"),
        (("--cutoff=-1Hz",), "--cutoff: '-1Hz' is not positive"),
        (("--order", "0"), "the order is 0, expected 1 to 8"),
        (("--suggest", "LOG", "--jitter", "0.1"), "--jitter: '0.1' has no unit"),
        (("--suggest", "LOG", "--jitter", "0.1mm"), "does not fit positions in pixels, without a plane"),
    ],
)
def test_words_that_do_not_fit(
    calib: Run, tmp_path: Path, log: Path, words: tuple[str, ...], sentence: str
) -> None:
    ended = calib("lowpass", *(log if word == "LOG" else word for word in words), cwd=tmp_path)
    assert ended.code == 2
    assert sentence in ended.sentence
    assert not (tmp_path / "rig.yaml").exists()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("t_s,ax_mps2\n0,1\n1,1\n", "log.csv: has no u_px and v_px, expected u_px"),
        ("t_s,u_px,v_px\n1,1,1\n0,1,1\n", "log.csv, line 3: t_s goes back"),
        ("t_s,u_px,v_px\n0,1,1\n0.1,1,1\n", "log.csv: has 10 camera samples/s, expected the 60 Hz"),
        ("t_s,u_px,v_px\n", "log.csv: has a header but no rows"),
    ],
)
def test_logs_that_cannot_be_used(calib: Run, tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "log.csv").write_text(text)
    asked = ("--jitter", "0.1px", "--rate", "60Hz")
    ended = calib("lowpass", "--suggest", "log.csv", *asked, cwd=tmp_path)
    assert ended.code == 3
    assert sentence in ended.sentence
    assert not (tmp_path / "rig.yaml").exists()


serial = pytest.importorskip("serial")


def _stream(header: Header, ticks: int = 90) -> bytes:
    identity, out = header.identity, b"\x00\xa5\x5a\x4ehalf a frame"
    reference = make_reference(header.values)
    for k, vector in enumerate(vectors(header.values, ticks)):
        # As a sketch of before, without the picture's age.
        inputs = replace(vector.given, late_ticks=0.0)
        out += encoded(Frame(identity, 60000, k, inputs, reference.step(inputs)))
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
    header = make_header(Rig.load(rig), "rig.yaml")
    log = tmp_path / "log.csv"
    ended = calib("record", board(_stream(header)), "-o", log, "--ticks", "90", "--duration", "30s", "--json")
    assert ended.code == 0, ended.err
    told = json.loads(ended.out)["record"]
    assert told["logs"] == [{"log": str(log), "ticks": 90, "lost": 0}]
    assert told["restarts"] == 0
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
    header = make_header(Rig.load(rig), "rig.yaml")
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


def test_a_port_that_another_program_reads(calib, tmp_path: Path) -> None:
    ends = pty.openpty()
    with serial.Serial(os.ttyname(ends[1]), exclusive=True):
        ended = calib("record", os.ttyname(ends[1]), "-o", tmp_path / "log.csv", "--duration", "1s")
    for end in ends:
        os.close(end)
    assert ended.code == 3 and "cannot be opened: another program has it open" in ended.sentence


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_is_named(calib, rig: Path, board) -> None:
    port = board(_stream(make_header(Rig.load(rig), "rig.yaml"), 300))
    ended = calib("record", port, "-o", "/dev/full", "--duration", "4s")
    assert ended.code == 3 and ended.sentence.endswith(
        "/dev/full: cannot be written: No space left on device"
    )


def test_a_board_that_falls_silent(calib, rig: Path, tmp_path: Path, board, monkeypatch) -> None:
    monkeypatch.setattr("calib.cli.record._FELL_SILENT_S", 0.3)
    log, port = tmp_path / "log.csv", board(_stream(make_header(Rig.load(rig), "rig.yaml"), 30))
    ended = calib("record", port, "-o", log, "--duration", "20s")
    assert ended.code == 3 and "the board fell silent after" in ended.sentence
    assert len(read_log(log)) == 30


def test_a_port_that_is_not_there(calib, tmp_path: Path) -> None:
    ended = calib("record", tmp_path / "ttyNone", "-o", tmp_path / "log.csv")
    assert ended.code == 3
    assert "ttyNone: cannot be opened" in ended.sentence
    # An empty log is that of an experiment that was ended before its first sample.
    logs = tmp_path / "rig" / "logs"
    logs.mkdir(parents=True)
    (logs / "static1.csv").touch()
    ended = calib("record", tmp_path / "ttyNone", "-o", tmp_path / "rig", "--do", "all")
    assert "ttyNone: cannot be opened" in ended.sentence
    (logs / "static1.csv").write_text("t_s,u_px,v_px\n3.5,1,1\n")
    ended = calib("record", tmp_path / "ttyNone", "-o", tmp_path / "rig", "--do", "all")
    assert "static1.csv: has 3.5 s, expected 60 s: a recording that was cut" in ended.sentence
    port = tmp_path / "bytes.bin"
    port.write_bytes(b"\xa5\x5a")
    ended = calib("record", port, "-o", tmp_path / "log.csv")
    assert ended.code == 3
    assert "bytes.bin: is a file, expected a serial port such as /dev/ttyUSB0" in ended.sentence


@pytest.mark.parametrize("words", [(), ("--do", "steps", "--yes")])
def test_one_recording_is_a_csv(calib: Run, tmp_path: Path, words: tuple[str, ...]) -> None:
    for name in ("rig", "log.parquet"):
        ended = calib("record", tmp_path / "ttyNone", "-o", tmp_path / name, *words)
        assert ended.code == 2 and f"{name}: expected a name that ends in .csv" in ended.err
    assert list(tmp_path.iterdir()) == []


def test_two_logs_become_one(calib: Run, tmp_path: Path) -> None:
    (tmp_path / "track.csv").write_text(
        "t_s,u_px,v_px,sigma_px,note\n0.005,1,2,0.1,\n0.02,3,4,0.1,\n9,5,6,0.1,\n"
    )
    (tmp_path / "board.csv").write_text("t_s,gz_radps,pwm1,pwm2\n0,0.1,0,0\n0.01,0.2,,\n0.02,0.3,9,9\n")
    words = ("join", "track.csv", "board.csv", "--same-clock", "-o")
    ended = calib(*words, "log.csv", cwd=tmp_path)
    assert ended.code == 0 and "track.csv outside the time of board.csv, which are left out: 1" in ended.err
    assert (tmp_path / "log.csv").read_text() == (
        "t_s,u_px,v_px,gz_radps,pwm1,pwm2\n0.000000,,,0.1,0,0\n0.005000,1,2,,,\n"
        "0.010000,,,0.2,,\n0.020000,3,4,,,\n0.020000,,,0.3,9,9\n"
    )
    for target, code, words_of in (("board.csv", 3, "is an input"), ("log.txt", 2, "")):
        ended = calib(*words, target, cwd=tmp_path)
        assert ended.code == code and words_of in ended.err
    ended = calib(*words, "both.csv", "--offset", "1", cwd=tmp_path)
    assert ended.code == 2 and "--offset: does not go with --same-clock" in ended.err
    offset = ("join", "track.csv", "board.csv", "--offset=-8.99", "-o", "moved.csv")
    assert calib(*offset, cwd=tmp_path).code == 0
    assert "0.010000,5,6,,," in (tmp_path / "moved.csv").read_text()
    ended = calib("join", "track.csv", "board.csv", "-o", "other.csv", cwd=tmp_path)
    assert ended.code == 3 and "do not tell one offset" in ended.err
    assert "track.csv: not read: note\n" in ended.err
    assert not (tmp_path / "other.csv").exists()
    text = "time,seconds_elapsed,z,y,x\n" + "".join(
        f"{10**18},{0.01 * k:.2f},0,9.8,{k % 3}\n" for k in range(30)
    )
    (tmp_path / "TotalAcceleration.csv").write_text(text)
    (tmp_path / "Gyroscope.csv").write_text(text.replace("9.8", "0.1"))
    phone = ("join", "TotalAcceleration.csv", "Gyroscope.csv", "--same-clock", "-o", "phone.csv")
    ended = calib(*phone, cwd=tmp_path)
    assert ended.code == 3 and "give --gyro-unit" in ended.err
    ended = calib(*phone, "--gyro-unit", "rad/s", cwd=tmp_path)
    assert ended.code == 0 and "Gyroscope.csv: read as: time in s from" in ended.err, ended.err
    assert len(read_log(tmp_path / "phone.csv").sampled("ay_mps2")) == 30
    assert len(read_log(tmp_path / "phone.csv").sampled("gx_radps", "gy_radps", "gz_radps")) == 30
    again = ("join", "Gyroscope.csv", "phone.csv", "--same-clock", "-o", "again.csv")
    ended = calib(*again, "--gyro-unit", "rad/s", cwd=tmp_path)
    assert ended.code == 3 and "Gyroscope.csv: has no column that phone.csv has not" in ended.err
    rig_file(tmp_path / "rig.yaml")
    (tmp_path / "track.csv").write_text("t_s,u_px,v_px\n0.005,400,2\n0.02,401,4\n0.03,402,4\n")
    ended = calib(*words, "outside.csv", cwd=tmp_path)
    assert ended.code == 3 and "outside the picture of 316x208 px" in ended.err
