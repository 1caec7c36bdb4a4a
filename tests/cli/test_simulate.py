"""`calib simulate` from the command line: what it writes and says, and how it ends."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from calib.cli.simulate import simulate
from calib.core.errors import BadInputError, UsageError
from calib.io.logs import read_log

SHORT = "0.5s"


def _calib(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    command = [sys.executable, "-c", "from calib.cli.main import main; main()", "simulate", *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_a_log_and_its_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulate("swing", tmp_path / "log.csv", duration="2s")
    shown = capsys.readouterr()
    log = read_log(tmp_path / "log.csv")
    assert len(log) == 120 + 200
    assert f"swing: 2 s, 320 rows written to {tmp_path / 'log.csv'}" in shown.out
    assert "damping_ratio 0.055" in shown.out
    assert "simulated" in shown.err


def test_one_json_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulate(
        "orientation", tmp_path / "log.csv", 3, "truth", SHORT, ["controller=p", "Kp = 500"], as_json=True
    )
    document = json.loads(capsys.readouterr().out)
    assert (document["schema"], document["verb"]) == (1, "simulate")
    told = document["simulate"]
    assert (told["scenario"], told["seed"], told["feedback"]) == ("orientation", 3, "truth")
    assert (told["rows"], told["duration_s"]) == (80, 0.5)
    assert told["figures"]["reach_s"] is None
    assert told["figures"]["peak_rad"] > 0.0


def test_the_same_seed_writes_the_same_bytes(tmp_path: Path) -> None:
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        simulate("orientation", tmp_path / name, seed, duration=SHORT)
    a, b, c = ((tmp_path / name).read_bytes() for name in "abc")
    assert a == b != c


def test_the_rig_file_is_used_and_not_written(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text("actuator: {rest_length_m: 0.07}\n")
    simulate("static", tmp_path / "log.csv", duration=SHORT, rig=rig)
    assert set(read_log(tmp_path / "log.csv").columns["true_q1_m"].tolist()) == {0.07}
    assert rig.read_text() == "actuator: {rest_length_m: 0.07}\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"scenario": "wobble"}, "SCENARIO: 'wobble' is not one of"),
        ({"feedback": "guess"}, "--feedback: 'guess' is not one of sensors, truth"),
        ({"duration": "10"}, "--duration: '10' has no unit"),
        ({"duration": "-1s"}, "--duration: '-1s' is not positive"),
        ({"settings": ["Kp"]}, "--set: 'Kp' is not NAME=VALUE"),
        ({"settings": ["Kp=5"]}, "Kp: is no option of the scenario swing"),
        ({"scenario": "rig", "duration": "1s"}, "--set and --duration do not apply"),
    ],
)
def test_words_that_do_not_fit(tmp_path: Path, arguments: dict[str, object], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        simulate(**{"scenario": "swing", "output": tmp_path / "log.csv", **arguments})
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"settings": ["length_m=-0.065"]}, "expected positive lengths"),
        ({"duration": "3h"}, "duration: found 10800 s"),
        ({"rig": Path("none.yaml")}, r"none\.yaml: cannot be read: there is no such file"),
        ({"output": Path("nowhere/log.csv")}, "there is no folder"),
    ],
)
def test_input_that_cannot_be_used(tmp_path: Path, arguments: dict[str, object], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        simulate(**{"scenario": "swing", "output": tmp_path / "log.csv", **arguments})
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_exit_codes_and_one_sentence_each(tmp_path: Path) -> None:
    (tmp_path / "mm.yaml").write_text("actuator: {rest_length_m: 65}\n")
    (tmp_path / "creep.yaml").write_text(
        "actuator: {lambda1_per_s: -0.1047, lambda2_N_per_m: -14.98, lambda3: -1.854}\n"
    )
    (tmp_path / "stiff.yaml").write_text(
        "actuator: {k0_N_per_m: 100000, k1_N_per_m2: 10000000, mass_kg: 0.0001}\n"
    )
    for words, code, sentence in (
        (("swing", "-o", "log.csv", "--duration", SHORT), 0, "swing: 0.5 s"),
        (("swing",), 2, "output"),
        (("wobble", "-o", "x.csv"), 2, "SCENARIO: 'wobble' is not one of"),
        (("swing", "-o", "x.csv", "--rig", "mm.yaml"), 3, "is it in millimetres?"),
        (("swing", "-o", "x.csv", "--rig", "creep.yaml"), 3, "make the plant unstable"),
        (("swing", "-o", "x.csv", "--rig", "stiff.yaml"), 3, "is too large for its stiffness and damping"),
    ):
        ended = _calib(tmp_path, *words)
        assert ended.returncode == code, (words, ended.stderr)
        assert sentence in ended.stdout + ended.stderr
        assert "Traceback" not in ended.stderr
        if code == 3:
            assert ended.stderr.count("\n") == 1
    assert not (tmp_path / "x.csv").exists()
