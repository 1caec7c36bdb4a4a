"""`calib lowpass` from the command line: what it says and writes, and how it ends."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.core.rig import hash_of, identity, read_rig
from calib.io.logs import Log, write_log

Run = Callable[..., Any]


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


def test_the_nominal_filter(calib: Run, tmp_path: Path) -> None:
    ended = calib("lowpass", "--cutoff", "1Hz", "--rate", "60Hz", cwd=tmp_path)
    assert ended.code == 0
    assert "butterworth, order 1: 1 Hz at 60 Hz" in ended.out
    assert "b1 = 0.049797982, 0.049797982, 0" in ended.out
    assert "delay: 0.1590 s for slow motion" in ended.out
    assert "verdict: ok" in ended.out
    section = read_rig(tmp_path / "rig.yaml").lowpass
    assert section is not None
    assert section.dc_delay_s == pytest.approx(0.159, abs=5e-4)


def test_one_json_document_and_the_same_bytes(calib: Run, tmp_path: Path) -> None:
    words = ("lowpass", "--order", "2", "--json")
    first = calib(*words, cwd=tmp_path)
    text = (tmp_path / "rig.yaml").read_bytes()
    again = calib(*words, cwd=tmp_path)
    assert first.out == again.out
    assert (tmp_path / "rig.yaml").read_bytes() == text
    told = json.loads(first.out)
    assert (told["schema"], told["verb"]) == (1, "lowpass")
    assert told["lowpass"]["dc_delay_s"] == pytest.approx(0.225, abs=5e-4)


def test_a_suggestion_in_pixels_with_figures(calib: Run, tmp_path: Path, log: Path) -> None:
    ended = calib("lowpass", "--suggest", log, "--jitter", "0.1px", "--figures", "drawn", cwd=tmp_path)
    assert ended.code == 0, ended.err
    assert "least delay for a jitter of 0.1 px" in ended.out
    assert "taken" in ended.out
    section = read_rig(tmp_path / "rig.yaml").lowpass
    assert section is not None and section.log is not None
    assert 0.09 < max(axis.jitter_after for axis in section.log.axes.values()) < 0.102
    assert {path.name for path in (tmp_path / "drawn").iterdir()} == {
        "lowpass_log.png",
        "lowpass_response.png",
    }
    provenance = read_rig(tmp_path / "rig.yaml").provenance.inputs["lowpass"]
    assert provenance == {"log.csv": hash_of(log)}


def test_without_a_wish_the_jitter_of_the_given_filter_is_kept(calib: Run, tmp_path: Path, log: Path) -> None:
    ended = calib("lowpass", "--suggest", log, "--family", "bessel", "--order", "3", cwd=tmp_path)
    assert ended.code == 0, ended.err
    section = read_rig(tmp_path / "rig.yaml").lowpass
    assert section is not None
    assert (section.family, section.order) == ("bessel", 3)
    # The same filter, less what three digits take off.
    assert 0.98 < section.cutoff_hz <= 1.0


def test_millimetres_with_a_plane(calib: Run, rig: Path, log: Path) -> None:
    ended = calib("lowpass", "--log", log, "--rig", rig)
    assert ended.code == 0, ended.err
    assert "jitter, mm" in ended.out
    after = read_rig(rig)
    assert after.camera is not None and after.plane is not None and after.lowpass is not None
    assert after.provenance.inputs["lowpass"] == {
        "camera": identity(after.camera),
        "log.csv": hash_of(log),
        "plane": identity(after.plane),
    }
    ended = calib("lowpass", "--suggest", log, "--jitter", "0.1px", "--rig", rig)
    assert ended.code == 2
    assert ended.sentence == "--jitter: '0.1px' does not fit positions in millimetres"
    assert read_rig(rig).lowpass == after.lowpass


def test_a_poor_filter_is_written_and_says_so(calib: Run, tmp_path: Path) -> None:
    ended = calib("lowpass", "--cutoff", "0.01Hz", "--order", "2", cwd=tmp_path)
    assert ended.code == 1
    assert "verdict: poor" in ended.out
    section = read_rig(tmp_path / "rig.yaml").lowpass
    assert section is not None and section.verdict == "poor"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--cutoff", "31Hz"), "the cut-off is 31 Hz at 60 samples/s"),
        (("--cutoff", "30Hz"), "the cut-off is 30 Hz at 60 samples/s"),
        (("--cutoff", "0Hz"), "--cutoff: '0Hz' is not positive"),
        (("--cutoff=-1Hz",), "--cutoff: '-1Hz' is not positive"),
        (("--cutoff", "1"), "--cutoff: '1' has no unit"),
        (("--rate", "0Hz"), "--rate: '0Hz' is not positive"),
        (("--order", "0"), "the order is 0, expected 1 to 8"),
        (("--order", "9"), "the order is 9, expected 1 to 8"),
        (("--family", "elliptic"), "the family is 'elliptic', expected one of"),
        (("--jitter", "0.1mm"), "--jitter: is for --suggest"),
        (("--suggest", "LOG", "--jitter", "0.1"), "--jitter: '0.1' has no unit"),
        (("--suggest", "LOG", "--jitter", "0px"), "--jitter: '0px' is not positive"),
        (("--suggest", "LOG", "--jitter", "1px", "--cutoff", "1Hz"), "--cutoff: does not go with --jitter"),
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
        ("t_s,ax_mps2\n0,1\n1,1\n", "log.csv: has no columns u_px and v_px"),
        ("t_s,u_px,v_px\n0,1,1\n", "log.csv: has one row in which the camera saw the marker"),
        ("t_s,u_px,v_px\n1,1,1\n0,1,1\n", "log.csv, line 3: t_s goes back"),
        ("t_s,u_px,v_px\n0,1,1\n0.1,1,1\n", "log.csv: has 10 camera samples/s, expected the 60 Hz"),
        (
            "t_s,u_px,v_px\n" + "".join(f"{k / 60:.6f},5,5\n" for k in range(300)),
            "log.csv: has no jitter at all",
        ),
        ("t_s,u_px,v_px\n", "log.csv: has a header but no rows"),
    ],
)
def test_logs_that_cannot_be_used(calib: Run, tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "log.csv").write_text(text)
    ended = calib("lowpass", "--suggest", "log.csv", "--jitter", "0.1px", cwd=tmp_path)
    assert ended.code == 3
    assert sentence in ended.sentence
    assert not (tmp_path / "rig.yaml").exists()


def test_more_than_there_is(calib: Run, tmp_path: Path, log: Path) -> None:
    for wish, sentence in (("5px", "no low-pass is needed"), ("1e-6px", "ask for more")):
        ended = calib("lowpass", "--suggest", log, "--jitter", wish, cwd=tmp_path)
        assert ended.code == 3
        assert sentence in ended.sentence
