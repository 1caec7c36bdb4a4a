"""Units at the ends of keys; numbers and quantities as people type them, read into SI."""

from __future__ import annotations

import math
import re

from calib.core.errors import UsageError

GRAVITY_MPS2 = 9.80665
"""Standard gravity, by which accelerations in g are read."""

UNITS = {
    "_radps2_per_sqrt_Hz": "rad/s²/√Hz",
    "_radps_per_sqrt_Hz": "rad/s/√Hz",
    "_mps3_per_sqrt_Hz": "m/s³/√Hz",
    "_mps2_per_sqrt_Hz": "m/s²/√Hz",
    "_degps_per_sqrt_Hz": "°/s/√Hz",
    "_degps_per_sqrt_hz": "°/s/√Hz",
    "_deg_per_sqrt_Hz": "°/√Hz",
    "_deg_per_sqrt_hz": "°/√Hz",
    "_rad_per_sqrt_s": "rad/√s",
    "_rad_per_sqrt_Hz": "rad/√Hz",
    "_m_per_sqrt_s": "m/√s",
    "_pwm_per_rad_s": "PWM/(rad s)",
    "_pwm_s_per_rad": "PWM s/rad",
    "_pwm_per_m_s": "PWM/(m s)",
    "_pwm_s_per_m": "PWM s/m",
    "_pwm_per_rad": "PWM/rad",
    "_pwm_per_m": "PWM/m",
    "_N_per_rad2": "N/rad²",
    "_N_per_m4": "N/m⁴",
    "_N_per_m3": "N/m³",
    "_N_per_m2": "N/m²",
    "_N_per_m": "N/m",
    "_N_per_s": "N/s",
    "_Ns_per_m": "N s/m",
    "_px_per_m": "px/m",
    "_s2_per_N": "s²/N",
    "_per_s2": "1/s²",
    "_per_s": "1/s",
    "_radps2": "rad/s²",
    "_radps": "rad/s",
    "_degps": "°/s",
    "_mps2": "m/s²",
    "_mps": "m/s",
    "_kgm2": "kg m²",
    "_kPa": "kPa",
    "_kpa": "kPa",
    "_ticks": "ticks",
    "_rad": "rad",
    "_deg": "°",
    "_pwm": "PWM",
    "_px": "px",
    "_mm": "mm",
    "_ms": "ms",
    "_hz": "Hz",
    "_Hz": "Hz",
    "_db": "dB",
    "_kg": "kg",
    "_N": "N",
    "_V": "V",
    "_m": "m",
    "_s": "s",
}


def unit_of(key: str) -> str:
    """Unit at the end of a key, "" for a number without one."""
    return next((unit for end, unit in UNITS.items() if key.endswith(end)), "")


_LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
_FREQUENCIES = {"hz": 1.0, "khz": 1e3}
_ANGLES = {"deg": math.pi / 180.0, "rad": 1.0}
_MASSES = {"g": 1e-3, "kg": 1.0}
_DURATIONS = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zA-Z]*)\s*")
_PAIR = re.compile(r"\s*(\d{1,6})\s*[xX\u00d7,]\s*(\d{1,6})\s*")


def plain_number(word: str) -> float | None:
    """A cell's decimal number, nan and inf included; None for other words.

    Python's own syntax of numbers has underscores, a table's has not.
    """
    try:
        return float(word) if "_" not in word else None
    except ValueError:
        return None


def _quantity(text: str, units: dict[str, float], what: str, example: str, least: str = "above 0") -> float:
    found = _QUANTITY.fullmatch(text)
    if found is None:
        raise UsageError(f"{what}: {text!r} is not a number with a unit, expected for instance {example}")
    number, unit = found.groups()
    if unit.lower() not in units:
        has = f"the unit {unit!r}" if unit else "no unit"
        raise UsageError(
            f"{what}: {text!r} has {has}, expected one of {', '.join(units)}, for instance {example}"
        )
    value = float(number) * units[unit.lower()]
    if not math.isfinite(value):
        raise UsageError(f"{what}: {text!r} is too large")
    if least == "above 0" and value <= 0.0:
        raise UsageError(f"{what}: {text!r} is not positive")
    if least == "0" and value < 0.0:
        raise UsageError(f"{what}: {text!r} is negative")
    return value


