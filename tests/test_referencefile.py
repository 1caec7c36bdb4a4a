"""References from files: what is read, and what is refused with its line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from control_models import NOMINAL

from calib.actuator.kinematics import forward
from calib.control.setpoints import Ellipse
from calib.errors import BadInputError
from calib.referencefile import read_reference

R, H = NOMINAL.plant.bellows_radius_m, NOMINAL.tick_s
Make = Callable[[str], Path]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    def write(text: str) -> Path:
        path = tmp_path / "ref.csv"
        path.write_text(text)
        return path

    return write


def _table(header: str, *columns: np.ndarray) -> str:
    rows = (",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))
    return "\n".join([header, *rows]) + "\n"


def test_lengths_heads_and_angles_are_the_same_motion(make: Make) -> None:
    t = 0.05 * np.arange(101)
    q = Ellipse(period_s=10.0).bellows_m(t, R)
    pose = forward(q, R)
    lengths = read_reference(make(_table("t_s,q1_m,q2_m,junk", t, q[:, 0], q[:, 1], t)), NOMINAL)
    heads = read_reference(make(_table("t_s,x_m,y_m", t, pose[:, 0], pose[:, 1])), NOMINAL)
    angles = read_reference(make(_table("phi_rad,t_s", pose[:, 2], 7.0 + t)), NOMINAL)
    assert heads.q_m == pytest.approx(lengths.q_m, abs=2e-6)
    assert angles.phi_rad == pytest.approx(lengths.phi_rad, abs=1e-4)
    assert (angles.kind, len(angles.q_m)) == ("angle", len(lengths.q_m))


def test_a_recorded_log_is_a_reference(make: Make) -> None:
    """Rows at uneven times, two stamped alike, lengths from the truth of a simulated log."""
    t = np.sort(np.concatenate([np.arange(0, 3, 1 / 60), np.arange(0, 3, 0.01) + 1e-3]))
    t[5] = t[4]
    q = 0.07 + 0.003 * np.sin(t)
    made = read_reference(make(_table("t_s,u_px,true_q1_m,true_q2_m", t, t, q, q)), NOMINAL)
    assert made.q_m[:, 0] == pytest.approx(0.07 + 0.003 * np.sin(made.t_s), abs=1e-6)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "has no column t_s"),
        ("q1_m,q2_m\n1,1\n", "has no column t_s"),
        ("t_s,u_px,v_px\n0,1,1\n", "has no reference in it, expected q1_m and q2_m"),
        ("t_s,q1_m\n0,1\n", "has no reference in it"),
        ("t_s,q1_m,q2_m\n0,0.07,0.07\n1,nan,0.07\n", "line 3: q1_m is nan, expected a finite number"),
        ("t_s,q1_m,q2_m\n0,0.07,inf\n", "line 2: q2_m is inf"),
        ("t_s,q1_m,q2_m\n0,0.07,\n", "line 2: q2_m is an empty cell"),
        ("t_s,q1_m,q2_m\n0,0.07,long\n", "line 2: q2_m is 'long', expected a number"),
        ("t_s,q1_m,q2_m\n0,0.07,0.07\n1,0.07,0.07\n0.5,0.07,0.07\n", "line 4: t_s is 0.5 after 1"),
        ("t_s,q1_m,q2_m\n0,0.07\n", "line 2: has 2 cells, expected 3"),
        ("t_s,q1_m,q2_m\n", "has 0 rows over 0 s, expected at least 3 rows and 0.05 s"),
        ("t_s,q1_m,q2_m\n0,0.07,0.07\n5,0.07,0.07\n", "has 2 rows over 5 s"),
        ("t_s,q1_m,q2_m\n0,0.07,0.07\n0.01,0.07,0.07\n0.02,0.07,0.07\n", "has 3 rows over 0.02 s"),
        ("t_s,phi_rad\n0,0.1\n1,0.1\n9999,0.1\n", "lasts 9999 s, expected at most 7200 s"),
        ("t_s,phi_rad\n0,0.1\n1,30\n2,0.1\n", "ref.csv: angle: found .* rad, at which no length is at rest"),
    ],
)
def test_files_that_are_no_references(make: Make, text: str, sentence: str) -> None:
    with pytest.raises(BadInputError, match=sentence):
        read_reference(make(text), NOMINAL)
