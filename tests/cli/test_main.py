"""How the command starts and ends: help, exit codes, streams, interruption; doctor, report and diff."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import typer
from fleet_processes import COMMAND

from calib.cli.diff import diff
from calib.cli.doctor import doctor
from calib.core.rig import Rig
from calib.runner.doctor import Check

VERBS = ("intrinsics", "extrinsics", "distortion", "firmware", "board", "export", "import")
HEAVY = (
    "numpy", "scipy", "cv2", "matplotlib", "numba", "filterpy", "pydantic", "yaml", "jinja2", "rich",
    "webbrowser", "markdown_it",
)  # fmt: skip


def test_help_imports_nothing_heavy(environment) -> None:
    script = (
        "import sys; sys.argv = ['calib', '--help']\n"
        "from calib.cli.main import main\n"
        "try: main()\n"
        f"except SystemExit: print([m for m in {HEAVY} if m in sys.modules], file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stderr == "[]\n"
    assert all(verb in done.stdout for verb in VERBS)


def test_the_module_is_the_command(environment) -> None:
    command = [sys.executable, "-m", "calib", "--version"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("calib ")


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_each_verb_explains_every_argument(calib, verb: str) -> None:
    ended = calib(verb, "--help")
    assert ended.code == 0
    assert ended.err == ""
    lines = [*ended.out.splitlines(), ""]
    assert max(map(len, lines)) <= 80
    for i, line in enumerate(lines):
        if line.startswith("  -"):
            explained = line.rstrip() + " " + lines[i + 1].strip()
            assert len(explained.split()) >= 4, line


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "Usage: calib"),
        (("intrinsics",), "Missing argument"),
        (("intrinsics", "a", "--model", "fisheye"), "'fisheye' is not one of"),
        (("board", "--page", "A3"), "'A3' is not one of"),
        (("intrinsics", "a", "--rig="), "an argument is empty: '--rig='"),
        (("intrinsics", "a", "--square", "20px"), "--square: '20px' has the unit 'px'"),
        (("intrinsics", "a", "--square", "20m"), "--square: '20m' is not between 0.01 mm and 10 m"),
        (("intrinsics", "a", "--image-size", "0x9"), "--image-size: '0x9' is not a picture's size"),
        (("distortion", "--region", "5,5,1,nan"), "--region: '5,5,1,nan' is not four finite numbers"),
    ],
)
def test_usage_ends_with_two(calib, words: tuple[str, ...], says: str) -> None:
    ended = calib(*words)
    assert ended.code == 2
    assert says in ended.err
    assert ended.out == ""


def test_a_mistake_of_the_program_is_one_sentence(calib, monkeypatch, tmp_path) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("first line\nsecond\x1b line")

    monkeypatch.setattr("calib.core.rig.Rig.load", broken)
    monkeypatch.delenv("CALIB_DEBUG", raising=False)
    ended = calib("firmware", "--rig", "rig.yaml", cwd=tmp_path)
    assert ended.code == 70
    assert ended.sentence.startswith(
        "internal error: RuntimeError: first line second\\x1b line (calib.runner.work"
    )
    assert "please report" in ended.sentence
    monkeypatch.setenv("CALIB_DEBUG", "1")
    ended = calib("firmware", "--rig", "rig.yaml", cwd=tmp_path)
    assert ended.code == 70
    assert "Traceback" in ended.err


@pytest.mark.parametrize(
    ("failure", "code", "says"),
    [
        (MemoryError(), 3, "out of memory"),
        (KeyboardInterrupt(), 130, "interrupted; files that were there before"),
        (ModuleNotFoundError("No module", name="yaml"), 3, "the Python package yaml is not there; install"),
        (ModuleNotFoundError("No module", name="calib.x"), 70, "internal error: ModuleNotFoundError"),
        (OSError(5, "Input/output error", "/x/rig.yaml"), 3, "/x/rig.yaml: Input/output error"),
    ],
)
def test_other_ends(calib, monkeypatch, failure: BaseException, code: int, says: str) -> None:
    def fail(*_: object, **__: object) -> None:
        raise failure

    monkeypatch.setattr("calib.core.rig.Rig.load", fail)
    # Threads that other tests have left behind are not this command's.
    monkeypatch.setattr("calib.cli.main._still_working", lambda: False)
    ended = calib("firmware")
    assert ended.code == code
    assert says in ended.sentence


def test_narration_goes_to_stderr_without_colour(process, pictures, tmp_path) -> None:
    ended = process(
        "intrinsics", pictures(4), "--model", "radial2", "--rig", tmp_path / "rig.yaml", FORCE_COLOR="1"
    )
    assert "verdict:" in ended.out
    assert "found" not in ended.out
    assert "\x1b" not in ended.out + ended.err
    assert [line.split()[0] for line in ended.err.splitlines()] == ["the", "found", "board", "camera"]


def test_a_reader_that_goes_away(shell, rig) -> None:
    script = "calib export ros --rig rig.yaml | true; echo ${PIPESTATUS[0]}"
    done = shell(script, rig.parent)
    assert done.stdout == "141\n"
    assert done.stderr == ""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_stdout_that_is_full(shell, rig) -> None:
    done = shell("calib export ros --rig rig.yaml > /dev/full", rig.parent)
    assert done.returncode == 3
    assert done.stderr == "calib: standard output: cannot be written: No space left on device\n"
    done = shell("calib board -o /dev/full", rig.parent)
    assert done.returncode == 3
    assert done.stderr == "calib: /dev/full: cannot be written: No space left on device\n"


@pytest.mark.few(1)
@pytest.mark.parametrize("closed", [">&-", "<&- >&- 2>&-", "2>/dev/full"])
def test_streams_that_are_closed_harm_nothing(shell, rig, closed: str) -> None:
    before = rig.read_bytes()
    done = shell(f"calib firmware --rig rig.yaml -o out {closed}", rig.parent)
    assert done.returncode == 0
    assert (rig.parent / "out" / "calib_constants.h").read_text().startswith("/*\n * calib_constants.h")
    assert rig.read_bytes() == before


def test_devices_are_written_through_and_stay(shell, rig) -> None:
    done = shell("calib export ros --rig rig.yaml -o /dev/stdout | head -1", rig.parent)
    assert done.stdout == "image_width: 316\n"
    assert shell("calib board -o /dev/null", rig.parent).returncode == 0
    assert Path("/dev/null").is_char_device()


@pytest.mark.parametrize("after_s", [0.1, 0.4, 0.8, 1.2, 1.6])
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
@pytest.mark.slow
def test_an_interruption_leaves_the_old_file_or_the_new_one(
    environment, project_root, rig, how, after_s
) -> None:
    before = rig.read_bytes()
    started = subprocess.Popen(
        [*COMMAND, "intrinsics", str(project_root / "images"), "--rig", str(rig)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    time.sleep(after_s)
    started.send_signal(how)
    _, err = started.communicate(timeout=60)
    if started.returncode == 130:
        assert err.splitlines()[-1].startswith("calib: interrupted")
        assert "Traceback" not in err
    else:
        # Done before, or killed; or the interpreter itself was still starting on a busy machine.
        assert started.returncode in (0, -how) or "Failed to import the site module" in err
    after = rig.read_text()
    assert after.encode() == before or (after.startswith("schema:") and "\nprovenance:\n" in after)
    assert [path.name for path in rig.parent.iterdir()] == ["rig.yaml"]


def test_an_interruption_while_boards_are_searched(python, tmp_path) -> None:
    # The search sleeps in its threads; nothing may wait for them.
    script = (
        "import sys, time, numpy as np, calib.stages.camera.read\n"
        "from calib.io.pictures import Picture\n"
        "import calib.stages.camera.read as read\n"
        "read.read_picture = lambda p, *_, **__: Picture(p.name, '', np.zeros((9, 9), np.uint8), (9, 9))\n"
        "def slow(*_):\n    sys.stdout.write('searching\\n'); sys.stdout.flush(); time.sleep(30)\n"
        "calib.stages.camera.read.detect = slow\n"
        "from calib.cli.main import main\n"
        "sys.argv = ['calib', 'intrinsics', '.', '--corners', '7x5']\n"
        "main()\n"
    )
    for name in ("a.png", "b.png", "c.png"):
        (tmp_path / name).write_bytes(b"x")
    began = time.monotonic()
    started = python(script)
    assert started.stdout is not None
    assert started.stdout.readline().startswith("searching")
    started.send_signal(signal.SIGINT)
    _, err = started.communicate(timeout=25)
    assert started.returncode == 130
    assert err == "calib: interrupted; files that were there before are unchanged or whole\n"
    assert time.monotonic() - began < 25


_LOST = """
import ctypes
def compare(a, b):
    print("in a callback", flush=True)
    time.sleep(5)
    return 0
