"""What an identification is worth in words: verdict, reasons, remarks and advice.

- unidentifiable: the logs cannot tell a parameter that they should.
- poor: the model does not explain the logs (residuals far above the noise, a held-back log predicted much
  worse than fitted), a parameter lies at a bound, or an important one is vague.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib.actuator.identify_fit import Solution
from calib.actuator.identify_next import Prospect
from calib.actuator.identify_parameters import PARAMETERS
from calib.actuator.identify_sigma import Colour, HeldLog, Uncertainty

__all__ = ["Judgement", "judge"]

_MOST_SCALE = 2.5
_MOST_INFLATION = 4.0
_MOST_HELD = 1.5
_MOST_RELATIVE = 0.25
_STRONG = 0.95
_FAR_ROWS = 0.05
_BY_NATURE = ("lambda3",)


@dataclass(frozen=True)
class Judgement:
    """Verdict "ok", "poor" or "unidentifiable", with sentences."""

    verdict: str
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]
    advice: tuple[str, ...]


def _bounds(solution: Solution) -> list[str]:
    out = []
    for name, value in solution.values.items():
        spec = PARAMETERS[name]
        near = 1e-3 * spec.scale
        if value - spec.low < near or spec.high - value < near:
            out.append(f"{name} lies at its bound {value:.4g} {spec.unit}".rstrip())
    return out


def _of_fit(solution: Solution, known: Uncertainty, colours: Sequence[Colour]) -> tuple[list[str], list[str]]:
    reasons, remarks = _bounds(solution), []
    if known.scale > _MOST_SCALE:
        reasons.append(
            f"the residuals are {known.scale:.1f} times what the sensor's noise explains; the model misses "
            "something, or the camera's jitter is larger than the rig's file says"
        )
    worst = max(known.inflation, key=lambda n: known.inflation[n])
    if known.inflation[worst] > _MOST_INFLATION:
        reasons.append(
            f"the residuals are so coloured that the deviation of {worst} had to be raised "
            f"{known.inflation[worst]:.1f} times"
        )
    for colour in colours:
        if not colour.white:
            remarks.append(
                f"{colour.name}: residuals are not white ({100.0 * colour.outside:.0f} % of the lags outside "
                f"the 95 % band, {max(colour.first, key=abs):+.2f} from row to row); deviations are raised"
            )
        if colour.share_far > _FAR_ROWS:
            reasons.append(f"{colour.name}: {100.0 * colour.share_far:.0f} % of the poses are far off")
    names = solution.problem.names
    close = [
        f"{names[i]} and {names[j]} {float(known.correlation[i, j]):+.2f}"
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if abs(float(known.correlation[i, j])) > _STRONG
    ]
    if close:
        remarks.append(f"hardly told apart, by their correlation: {', '.join(close)}")
    if solution.starts > 1 and solution.agreeing == 1:
        remarks.append(f"one of {solution.starts} starts alone came to this minimum; there may be others")
    return reasons, remarks


def judge(
    solution: Solution,
    known: Uncertainty,
    colours: Sequence[Colour],
    held: Sequence[HeldLog],
    next_ones: Sequence[Prospect],
) -> Judgement:
    """Judge an identification from what was computed of it."""
    blind = {name: why for name, why in solution.fixed.items() if "enter only" not in why}
    reasons = [f"{name} is not identifiable from these logs: {why}" for name, why in blind.items()]
    remarks = [f"{why}" for why in solution.fixed.values() if "enter only" in why]
    for name, value in solution.values.items():
        relative = known.sigma[name] / max(abs(value), 1e-12)
        if relative > _MOST_RELATIVE:
            reasons.append(f"{name} is known to {100.0 * relative:.0f} % only")
    more, said = _of_fit(solution, known, colours)
    for log in held:
        if log.held_phi_rad > _MOST_HELD * log.fitted_phi_rad + 1e-4:
            more.append(
                f"{log.name}: held back, its angle is predicted to {1e3 * log.held_phi_rad:.3g} mrad, "
                f"fitted to {1e3 * log.fitted_phi_rad:.3g} mrad"
            )
    if not held:
        said.append("one log alone: nothing is left to check the parameters on")
    advice = []
    if next_ones:
        best = next_ones[0]
        advice.append(
            f"next experiment: {best.name} ({best.what}); it would leave {best.worst} as the least known, "
            f"to {100.0 * best.worst_relative:.2g} %"
        )
    verdict = "unidentifiable" if blind else "poor" if reasons or more else "ok"
    return Judgement(verdict, tuple(reasons + more), tuple(remarks + said), tuple(advice))
