"""The kind `pressure_arm` of the section `actuator`: a bending arm that `calib identify` has assembled."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import model_validator

from calib.core.result import NotNegative, Number, Positive, Result, Row3, Section, Sigma, quantity
from calib.stages.arm.model import (
    COMPLIANCE,
    DAILY,
    DRIVES,
    NO_JUMP_KPA,
    PARAMETERS,
    PARTS,
    Assembly,
    parameters_on_day,
)

_PLAIN_VALVE = {"input_s": 1e-4, "pilot_jump_kpa": NO_JUMP_KPA}
"""Parameters of a valve that files of earlier versions lack; there loads bend upright arms."""
_AS_SETTLING = {"lengthens_s": "settling_s", "lengthens_per_kpa": "settling_per_kpa"}
"""Parameters that files of earlier versions lack: there the chord recovered as the angle settled."""


class HeldTrial(Section):
    """Free-run errors on a trial that was not fitted, RMS over the whole trial."""

    angle_rad: NotNegative | None = None
    chord_m: NotNegative | None = None
    angle_by_pressure_rad: NotNegative | None = None


class Arm(Result):
    """An assembly of parts, identified from logs of pressure and motion capture.

    Attributes
    ----------
    parts : that play a part. parameters : by name.
    days : factors of parameters on each day, see `calib.stages.arm.model`; in files of earlier versions the
        factor of bends_rad_per_kpa alone.
    bending_axis : in the frame of the base; absent for poses in the plane.
    conjugated : whether the logs' quaternions map the world to the body.
    tip_mount : rotation vector of the tip's body in the frame of the base that is taken off, 0 of one that
        starts near the base's attitude.
    tip_zero_rad, tip_grows : of poses in the plane, from what angle they count and with what sign they grow.
    interval_rad : half the 95 % interval of the angle of a further trial, from the errors on held trials,
        which are from the pressure where logs have no command.
    coverage : share of the samples of held trials inside the interval that the others' errors give.
    held : free-run errors on each trial from a fit to the others.
    """

    kind: Literal["pressure_arm"] = "pressure_arm"
    parts: list[str]
    parameters: dict[str, Number]
    sigma: Sigma = {}
    days: dict[str, dict[str, Positive]] = {}
    bending_axis: Row3 | None = None
    conjugated: bool = False
    tip_mount: Row3 = [0.0, 0.0, 0.0]
    tip_zero_rad: Number = 0.0
    tip_grows: Number = 1.0
    chord_leans: NotNegative | None = quantity(None, label="chord's turn, of the tip's", digits=2)
    angle_error_rad: NotNegative | None = quantity(
        None, label="angle of a held trial", show="deg", digits=2, fact=True
    )
    chord_error_m: NotNegative | None = quantity(
        None, label="chord of a held trial", show="mm", digits=2, fact=True
    )
    by_pressure_error_rad: NotNegative | None = quantity(
        None, label="angle by pressure", show="deg", digits=2
    )
    interval_rad: NotNegative | None = quantity(None, label="95 % of a trial within", show="deg", digits=1)
    coverage: NotNegative | None = quantity(None, label="held samples inside", show="%", digits=0)
    held: dict[str, HeldTrial] = {}

    @model_validator(mode="before")
    @classmethod
    def _earlier(cls, section: Any) -> Any:
        if not isinstance(section, dict) or not isinstance(section.get("days", {}), dict):
            return section
        days = {
            day: one if isinstance(one, dict) else {"bends_rad_per_kpa": one}
            for day, one in section.get("days", {}).items()
        }
        out, parameters = section | {"days": days}, section.get("parameters")
        if isinstance(parameters, dict):
            earlier = dict(_PLAIN_VALVE) if "leak_per_s" in parameters else {}
            earlier |= dict.fromkeys(COMPLIANCE[1:], 0.0) if COMPLIANCE[0] in parameters else {}
            out["parameters"] = earlier | parameters
        return out

    @model_validator(mode="after")
    def _assembled(self) -> Arm:
        known = [part.name for part in PARTS]
        needed = [part.name for part in PARTS if not part.off and not part.drives]
        if any(one not in known for one in self.parts) or any(one not in self.parts for one in needed):
            raise ValueError(f"expected parts of {', '.join(known)}, with {', '.join(needed)}")
        if sum(one in DRIVES for one in self.parts) != 1:
            raise ValueError(f"expected one part of {', '.join(DRIVES)}")
        if set(self.parameters) | set(_AS_SETTLING) != set(self.assembly.names):
            raise ValueError("expected the parameters of its parts, all of them")
        strange = {name for day in self.days.values() for name in day} - set(DAILY)
        if strange:
            raise ValueError(f"expected factors of {', '.join(DAILY)}, not of {min(strange)}")
        wrong = [p.name for p in PARAMETERS if p.positive and self.parameters.get(p.name, 1.0) <= 0.0]
        if wrong:
            raise ValueError(f"expected {wrong[0]} above 0")
        return self

    @property
    def assembly(self) -> Assembly:
        """The parts that play a part."""
        return Assembly(tuple(self.parts))

    def parameters_on_day(self, day: str) -> dict[str, float]:
        """All parameters on a day, those of parts that are left out included."""
        values = self.parameters | self.assembly.off
        for name, earlier in _AS_SETTLING.items():
            values.setdefault(name, values[earlier])
        return parameters_on_day(day, values, self.days)
