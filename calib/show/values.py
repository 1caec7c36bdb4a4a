"""Constants of rig.yaml as rows that a person reads: name, value, unit, standard deviation.

The unit is the end of the key, as everywhere in the file.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
BLANK = "\N{EN DASH}"
"""What stands for a value that is not there."""

_UNITS = {
    "_radps2_per_sqrt_Hz": "rad/s²/√Hz",
    "_radps_per_sqrt_Hz": "rad/s/√Hz",
    "_mps3_per_sqrt_Hz": "m/s³/√Hz",
    "_mps2_per_sqrt_Hz": "m/s²/√Hz",
    "_degps_per_sqrt_hz": "°/s/√Hz",
    "_deg_per_sqrt_hz": "°/√Hz",
    "_rad_per_sqrt_s": "rad/√s",
    "_m_per_sqrt_s": "m/√s",
    "_pwm_per_rad_s": "PWM/(rad s)",
    "_pwm_s_per_rad": "PWM s/rad",
    "_pwm_per_m_s": "PWM/(m s)",
    "_pwm_s_per_m": "PWM s/m",
    "_pwm_per_rad": "PWM/rad",
    "_pwm_per_m": "PWM/m",
    "_N_per_rad2": "N/rad²",
    "_N_per_m": "N/m",
    "_N_per_s": "N/s",
    "_Ns_per_m": "N s/m",
    "_px_per_m": "px/m",
    "_per_s2": "1/s²",
    "_per_s": "1/s",
    "_radps2": "rad/s²",
    "_radps": "rad/s",
    "_degps": "°/s",
    "_mps2": "m/s²",
    "_mps": "m/s",
    "_kPa": "kPa",
    "_ticks": "ticks",
    "_rad": "rad",
    "_deg": "°",
    "_pwm": "PWM",
    "_px": "px",
    "_mm": "mm",
    "_hz": "Hz",
    "_Hz": "Hz",
    "_db": "dB",
    "_kg": "kg",
    "_N": "N",
    "_V": "V",
    "_m": "m",
    "_s": "s",
}
_LISTED = ("covariance", "provenance", "logs", "margins", "candidates", "observer_gain", "prior_sigma")
"""Parts that are no constants, or are shown in figures and tables of their own."""
_LONGEST = 16


@dataclass(frozen=True)
class Constant:
    """One number of the rig; `sigma` is None where none is known."""

    section: str
    name: str
    value: float
    unit: str
    sigma: float | None

    @property
    def share(self) -> float | None:
        """Standard deviation over the value's size, None where that says nothing."""
        if self.sigma is None or self.value == 0.0:
            return None
        return self.sigma / abs(self.value)


def unit_of(key: str) -> str:
    """Unit at the end of a key, "" for a number without one."""
    return next((unit for end, unit in _UNITS.items() if key.endswith(end)), "")


def digits(value: float | None, sigma: float | None = None) -> str:
    """A value with the digits that its standard deviation leaves, else with six."""
    if value is None or not math.isfinite(value):
        return BLANK
    if sigma is not None and math.isfinite(sigma) and sigma > 0.0:
        places = 1 - math.floor(math.log10(sigma))
        if 0 <= places <= 12 and abs(value) < 1e9:
            return f"{value:.{places}f}"
    return f"{value:.6g}"


def short(value: float) -> str:
    """A value to four digits, whole numbers as they are."""
    if isinstance(value, int) or (value == round(value) and abs(value) < 1e7):
        return str(round(value))
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e7 else f"{value:.4g}"


def constants(sections: Mapping[str, Any]) -> list[Constant]:
    """All constants of a rig, in the file's order."""
    out: list[Constant] = []
    for section, values in sections.items():
        if section not in _LISTED and isinstance(values, dict):
            out += _of(section, values)
    return out


def _of(section: str, values: Mapping[str, Any]) -> Iterator[Constant]:
    sigma = values.get("sigma")
    bars = sigma if isinstance(sigma, dict) else {}
    for key, value in values.items():
        if key == "sigma" or key in _LISTED:
            continue
        yield from _numbers(section, str(key), value, bars.get(key), unit_of(str(key)), bars)


def _numbers(
    section: str, name: str, value: Any, sigma: Any, unit: str, bars: Mapping[str, Any]
) -> Iterator[Constant]:
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return
    if isinstance(value, int | float):
        yield Constant(section, name, float(value), unit, _number(sigma))
    elif isinstance(value, dict):
        for key, part in value.items():
            if key in _LISTED or key == "sigma":
                continue
            below = bars.get(key) if sigma is None else (sigma.get(key) if isinstance(sigma, dict) else None)
            own = unit_of(str(key)) or unit
            yield from _numbers(section, f"{name}.{key}", part, below, own, {})
    elif isinstance(value, list) and len(value) <= _LONGEST:
        for i, part in enumerate(value):
            bar = sigma[i] if isinstance(sigma, list) and i < len(sigma) else None
            if not isinstance(part, dict):
                yield from _numbers(section, f"{name}[{i}]", part, bar, unit, {})


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value)
