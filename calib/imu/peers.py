"""Orientation filters by others, run on the same log: the optional packages ahrs, imufusion and vqf.

Each takes three axes of both sensors and gives quaternions w, x, y, z from sensor to a world whose z axis
points up. All run with their authors' defaults and without a magnetometer. None is needed by anything
else here; what is not installed is named by `missing`.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from calib.arrays import FloatArray
from calib.errors import BadInputError, pip_install

_G = 9.80665

MOST_SAMPLES = {"Mahony": 300_000, "Madgwick": 300_000, "imufusion": 10_000_000}
"""Longest logs for peers whose loop is in Python; the first two take a minute for that."""


def _mahony(gyro: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    filters: Any = importlib.import_module("ahrs.filters")
    return np.asarray(filters.Mahony(gyr=gyro, acc=force, frequency=1.0 / period_s, k_P=1.0, k_I=0.3).Q)


def _madgwick(gyro: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    filters: Any = importlib.import_module("ahrs.filters")
    return np.asarray(filters.Madgwick(gyr=gyro, acc=force, frequency=1.0 / period_s).Q)


def _imufusion(gyro: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    fusion: Any = importlib.import_module("imufusion")
    settings = fusion.AhrsSettings()
    settings.sample_rate = 1.0 / period_s
    settings.convention = fusion.CONVENTION_ENU
    filter_ = fusion.Ahrs()
    filter_.set_settings(settings)
    degps, g = np.degrees(gyro), force / _G
    out = np.empty((len(gyro), 4))
    for k in range(len(gyro)):
        filter_.update_no_magnetometer(degps[k], g[k])
        out[k] = filter_.get_quaternion()
    return out


def _vqf(gyro: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    vqf: Any = importlib.import_module("vqf")
    return np.asarray(vqf.VQF(period_s).updateBatch(gyro, force)["quat6D"])


def _vqf_offline(gyro: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    vqf: Any = importlib.import_module("vqf")
    return np.asarray(vqf.offlineVQF(gyro, force, None, period_s)["quat6D"])


_RUNS: dict[str, tuple[str, Callable[[FloatArray, FloatArray, float], FloatArray]]] = {
    "Mahony": ("ahrs", _mahony),
    "Madgwick": ("ahrs", _madgwick),
    "imufusion": ("imufusion", _imufusion),
    "VQF": ("vqf", _vqf),
    "VQF offline": ("vqf", _vqf_offline),
}

PEERS = tuple(_RUNS)
"""In the order of tables. Mahony has Kp 1 and Ki 0.3, Madgwick 0.033, imufusion 0.5; the last looks ahead."""


def missing(name: str) -> str:
    """The package that a peer needs and that is not installed, or nothing.

    Raises `BadInputError` for a name that is none of `PEERS`.
    """
    if name not in _RUNS:
        raise BadInputError(f"peer: found {name!r}, expected one of {', '.join(PEERS)}")
    package = _RUNS[name][0]
    return "" if importlib.util.find_spec(package) is not None else package


def run_peer(name: str, gyro_radps: FloatArray, force_mps2: FloatArray, period_s: float) -> FloatArray:
    """Quaternions (n, 4) of a peer after each sample of an even grid.

    Parameters
    ----------
    gyro_radps, force_mps2 : (n, 3) finite readings.

    Raises
    ------
    BadInputError for an unknown name, a package that is not installed, and readings of another shape.
    """
    if package := missing(name):
        raise BadInputError(f"{name}: needs the package {package}: {pip_install('peers')}")
    for what, values in (("rates", gyro_radps), ("specific forces", force_mps2)):
        if values.ndim != 2 or values.shape[1] != 3 or len(values) != len(gyro_radps) or len(values) == 0:
            raise BadInputError(f"{name}: found {what} {values.shape}, expected (n, 3)")
    if not 0.0 < period_s < math.inf:
        raise BadInputError(f"{name}: found a period of {period_s:g} s, expected more than zero")
    gyro = np.ascontiguousarray(gyro_radps, dtype=np.float64)
    force = np.ascontiguousarray(force_mps2, dtype=np.float64)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        return _RUNS[name][1](gyro, force, period_s)