def parse_length_m(text: str, what: str) -> float:
    """Metres from '20mm', '2 cm', '0.02m' or '1in'; positive."""
    return _quantity(text, _LENGTHS, what, "20mm")


def parse_square_m(text: str, what: str = "--square") -> float:
    """Metres of a square's side from '20mm'; from 0.01 mm to 10 m, as in board.yaml."""
    value = parse_length_m(text, what)
    if not 1e-5 <= value < 10.0:
        raise UsageError(f"{what}: {text!r} is not between 0.01 mm and 10 m")
    return value


def parse_jitter(text: str, what: str = "--jitter") -> tuple[float, str]:
    """Metres and "m" from '0.1mm', or pixels and "px" from '0.3px'; positive."""
    value = _quantity(text, {**_LENGTHS, "px": 1.0}, what, "0.1mm or 0.3px")
    return value, "px" if text.strip().lower().endswith("px") else "m"


def parse_mass_kg(text: str, what: str) -> float:
    """Kilograms from '200g' or '0.2 kg'; not negative."""
    return _quantity(text, _MASSES, what, "200g", "0")


def parse_frequency_hz(text: str, what: str) -> float:
    """Hertz from '60Hz' or '1.5 kHz'; positive."""
    return _quantity(text, _FREQUENCIES, what, "60Hz")


def parse_duration_s(text: str, what: str) -> float:
    """Seconds from '10s', '500 ms', '2min' or '1h'; positive."""
    return _quantity(text, _DURATIONS, what, "10s")


def parse_angle_rad(text: str, what: str) -> float:
    """Radians from '30deg' or '0.5rad'."""
    return _quantity(text, _ANGLES, what, "30deg", "")


def _pair(text: str, what: str, example: str) -> tuple[int, int]:
    found = _PAIR.fullmatch(text)
    if found is None:
        raise UsageError(f"{what}: {text!r} is not two whole numbers, expected for instance {example}")
    return int(found.group(1)), int(found.group(2))


def parse_corners(text: str, what: str = "--corners") -> tuple[int, int]:
    """Inner corners, columns and rows, from '9x6'; at least 3 x 3, at most 200 x 200."""
    columns, rows = _pair(text, what, "9x6")
    if not (min(columns, rows) >= 3 and max(columns, rows) <= 200):
        raise UsageError(f"{what}: {text!r} is not between 3x3 and 200x200 inner corners")
    return columns, rows


def parse_image_size(text: str, what: str = "--image-size") -> tuple[int, int]:
    """Width and height in pixels from '640x480'."""
    width, height = _pair(text, what, "640x480")
    if min(width, height) < 1 or max(width, height) > 100_000:
        raise UsageError(f"{what}: {text!r} is not a picture's size, expected sides of 1 to 100000 px")
    return width, height


def _numbers(text: str, what: str, count: int, expected: str) -> list[float]:
    """So many finite numbers with commas between them."""
    values = [plain_number(part.strip()) for part in text.split(",")]
    numbers = [one for one in values if one is not None and math.isfinite(one)]
    if not len(numbers) == len(values) == count:
        raise UsageError(
            f"{what}: {text!r} is not {'two' if count == 2 else 'four'} finite numbers, expected {expected}"
        )
    return numbers


def parse_pwm_limits(text: str, what: str = "--pwm-limits") -> tuple[float, float]:
    """Two PWM values from '0,255'."""
    low, high = _numbers(text, what, 2, "for instance 0,255")
    return low, high


def parse_pixel(text: str, what: str = "--at") -> tuple[float, float]:
    """A pixel from 'u,v'."""
    u, v = _numbers(text, what, 2, "u,v in pixels")
    return u, v


def parse_region_px(text: str, what: str = "--region") -> tuple[float, float, float, float]:
    """A box in pixels from 'u0,v0,u1,v1', left before right and upper before lower."""
    u0, v0, u1, v1 = _numbers(text, what, 4, "u0,v0,u1,v1 in pixels")
    if not (u0 < u1 and v0 < v1):
        raise UsageError(f"{what}: {text!r} is not a box, expected u0 < u1 and v0 < v1")
    return u0, v0, u1, v1
