"""Text as other programs write it: byte-order marks, line ends of Windows, other encodings, zero bytes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from sentframes import encoded

from calib.cli.camera import import_camera
from calib.core.errors import BadInputError
from calib.core.rig import Rig
from calib.io.logs import log_text, read_log
from calib.io.serial import frame_from_row, record
from calib.stages.actuator.read import read_pump_table
from calib.stages.camera.read import read_board_file, read_table, read_vnl
from calib.stages.control.read import _series
from calib.stages.firmware.check import read_frames

RIG = "geometry: {workspace_m: [0.0, 0.0, 0.1, 0.1]}\ntwin: {tracker: {jitter_px: 0.1}}\n"
BOARD = "corners: [7, 5]\nsquare_m: 0.02\n"
LOG = "t_s,u_px,v_px,note\n0.0,1.5,2.5,x\n0.1,,,y\n0.2,2.5,3.5,z\n"
POINTS = "view,x_m,y_m,u_px,v_px\na,0,0,1,1\na,1,0,2,1\na,0,1,1,2\na,1,1,2,2\n"
CORNERS = "# filename x y level\n" + "".join(
    f"a.png {10 * x} {9 * y} 0\n" for y in range(3) for x in range(3)
)
PUMP = "time_s,pwm,pressure_kPa\n" + "".join(f"{0.02 * k:.2f},100,{0.1 * k:.1f}\n" for k in range(40))
REFERENCE = "t_s,q1_m,q2_m\n0.0,0.05,0.05\n0.1,0.06,0.05\n"
ROS = (
    "image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\n"
    "camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}\n"
    "distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
)


def _board_log() -> str:
    names = ("calib_id", "rate_mhz", "sequence", "marker_seen", "imu_read", "mode", "board_flags")
    row = dict.fromkeys(names, "1") | {"rate_mhz": "60000"}
    floats = ("board_u_px", "board_v_px", "reference_1", "reference_2", "board_phi_rad", "board_marker_x_m",
              "board_marker_y_m", "board_head_x_m", "board_head_y_m", "board_q1_m", "board_q2_m", "pwm1",
              "pwm2", "ax_mps2", "ay_mps2", "gz_radps")  # fmt: skip
    frame = frame_from_row(row | dict.fromkeys(floats, "0.5"))
    pieces = [encoded(frame), b""]
    written: list[str] = []
    record(lambda: pieces.pop(0), lambda _: bool(pieces), lambda run, text: written.append(text))
    return "".join(written)


def _imported(path: Path) -> str:
    rig = path.parent / "imported.yaml"
    rig.unlink(missing_ok=True)
    import_camera("ros", path, rig, True)
    camera = yaml.safe_load(rig.read_text())["camera"]
    return str(camera)


def _views(views: list) -> str:
    return repr([(view.name, view.target_m.tolist(), view.pixels.tolist()) for view in views])


def _table(path: Path) -> str:
    found = read_pump_table(path)
    return repr(np.asarray(found.record.value if hasattr(found.record, "value") else 0)) + str(found.said)


READERS: dict[str, tuple[str, str, Callable[[Path], str]]] = {
    "rig": ("rig.yaml", RIG, lambda path: repr(Rig.load(path))),
    "board": ("board.yaml", BOARD, lambda path: repr(read_board_file(path.parent))),
    "log": ("log.csv", LOG, lambda path: log_text(read_log(path))),
    "points": ("points.csv", POINTS, lambda path: _views(read_table(path))),
    "corners": ("corners.vnl", CORNERS, lambda path: _views(read_vnl(path, 3, 3, 0.02))),
    "pump": ("pump.csv", PUMP, _table),
    "reference": ("reference.csv", REFERENCE, lambda path: repr(_series(path))),
    "frames": ("board.csv", _board_log(), lambda path: repr(read_frames(path))),
    "camera": ("camera.yaml", ROS, _imported),
}

SAME = {
    "byte-order mark": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "both": lambda text: b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode(),
    "no last end": lambda text: text.rstrip("\n").encode(),
}

REFUSED = {
    "UTF-16": lambda text: text.encode("utf-16"),
    "zero bytes before": lambda text: b"\0\0" + text.encode(),
    "gzip": lambda _: b"\x1f\x8b\x08\0\0\0\0\0\0\x03" + bytes(range(256)),
}


@pytest.mark.parametrize("how", SAME)
@pytest.mark.parametrize("reader", READERS)
def test_it_reads_the_same(tmp_path: Path, reader: str, how: str) -> None:
    name, text, read = READERS[reader]
    path = tmp_path / name
    path.write_text(text)
    wanted = read(path)
    path.write_bytes(SAME[how](text))
    assert read(path) == wanted


@pytest.mark.few(0, 4, 8)
@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_logs_of_utf_16_and_of_any_line_ends(tmp_path: Path, encoding: str, end: str) -> None:
    path = tmp_path / "log.csv"
    text = LOG.replace(",", "\t") + "".join(f"{0.1 * k:.1f}\t{k}\t1\tµ°\n" for k in range(3, 20000))
    path.write_text(text)
    wanted = read_log(path)
    text = text.replace("\n", end)
    path.write_bytes((("" if encoding == "utf-16" else "\ufeff") + text).encode(encoding))
    assert log_text(read_log(path)) == log_text(wanted)
    path.write_bytes(text.encode())
    assert log_text(read_log(path)) == log_text(wanted)


def test_units_in_the_code_page_of_windows(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    text = "Time (s);ax (m/s²);ay (m/s²);gz (°/s)\n" + "0,5;9,8;0,1;1,5\n0,6;9,8;0,1;1,5\n"
    path.write_text(text, encoding="utf-8")
    wanted = read_log(path)
    path.write_text(text, encoding="cp1252")
    assert log_text(read_log(path)) == log_text(wanted)
    assert wanted.columns["gz_radps"][0] == pytest.approx(np.radians(1.5))


@pytest.mark.parametrize(
    ("reader", "how"),
    # Logs of UTF-16 are read.
    [(reader, how) for reader in READERS for how in REFUSED if (reader, how) != ("log", "UTF-16")],
)
def test_it_is_refused_in_one_sentence(tmp_path: Path, reader: str, how: str) -> None:
    name, text, read = READERS[reader]
    path = tmp_path / name
    path.write_bytes(REFUSED[how](text))
    with pytest.raises(BadInputError) as refused:
        read(path)
    assert str(refused.value).startswith(str(path))
    assert str(refused.value).isprintable()
    if (reader, how) == ("log", "gzip"):
        assert str(refused.value).endswith("save a spreadsheet as CSV, unpack what is packed")


@pytest.mark.parametrize("reader", READERS)
def test_another_encoding_or_a_zero_byte_within_is_never_a_traceback(tmp_path: Path, reader: str) -> None:
    name, text, read = READERS[reader]
    path = tmp_path / name
    for piece in (b"\xe9\xe8", b"\0", b"\xff", b"\xc3", b"\xed\xa0\x80"):
        for at in (1, len(text) // 2, len(text) - 1):
            path.write_bytes(text[:at].encode() + piece + text[at:].encode())
            try:
                read(path)
            except BadInputError as error:
                assert "\n" not in str(error)
