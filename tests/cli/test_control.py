"""`calib control` from the command line: what it says and writes, and how it ends."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from calib.core.rig import Rig

from .conftest import Run


def test_run_compares_controllers(calib: Run, tmp_path: Path) -> None:
    words = ("control", "run", "jump", "--controller", "clamping", "--controller", "back")
    ended = calib(*words, "--figures", "drawn", cwd=tmp_path)
    assert ended.code == 0, ended.err
    assert "jump: 10 s at 60 Hz, feedback from sensors" in ended.out
    assert "after jump" in ended.out and "  clamping" in ended.out and "  back" in ended.out
    assert "the pumps cannot follow it: at 0.00 s" in ended.out
    assert {path.name for path in (tmp_path / "drawn").iterdir()} == {"control_run.png"}
    assert not (tmp_path / "rig.yaml").exists()


@pytest.mark.slow
def test_tune_writes_the_section_that_run_then_uses(calib: Run, tmp_path: Path) -> None:
    ended = calib("control", "tune", "--figures", "drawn", cwd=tmp_path)
    assert ended.code == 1 and "rig.yaml tells nothing of the actuator and the pump" in ended.out
    assert re.search(r"orientation Kp, PWM/rad +470\n", ended.out)
    text = (tmp_path / "rig.yaml").read_text()
    section = Rig.load(tmp_path / "rig.yaml").controller
    assert section is not None
    assert section.orientation.Kp_pwm_per_rad == 470.0
    assert all(row.stable and (row.gain or 99.0) > 1.96 for row in section.margins)
    assert (tmp_path / "drawn" / "control_margins.png").exists()
    again = calib("control", "tune", "--json", cwd=tmp_path)
    assert (tmp_path / "rig.yaml").read_text() == text
    told = json.loads(again.out)
    assert told["controller"]["orientation"]["Kp_pwm_per_rad"] == 470.0
    ended = calib("control", "run", "step", "--controller", "tuned-pid", "--duration", "2s", cwd=tmp_path)
    assert ended.code == 0 and "tuned-pid" in ended.out


def test_gains_are_for_the_boards_tick_and_the_actuators_reach(calib: Run, tmp_path: Path) -> None:
    """Commands logged at 100 Hz, a board that ticks at 30 Hz, an actuator that bends half as far."""
    stated = "actuator: {bellows_radius_m: 0.03, rest_length_m: 0.1}, pump: {tick_s: 0.01, delay_ticks: 3}"
    (tmp_path / "rig.yaml").write_text(f"known: {{{stated}}}\n")
    assert calib("lowpass", "--rate", "30Hz", cwd=tmp_path).code == 0
    ended = calib("control", "tune", cwd=tmp_path)
    assert ended.code == 0, ended.out
    section = Rig.load(tmp_path / "rig.yaml").controller
    assert section is not None and section.delay_ticks == 1
    assert section.tick_s == pytest.approx(1.0 / 30.0)
    assert section.anti_windup["back_calculation"].rise_s < 4.0


def test_check_names_the_first_second_and_writes_a_slower_one(calib: Run, tmp_path: Path) -> None:
    t = np.arange(0.0, 8.0, 1.0 / 60.0)
    turn = 2.0 * np.pi * t / 8.0
    rows = [
        f"{a:.6f},{b:.9f},{c:.9f}"
        for a, b, c in zip(t, -0.015 * np.sin(turn), 0.078 - 0.01 * np.cos(turn), strict=True)
    ]
    (tmp_path / "fast.csv").write_text("\n".join(["t_s,x_m,y_m", *rows]) + "\n")
    ended = calib("control", "check", "fast.csv", "--slow", "slow.csv", "--figures", "f", cwd=tmp_path)
    assert ended.code == 1
    assert "verdict: poor\n  - the pumps cannot follow it from 4.5" in ended.out
    assert "bellows 2 would have to deflate at" in ended.out
    assert (tmp_path / "f" / "control_check.png").exists()
    ended = calib("control", "check", "slow.csv", "--json", cwd=tmp_path)
    assert ended.code == 0, ended.err
    told = json.loads(ended.out)
    assert told["control"]["possible"] is True and 9.0 < told["control"]["duration_s"] < 14.0


def test_a_simulated_log_as_reference(calib: Run, tmp_path: Path) -> None:
    words = ("simulate", "ellipse", "-o", "log.csv", "--duration", "4s")
    assert calib(*words, cwd=tmp_path).code == 0
    ended = calib("control", "run", "log.csv", "--controller", "torque", "--json", cwd=tmp_path)
    assert ended.code == 0, ended.err
    (one,) = json.loads(ended.out)["control"]["runs"]
    assert max(one["rms_mm"]) < 0.4


def test_the_plant_of_the_file_is_controlled(calib: Run, tmp_path: Path) -> None:
    """A slower pump reaches the angle later."""

    def rise() -> float:
        ended = calib("control", "run", "step", "--controller", "pid", "--json", cwd=tmp_path)
        return float(json.loads(ended.out)["control"]["runs"][0]["rise_s"])

    nominal = rise()
    (tmp_path / "rig.yaml").write_text("pump: {lag_s: 1.2}\n")
    assert rise() > 1.3 * nominal


def test_controllers_meet_another_plant(calib: Run, tmp_path: Path) -> None:
    (tmp_path / "weak.yaml").write_text("known: {pump: {strength: [0.85, 0.85]}}\n")
    # The same pumps with a command each 1/120 s, in whose logs the delay is twice as many ticks.
    (tmp_path / "fast.yaml").write_text("known: {pump: {tick_s: 0.008333333333333333, delay_ticks: 4}}\n")
    words = ("control", "run", "ellipse", "--controller", "torque", "--json", "--duration", "3s")
    own, other = (calib(*words, *more, cwd=tmp_path) for more in ((), ("--plant", "weak.yaml")))
    assert own.code == other.code == 0, other.err
    own_run, other_run = json.loads(own.out)["control"], json.loads(other.out)["control"]
    assert "plant" not in own_run and other_run["plant"] == "weak.yaml"
    errors = [told["runs"][0]["head_rms_mm"] for told in (own_run, other_run)]
    # A sixth of the force is missing, and the law learns it from the errors alone.
    assert errors[1] > 2.0 * errors[0]
    # What can be followed is told of the model, which is the same.
    assert own_run["fastest_rise_N_per_s"] == other_run["fastest_rise_N_per_s"]
    ended = calib(*words, "--plant", "fast.yaml", cwd=tmp_path)
    assert json.loads(ended.out)["control"]["runs"] == own_run["runs"]


@pytest.mark.parametrize(
    ("verb", "text", "sentence"),
    [
        (
            "run",
            "t_s,q1_m,q2_m\n0,0.07,0.07\n1,nan,0.07\n2,0.07,0.07\n",
            "ref.csv, line 3: q1_m is blank or nan",
        ),
        (
            "check",
            "t_s,q1_m,q2_m\n0,.07,.07\n1,.07,.07\n",
            "ref.csv: has 2 rows over 1 s, expected at least 3",
        ),
        ("run", "t_s,u_px\n0,1\n", "ref.csv: has no reference in it"),
    ],
)
def test_references_that_cannot_be_used(
    calib: Run, tmp_path: Path, verb: str, text: str, sentence: str
) -> None:
    (tmp_path / "ref.csv").write_text(text)
    ended = calib("control", verb, "ref.csv", cwd=tmp_path)
    assert ended.code == 3
    assert sentence in ended.sentence


@pytest.mark.parametrize("verb", [("run", "step"), ("check", "step"), ("tune",)])
@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("actuator: {lambda1_per_s: -0.1047, lambda2_N_per_m: -14.98, lambda3: -1.854}\n", "make the plant"),
        ("pump: {lag_s: 700}\n", "rig.yaml: pump.lag_s is 700, expected 0.001 to 60 s"),
        ("controller: {pwm_low: 9.0, verdict: ok}\n", "rig.yaml: controller.tick_s is missing"),
    ],
)
def test_rigs_that_cannot_be_controlled(
    calib: Run, tmp_path: Path, verb: tuple[str, ...], text: str, sentence: str
) -> None:
    (tmp_path / "rig.yaml").write_text(text)
    ended = calib("control", *verb, cwd=tmp_path)
    assert ended.code == 3
    assert sentence in ended.sentence
    assert (tmp_path / "rig.yaml").read_text() == text


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("run", "step", "--controller", "lqr"), "--controller: 'lqr' is not one of p, pid"),
        (("run", "elongation", "--controller", "pid"), "pid does not suit a reference of lengths, expected"),
        (("run", "step", "--pwm-limits", "0,nan"), "--pwm-limits: '0,nan' is not two finite numbers"),
        (("tune", "--phase-margin", "95deg"), "phase margin: found 95 deg"),
    ],
)
def test_words_that_do_not_fit(calib: Run, tmp_path: Path, words: tuple[str, ...], sentence: str) -> None:
    ended = calib("control", *words, cwd=tmp_path)
    assert ended.code == 2
    assert sentence in ended.sentence
