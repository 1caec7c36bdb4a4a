"""Logs of an IMU: what is wrong with them, in one sentence each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.imulogs import read_rest_log, rest_log
from calib.logs import Log

NAMES = ("gx_radps", "gy_radps", "gz_radps", "ax_mps2", "ay_mps2", "az_mps2")


def log_of(values: np.ndarray, names: tuple[str, ...] = NAMES, t_s: np.ndarray | None = None) -> Log:
    n = len(values)
    t = 0.01 * np.arange(n) if t_s is None else t_s
    return Log("log.csv", t, dict(zip(names, values.T, strict=True)), np.arange(2, n + 2))


def at_rest(n: int = 1000, seed: int = 0) -> np.ndarray:
    noise = np.array([2e-3] * 3 + [0.02] * 3)
    rng = np.random.default_rng(seed)
    return noise * rng.normal(size=(n, 6)) + [0.004, -0.003, 0.006, 9.8, 0.2, 0.1]


def test_a_good_log() -> None:
    values = at_rest()
    found = rest_log(log_of(values))
    assert found.axes == ("gx", "gy", "gz", "ax", "ay", "az")
    assert np.array_equal(found.values, values)
    assert len(found.onchip_t_s) == 0


def test_rows_of_other_sensors_are_passed_over() -> None:
    values = at_rest()
    values[::3] = np.nan
    assert len(rest_log(log_of(values)).t_s) == 666


def test_units_are_converted_when_named() -> None:
    values = at_rest()
    other = values / np.array([np.pi / 180.0] * 3 + [9.80665] * 3)
    found = rest_log(log_of(other), "g", "deg/s")
    assert np.allclose(found.values, values)


def _in_g() -> Log:
    return log_of(at_rest() / np.array([1.0, 1.0, 1.0, 9.8, 9.8, 9.8]))


def _in_degrees() -> Log:
    return log_of(at_rest() * np.array([57.3, 57.3, 57.3, 1.0, 1.0, 1.0]))


def _fast() -> Log:
    values = at_rest()
    values[500, 2] = 250.0
    return log_of(values)


def _counts() -> Log:
    return log_of(at_rest() * np.array([1.0, 1.0, 1.0, 1670.0, 1670.0, 1670.0]))


def _backwards() -> Log:
    t = 0.01 * np.arange(1000)
    t[600:] -= 2.0
    return log_of(at_rest(), t_s=t)


def _apart() -> Log:
    values = at_rest()
    values[::2, :3] = np.nan
    values[1::2, 3:] = np.nan
    return log_of(values)


@pytest.mark.parametrize(
    ("log", "words"),
    [
        (log_of(at_rest()[:, :2], ("u_px", "v_px")), "has no IMU, expected columns as gz_radps"),
        (log_of(np.full((9, 6), np.nan)), "the IMU's columns gx_radps, .* hold no number"),
        (log_of(at_rest(1)), "has 1 IMU sample, expected a log of minutes"),
        (log_of(np.zeros((500, 6))), "all IMU readings are zero"),
        (log_of(np.tile([0.0, 0.0, 0.1, 9.8, 0.0, 0.0], (500, 1))), "no IMU reading ever changes"),
        (_in_g(), r"specific force at rest is 1, so it is in g, expected m/s\^2; give --acc-unit g"),
        (
            _in_degrees(),
            "which no gyroscope at rest does in rad/s; if it is in deg/s, give --gyro-unit deg/s",
        ),
        (_fast(), "the gyroscope reaches 250, which no gyroscope"),
        (_counts(), r"is 1\.63\de\+04 \(raw counts\), expected about 9\.81"),
        (_backwards(), r"line 602: t_s goes back from 5\.990000 to 4\.000000"),
        (_apart(), "no row has all of gx_radps"),
    ],
)
def test_what_is_wrong_is_said(log: Log, words: str) -> None:
    with pytest.raises(BadInputError, match=rf"log\.csv.*{words}"):
        rest_log(log)


def test_cells_that_say_nan_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    lines = [f"{0.01 * i:.2f},{row[2]:.6f}" for i, row in enumerate(at_rest(200))]
    lines[50] = "0.50,nan"
    path.write_text("t_s,gz_radps\n" + "\n".join(lines) + "\n")
    log, said = read_rest_log(path)
    assert len(log.t_s) == 199
    assert any("1 cells say nan or inf" in sentence for sentence in said)
