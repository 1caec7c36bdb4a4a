"""Kalibr's imu.yaml: there and back, and clear sentences for what is missing."""

from __future__ import annotations

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from calib.errors import BadInputError
from calib.imusections import kalibr_imu
from calib.kalibr_imu import from_kalibr_imu
from calib.rig_imu import Imu

KEYS = {
    "accelerometer_noise_density": "accel_noise_mps2_per_sqrt_Hz",
    "accelerometer_random_walk": "accel_walk_mps3_per_sqrt_Hz",
    "gyroscope_noise_density": "gyro_noise_radps_per_sqrt_Hz",
    "gyroscope_random_walk": "gyro_walk_radps2_per_sqrt_Hz",
}
# The four numbers of the EuRoC sequences' ADIS16448, as that data set's sensor.yaml gives them.
EUROC = (2.0e-3, 3.0e-3, 1.6968e-04, 1.9393e-05)
TEXT = (
    "accelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3e-3\n"
    "gyroscope_noise_density: 1.6968e-04\ngyroscope_random_walk: 1.9393e-05\n"
    "rostopic: /imu0\nupdate_rate: 200\n"
)

sizes = st.floats(1e-12, 1e3, allow_nan=False)


def _same(one: Imu, other: Imu) -> None:
    """Equal to the seven digits that are written."""
    assert one.rate_hz == pytest.approx(other.rate_hz, rel=6e-7, abs=6e-7)
    for name in KEYS.values():
        mine, theirs = getattr(one, name), getattr(other, name)
        assert mine == (theirs if None in theirs else pytest.approx(theirs, rel=6e-7))


@given(st.tuples(sizes, sizes, sizes, sizes), st.floats(1e-3, 1e5))
def test_there_and_back(values: tuple[float, ...], rate_hz: float) -> None:
    imu = from_kalibr_imu({**dict(zip(KEYS, values, strict=True)), "update_rate": rate_hz})
    text = kalibr_imu(imu, "/imu")
    again = from_kalibr_imu(yaml.safe_load(text))
    _same(again, imu)
    assert kalibr_imu(again, "/imu") == text


@pytest.mark.parametrize("nested", [False, True])
def test_a_file_as_kalibr_writes_it(nested: bool) -> None:
    document = yaml.safe_load(TEXT)
    imu = from_kalibr_imu({"imu0": document} if nested else document)
    assert isinstance(imu, Imu) and imu.rate_hz == 200.0 and imu.verdict == "poor"
    for name, value in zip(KEYS.values(), EUROC, strict=True):
        assert getattr(imu, name) == [value] * 3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"update_rate": None}, "update_rate is None, expected a number"),
        ({"update_rate": 0}, "update_rate is 0, expected a positive number"),
        ({"gyroscope_random_walk": "fast\n"}, r"gyroscope_random_walk is 'fast\n', expected a number"),
        ({"gyroscope_random_walk": True}, "gyroscope_random_walk is True, expected a number"),
        ({"accelerometer_noise_density": -1}, "accelerometer_noise_density is -1, expected"),
        ({"accelerometer_noise_density": float("nan")}, "accelerometer_noise_density is nan, expected"),
    ],
)
def test_what_is_wrong_is_named(change: dict[str, object], words: str) -> None:
    with pytest.raises(BadInputError) as caught:
        from_kalibr_imu({**yaml.safe_load(TEXT), **change})
    assert words in str(caught.value)
    with pytest.raises(BadInputError, match="update_rate is missing"):
        from_kalibr_imu(dict.fromkeys(KEYS, 1.0))
