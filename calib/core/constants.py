"""Constants of rig.yaml as rows: section, name, value, unit, standard deviation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from calib.core.units import unit_of

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


def constants(sections: Mapping[str, Any]) -> list[Constant]:
    """All constants of a rig, in the file's order."""
    out: list[Constant] = []
    for section, values in sections.items():
        if section == "known":
            for part, stated in values.items():
                out += _of(f"known.{part}", stated)
        elif section not in _LISTED:
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