kind = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
ctypes.CDLL(None).qsort((ctypes.c_int * 2)(2, 1), 2, 4, kind(compare))
raise RuntimeError("went on without what the callback does")
"""
_COMPILED = """
import hashlib
print("in a call that lasts", flush=True)
hashlib.pbkdf2_hmac("sha256", b"x", b"y", 200_000_000)
"""
_SWALLOWED = """
try:
    print("in an import", flush=True)
    time.sleep(5)
except BaseException:
    pass
time.sleep(20)
"""


@pytest.mark.parametrize("body", [_LOST, _COMPILED, _SWALLOWED], ids=["callback", "compiled", "swallowed"])
@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs POSIX signals")
def test_an_interruption_is_answered_within_two_seconds(python, body) -> None:
    script = (
        f"import sys, time\nimport calib.cli.main as cli\n"
        f"def run(*_):\n    exec({body!r}, {{'time': time}})\n"
        "import calib.cli.app as verbs\nverbs.command_line = lambda _: lambda **_: run()\n"
        "sys.argv = ['calib', 'doctor']\ncli.main()\n"
    )
    started = python(script)
    assert started.stdout is not None
    assert started.stdout.readline().startswith("in a")
    began = time.monotonic()
    started.send_signal(signal.SIGINT)
    _, err = started.communicate(timeout=25)
    assert time.monotonic() - began < 2.0
    assert started.returncode == 130
    assert err == "calib: interrupted; files that were there before are unchanged or whole\n"


@pytest.mark.slow
def test_the_same_inputs_give_the_same_bytes(shell, project_root, tmp_path) -> None:
    images = project_root / "images"
    runs = {"a": "", "b": "", "c": "OPENBLAS_NUM_THREADS=4 PYTHONHASHSEED=7 "}
    if (
        hasattr(os, "sched_getaffinity")
        and subprocess.run(["which", "taskset"], capture_output=True, check=False).returncode == 0
    ):
        runs["b"] = f"taskset -c {min(os.sched_getaffinity(0))} "
    for name, prefix in runs.items():
        folder = tmp_path / name
        folder.mkdir()
        script = "".join(
            f"{prefix}calib {words} --rig rig.yaml && "
            for words in (
                f"intrinsics {images}",
                f"extrinsics {images / 'plane'}",
                "distortion",
                "firmware -o .",
            )
        )
        done = shell(script + "true", folder)
        assert done.returncode == 0, done.stderr
    for file in ("rig.yaml", "calib_constants.h"):
        first, *others = ((tmp_path / name / file).read_bytes() for name in runs)
        assert all(other == first for other in others)
        assert str(project_root).encode() not in first
        assert str(tmp_path).encode() not in first


def test_completion(environment) -> None:
    words = {
        "COMP_WORDS": "calib intrinsics --model r",
        "COMP_CWORD": "3",
        "_CALIB_COMPLETE": "complete_bash",
    }
    done = subprocess.run(
        COMMAND,
        env=environment | words,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.split() == ["radial2", "radial3", "rational8"]
    assert done.stderr == ""


def test_whole_installation(capsys: pytest.CaptureFixture[str]) -> None:
    doctor(quick=True)
    said = capsys.readouterr().out
    assert "numpy" in said and said.endswith("verdict: ok\n")


@pytest.mark.slow
def test_a_home_that_cannot_be_written_is_no_matter(process) -> None:
    nowhere = "/dev/null/home"
    done = process("doctor", "--quick", HOME=nowhere, XDG_CONFIG_HOME=nowhere, XDG_CACHE_HOME=nowhere)
    assert (done.code, done.err) == (0, "") and done.out.endswith("verdict: ok\n")


def test_missing_library_ends_with_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    checks = [Check("numpy", True, False, "-", "sums"), Check("avr-gcc", False, False, "-", "")]
    monkeypatch.setattr("calib.runner.doctor.examine", lambda quick: checks)
    with pytest.raises(typer.Exit) as left:
        doctor(as_json=True)
    assert left.value.exit_code == 1
    told = json.loads(capsys.readouterr().out)
    assert told["gate"] == ["numpy"]


RIG = """camera: {{model: pinhole, image_size_px: [316, 208], fx_px: {fx}, fy_px: 272.6, cx_px: 160.7,
  cy_px: 101.9, sigma: {{fx_px: 0.03}}, verdict: ok}}
