"""What the page says of each stage: a few figures at its head, and tables of what the verb told.

A stage without words of its own gets tables of whatever lists its document has, so that the page of a
later verb is not empty.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from calib.rigvalues import BLANK, SIGMA, digits, short, unit_of

__all__ = ["Cell", "Table", "caption", "facts", "tables"]

Values = Mapping[str, Any]
Fact = tuple[str, str]

_CAPTIONS = {
    "camera_errors": "Reprojection errors of each view",
    "camera_residuals": "Residuals over the picture",
    "camera_coverage": "Where in the picture the board was seen",
    "camera_poses": "Poses of the board",
    "camera_sigma": "Standard deviation of a projected point over the picture",
    "camera_distortion": "Distortion of the lens over the picture",
    "camera_models": "Lens models compared on views held back",
    "camera_boards": "Shapes of the board compared on views held back",
    "plane_picture": "The board lying in the plane, with the world's axes",
    "plane_sigma": "Standard deviation in millimetres over the workspace",
    "plane_difference": "What a homography without the lens gets wrong",
    "lens_displacement": "What the lens displaces, in px and mm",
    "lens_inverse": "Error of the polynomial that undoes the lens",
    "imu_allan": "Allan deviation of every axis",
    "imu_drift": "Drift of the angle at rest",
    "imu_poses": "Rests in different poses",
    "imu_residuals": "Residuals of gravity over the poses",
    "tune_gains": "Frontier of the angle filter's gains",
    "tune_errors": "Errors of the angle on parts held back",
    "drift_angles": "Angle over time, by every filter",
    "drift_slopes": "Slopes of the angle with their intervals",
    "lowpass_response": "Response of the low-pass",
    "lowpass_log": "The low-pass on a log",
    "align_correlation": "Gyroscope against camera over the time offset",
    "control_margins": "Margins of the tuned loops",
}
_PARTS = {
    "states": f"States with their 2{SIGMA} bands",
    "errors": f"Errors against the truth, with 2{SIGMA}",
    "innovations": "Consistency: innovations of each sensor",
    "residuals": "Residuals",
    "static": "Signals at rest",
    "motion": "Angle in motion",
}
_ROWS = 200
_DEEP = 4


@dataclass(frozen=True)
class Cell:
    """A cell: what is shown, and the number by which it is sorted (None for text)."""

    text: str
    number: float | None = None


@dataclass(frozen=True)
class Table:
    """A table with a title; every row has as many cells as there are heads."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def caption(stem: str, logs: Sequence[str] = ()) -> str:
    """Words for a figure by its file's name; they serve readers who do not see it.

    A number at the end of the name counts the stage's `logs`.
    """
    if stem in _CAPTIONS:
        return _CAPTIONS[stem]
    words = stem.split("_")
    if words[-1].isdigit() and 1 <= int(words[-1]) <= len(logs):
        words[-1] = logs[int(words[-1]) - 1]
    for k in range(len(words) - 1, 0, -1):
        if words[k] in _PARTS:
            rest = " ".join(words[1:k] + words[k + 1 :])
            return f"{_PARTS[words[k]]}{f': {rest}' if rest else ''}"
    return stem.replace("_", " ")


def facts(stage: str, section: Values, document: Values) -> list[Fact]:
    """The few figures at the head of a stage, each with its unit."""
    made = _FACTS.get(stage)
    return [] if made is None else [(label, text) for label, text in made(section, document) if text]


def _value(values: Values, key: str, unit: str | None = None, factor: float = 1.0) -> str:
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return ""
    return f"{short(factor * value)} {unit_of(key) if unit is None else unit}".strip()


def _with_sigma(values: Values, key: str, unit: str, factor: float = 1.0) -> str:
    value, sigma = values.get(key), (values.get("sigma") or {}).get(key)
    if not isinstance(value, int | float):
        return ""
    if not isinstance(sigma, int | float):
        return f"{digits(factor * value)} {unit}".strip()
    return f"{digits(factor * value, factor * sigma)} ± {factor * sigma:.2g} {unit}".strip()


