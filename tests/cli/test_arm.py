"""`calib identify` and `calib validate` on logs of an arm that pressures drive."""

from __future__ import annotations

from pathlib import Path

import yaml
from armtrials import simulated, written

from .conftest import Run


def test_an_arm_is_identified_and_predicted(calib: Run, tmp_path: Path) -> None:
    days = (("a", 1.0), ("a", 1.0), ("b", 1.1), ("b", 1.1))
    trials = [
        simulated(f"{day}_{k}", k, day, gain=gain, duration_s=20.0) for k, (day, gain) in enumerate(days)
    ]
    names = [written(tmp_path, one).name for one in trials]
    ended = calib("identify", *names, "--no-compare", cwd=tmp_path)
    assert ended.code == 0, ended.err
    assert "held trials, angle from the command" in ended.out
    assert "verdict: ok" in ended.out and "all trials are of one day" not in ended.out
    text = (tmp_path / "rig.yaml").read_text(encoding="utf-8")
    assert set(yaml.safe_load(text)["actuator"]["days"]) == {"a", "b"}
    assert str(tmp_path) not in text
    further = written(tmp_path, simulated("c_1", 9)).name
    alike = written(tmp_path, simulated("a_7", 7, "a")).name
    ended = calib("validate", further, alike, cwd=tmp_path)
    assert ended.code == 0, ended.err
    assert "day c is not in the rig" in ended.err and "may well be off by 15 %" in ended.err
    head, first, other, *reasons = ended.out.splitlines()
    assert float(first.split()[1]) < 3.0
    assert head.endswith("inside, %") and int(first.split()[-1]) < 85 < int(other.split()[-1])
    assert len(reasons) == 1 and "c_1: " in reasons[0] and "another arm, load or day" in reasons[0]


def test_what_logs_without_commands_do_not_tell_is_named(calib: Run, tmp_path: Path) -> None:
    names = []
    for k in range(3):
        path = written(tmp_path, simulated(f"a_{k}", k, duration_s=20.0))
        lines = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
        left = [j for j, name in enumerate(lines[0]) if not name.startswith("p_cmd")]
        path.write_text("\n".join(",".join(row[j] for j in left) for row in lines) + "\n", encoding="utf-8")
        names.append(path.name)
    ended = calib("identify", *names, "--no-compare", cwd=tmp_path)
    assert ended.code == 0, ended.err
    untold = "valve, creep_s: the prior's, these logs do not tell"
    assert f"{untold}; it takes steps of the command" in ended.out
    assert "held trials, angle from the pressure" in ended.out
    assert "angle from the command" not in ended.out
    assert "all trials are of one day: on another the angle may well differ by 15 %" in ended.out


def test_what_is_stated_of_other_logs_and_rigs_without_an_arm_are_refused(calib: Run, tmp_path: Path) -> None:
    name = written(tmp_path, simulated("a_1", 1)).name
    ended = calib("identify", name, "--load", "z=1kg", cwd=tmp_path)
    assert ended.code == 2
    assert "--load: 'z=1kg' names no log" in ended.sentence
    (tmp_path / "a_2.csv").write_bytes((tmp_path / name).read_bytes())
    ended = calib("identify", name, "a_2.csv", "--load", "a_2=200g", cwd=tmp_path)
    assert ended.code == 1
    assert "cannot be used and is left out: a_2.csv: is the same recording as a_1.csv" in ended.out
    (tmp_path / "a_2.csv").unlink()
    (tmp_path / "rig.yaml").write_text("schema: 2\n", encoding="utf-8")
    ended = calib("validate", name, cwd=tmp_path)
    assert ended.code == 3
    assert "has no arm yet; run calib identify arm first" in ended.sentence
