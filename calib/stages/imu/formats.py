"""The noise of an IMU in Kalibr's imu.yaml, there and back.

Kalibr has one number for all axes of a sensor and no biases. Both use the same definitions: continuous-time
densities N [m/s^2/sqrt(Hz), rad/s/sqrt(Hz)] and K of the bias' random walk [m/s^3/sqrt(Hz),
rad/s^2/sqrt(Hz)], slopes -1/2 and +1/2 of the Allan deviation (IEEE Std 952-1997, C.1).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from calib.core.errors import BadInputError
from calib.core.files import one_line
from calib.core.writing import Kind, holds
from calib.stages.imu.section import Imu

_KEYS = {
    "accelerometer_noise_density": "accel_noise_mps2_per_sqrt_Hz",
    "accelerometer_random_walk": "accel_walk_mps3_per_sqrt_Hz",
    "gyroscope_noise_density": "gyro_noise_radps_per_sqrt_Hz",
    "gyroscope_random_walk": "gyro_walk_radps2_per_sqrt_Hz",
}


def from_kalibr(document: Mapping[str, Any]) -> Imu:
    """The section `imu` of an imu.yaml, which may also lie under `imu0` as in Kalibr's results.

    Raises `BadInputError` naming the key that is missing or wrong.
    """
    inner = document.get("imu0")
    if isinstance(inner, Mapping):
        document = inner
    if not any(key in document for key in _KEYS):
        raise BadInputError(f"{next(iter(_KEYS))} is missing")
    # A file may be of one sensor only, then of it whole.
    values = {}
    for key, name in _KEYS.items():
        sensor = key.split("_")[0]
        if any(other.startswith(sensor) for other in document if isinstance(other, str)):
            values[name] = _number(document, key)
    rate_hz = _number(document, "update_rate")
    if rate_hz == 0.0:
        raise BadInputError("update_rate is 0, expected a positive number")
    unknown = (
        "gyro_bias_radps", "gyro_instability_radps", "accel_mean_mps2", "accel_instability_mps2",
        "gyro_step_radps", "accel_step_mps2",
    )  # fmt: skip
    section: dict[str, Any] = {name: [None] * 3 for name in unknown}
    section |= {name: [values.get(name)] * 3 for name in _KEYS.values()}
    section |= {"rate_hz": rate_hz, "verdict": "poor"}
    section["reasons"] = ["Imported from Kalibr's imu.yaml, which holds no biases and no error bars."]
    return Imu.model_validate(section)


def _number(document: Mapping[str, Any], key: str) -> float:
    if key not in document:
        raise BadInputError(f"{key} is missing")
    value = document[key]
    if isinstance(value, str):
        # YAML 1.1 takes 2e-3 for text.
        try:
            value = float(value)
        except ValueError:
            value = None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInputError(f"{key} is {one_line(repr(document[key]))[:60]}, expected a number")
    if not math.isfinite(value) or value < 0.0:
        raise BadInputError(f"{key} is {value:g}, expected a number that is not negative")
    return float(value)


def _largest(section: Imu, key: str) -> tuple[float | None, bool]:
    """The largest of the axes, bounds counting where there is no estimate, and whether it is a bound."""
    estimates = [value for value in getattr(section, key) if value is not None]
    limits = [value for value in section.below.get(key, []) if value is not None]
    if not estimates and not limits:
        return None, False
    largest = max([*estimates, *limits])
    return largest, largest not in estimates


IMU_YAML = Kind("an imu.yaml of Kalibr", (".yaml", ".yml"), holds(b"rostopic: ", b"update_rate: "))


def to_kalibr(section: Imu, topic: str = "/imu0") -> str:
    """Kalibr's imu.yaml: densities in continuous time, of each sensor's worst axis.

    What the logs do not show is given by its upper bound, which a comment says; a sensor that was not
    logged has no keys.
    """
    lines = []
    for name, key in _KEYS.items():
        value, bound = _largest(section, key)
        unit = key.split("_", 2)[2].replace("_per_sqrt_Hz", "/sqrt(Hz)").replace("radps2", "rad/s^2")
        unit = unit.replace("mps3", "m/s^3").replace("mps2", "m/s^2").replace("radps", "rad/s")
        if value is not None:
            note = ", an upper bound: the log is too short to show it" if bound else ""
            lines.append(f"{name}: {value:.6e}  # {unit}{note}")
    lines += [f"rostopic: {topic}", f"update_rate: {section.rate_hz:.6f}"]
    return "\n".join(lines) + "\n"