"""


def test_table_and_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = tmp_path / "a.yaml", tmp_path / "b.yaml"
    a.write_text(RIG.format(fx=273.4))
    b.write_text(RIG.format(fx=273.5))
    diff(a, b)
    said = capsys.readouterr().out
    assert "camera.fx_px" in said and "not significant" in said and "2.4" in said
    assert "nothing beyond the error bars" in said
    diff(a, b, as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert told["significant"] is False and told["plane"] is None and told["pictures_px"] is None
    assert told["changes"][0]["sigmas"] == pytest.approx(0.1 / (0.03 * 2**0.5))


def test_what_one_side_has_is_counted_beyond_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    a = tmp_path / "a.yaml"
    a.write_text(RIG.format(fx=273.4))
    found = replace(Rig.load(a).diff(Rig.load(a)), only_after=tuple(f"s{k}" for k in range(30)))
    monkeypatch.setattr(Rig, "diff", lambda one, other: found)
    for every, end in ((False, "s19 and 10 more"), (True, "s28, s29")):
        diff(a, a, every=every)
        line = next(one for one in capsys.readouterr().out.splitlines() if one.startswith("only after"))
        assert line.endswith(end)


@pytest.mark.parametrize("bar", ["0.03", "null"])
def test_pictures_of_two_sizes_differ(tmp_path: Path, capsys: pytest.CaptureFixture[str], bar: str) -> None:
    """Even where a side has no error bars; with them the focal lengths do too."""
    a, b = tmp_path / "a.yaml", tmp_path / "b.yaml"
    a.write_text(RIG.format(fx=273.4))
    text = RIG.format(fx=610).replace("[316, 208]", "[640, 480]")
    b.write_text(text if bar == "0.03" else text.replace("sigma: {fx_px: 0.03}, ", ""))
    diff(a, b)
    said = capsys.readouterr().out
    assert "pictures of two sizes, 316x208 px before and 640x480 px after" in said
    assert f"in all: significant{'' if bar == '0.03' else '; 1 without error bars differs'}" in said
    focal = next(line for line in said.splitlines() if "fx_px" in line)
    assert focal.endswith(" significant" if bar == "0.03" else "no error bars")
    assert said.splitlines()[2].split()[0] == "camera.image_size_px[0]"