def _camera(section: Values, _: Values) -> list[Fact]:
    sigma = section.get("projection_sigma_px") or {}
    return [
        ("focal length", _with_sigma(section, "fx_px", "px")),
        ("RMS", _value(section, "rms_px")),
        ("views", _value(section, "views", "")),
        ("points", _value(section, "points", "")),
        (f"projection {SIGMA}, worst", _value(sigma, "max", "px") or "not bounded"),
        ("lens model", str(section.get("model", ""))),
    ]


def _plane(section: Values, _: Values) -> list[Fact]:
    sigma = section.get("sigma_marker_mm") or {}
    return [
        ("RMS on the plane", _value(section, "rms_mm")),
        (f"calibration {SIGMA}, worst", _value(sigma, "calibration_max", "mm")),
        (f"whole-pixel {SIGMA}", _value(sigma, "quantisation_max", "mm")),
        ("without the lens, up to", _value(section.get("without_intrinsics") or {}, "difference_max_mm")),
    ]


def _lens(section: Values, _: Values) -> list[Fact]:
    return [
        ("kind", str(section.get("kind", ""))),
        ("displacement, worst", _value(section, "max_px")),
        ("neglecting it, up to", _value(section, "plane_max_mm")),
        ("inverse's error", _value(section.get("inverse") or {}, "max_error_px")),
    ]


def _imu(section: Values, _: Values) -> list[Fact]:
    bias = section.get("gyro_bias_radps") or [None] * 3
    noise = section.get("gyro_noise_radps_per_sqrt_Hz") or [None] * 3
    drift = (section.get("drift") or {}).get("gyro") or {}
    return [
        ("rate", _value(section, "rate_hz")),
        ("gyro bias z", _value({"v": bias[2]}, "v", "rad/s")),
        ("gyro noise z", _value({"v": noise[2]}, "v", "rad/s/√Hz")),
        ("drift of the angle", _value(drift, "mean_degps")),
    ]


def _tune(section: Values, _: Values) -> list[Fact]:
    candidates = section.get("candidates") or {}
    chosen = candidates.get(str(section.get("recommended"))) or {}
    return [
        ("recommended", str(section.get("recommended", ""))),
        ("Kp", _value(section, "Kp_per_s")),
        ("Ki", _value(section, "Ki_per_s2")),
        ("held-out error", _value(chosen, "rmse_deg")),
        ("of 3/3", _value(candidates.get("3/3") or {}, "rmse_deg")),
    ]


def _lowpass(section: Values, _: Values) -> list[Fact]:
    return [
        ("filter", f"{section.get('family', '')}, order {section.get('order', '')}"),
        ("cut-off", _value(section, "cutoff_hz")),
        ("delay at rest", _value(section, "dc_delay_s", "ms", 1e3)),
        ("rate", _value(section, "rate_hz")),
    ]


def _align(section: Values, _: Values) -> list[Fact]:
    degree = math.degrees(1.0)
    return [
        ("time offset", _with_sigma(section, "time_offset_s", "ms", 1e3)),
        ("rest angle", _with_sigma(section, "rest_angle_rad", "°", degree)),
        ("gyro bias", _with_sigma(section, "gyro_bias_radps", "°/s", degree)),
        ("tracker's jitter", _value(section, "jitter_px")),
    ]


def _identify(section: Values, _: Values) -> list[Fact]:
    return [
        ("stiffness, of the nominal", _with_sigma(section, "stiffness_scale", "")),
        ("bending", _with_sigma(section, "bending_N_per_rad2", "N/rad²")),
        ("pumps' lag", _with_sigma(section, "lag_s", "s")),
        ("deflation", _with_sigma(section, "falling_N_per_s", "N/s")),
    ]


def _control(section: Values, _: Values) -> list[Fact]:
    turn, move = section.get("orientation") or {}, section.get("position") or {}
    return [
        ("angle, Kp", _value(turn, "Kp_pwm_per_rad")),
        ("angle, Ki", _value(turn, "Ki_pwm_per_rad_s")),
        ("lengths, Kp", _value(move, "Kp_pwm_per_m")),
        ("tick", _value(section, "tick_s", "ms", 1e3)),
    ]


def _firmware(_: Values, document: Values) -> list[Fact]:
    return [
        ("constants", _value(document, "constants", "")),
        ("files", ", ".join(str(name) for name in document.get("files") or ())),
    ]


_FACTS: dict[str, Callable[[Values, Values], list[Fact]]] = {
    "intrinsics": _camera,
    "extrinsics": _plane,
    "distortion": _lens,
    "imu-static": _imu,
    "imu-tune": _tune,
    "lowpass": _lowpass,
    "align": _align,
    "identify": _identify,
    "control": _control,
    "firmware": _firmware,
}


def tables(document: Values) -> list[Table]:
    """A table for each list or mapping of records in a verb's document, in its order."""
    out: list[Table] = []
    _search(document, (), out)
    return out


def _search(value: Any, path: tuple[str, ...], out: list[Table]) -> None:
    if len(path) > _DEEP:
        return
    if isinstance(value, dict):
        if len(path) > 1 and len(value) > 1 and all(isinstance(part, dict) for part in value.values()):
            out += _table(path, [{"": name, **part} for name, part in value.items()])
            return
        for name, part in value.items():
            if name not in ("sigma", "covariance", "schema", "verb", "per_view"):
                _search(part, (*path, str(name)), out)
    elif isinstance(value, list) and value and all(isinstance(part, dict) for part in value):
        out += (
            _table((*path[:-1], "models"), _compared(value)) if "models" in value[0] else _table(path, value)
        )


def _compared(logs: Sequence[Values]) -> list[Values]:
    """A record for each log and model of `calib validate`, the errors of each quantity beside each other."""
    out: list[Values] = []
    for log in logs:
        models = log.get("models")
        for model, quantities in (models if isinstance(models, dict) else {}).items():
            row: dict[str, Any] = {"log": log.get("log"), "model": model}
            for name, errors in (quantities if isinstance(quantities, dict) else {}).items():
                for key, value in (errors if isinstance(errors, dict) else {}).items():
                    row[f"{name} {key}"] = value
            out.append(row)
    return out


def _table(path: tuple[str, ...], records: Sequence[Values]) -> list[Table]:
    heads = [name for name in dict.fromkeys(k for r in records for k in r) if _tells(name, records)]
    if not heads:
        return []
    title = " ".join(path[-2:]).replace("_", " ")
    rows = tuple(tuple(_cell(record.get(name)) for name in heads) for record in records[:_ROWS])
    return [Table(title, tuple(_head(name) for name in heads), rows)]


def _tells(name: str, records: Sequence[Values]) -> bool:
    """Whether a column holds single values, and not only blanks."""
    values = [record.get(name) for record in records]
    if any(isinstance(value, dict) or (isinstance(value, list) and len(value) > 3) for value in values):
        return False
    return any(value not in (None, [], "") for value in values)


def _head(name: str) -> str:
    unit = unit_of(name)
    if not unit:
        return name.replace("_", " ") or "name"
    end = next(n for n in range(1, len(name)) if unit_of(name[n - 1 :]) == unit and unit_of(name[n:]) != unit)
    return f"{name[: end - 1].replace('_', ' ')}, {unit}"


def _cell(value: Any) -> Cell:
    if value is None or value == []:
        return Cell(BLANK)
    if isinstance(value, bool):
        return Cell("yes" if value else "no")
    if isinstance(value, int | float):
        return Cell(short(value), float(value))
    if isinstance(value, list):
        return Cell("  ".join(_cell(part).text for part in value))
    return Cell(str(value))
