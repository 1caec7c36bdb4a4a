"""Controllers and feed-forward: (4.4) and its summed form are one, and tables hold what they say."""

from __future__ import annotations

import numpy as np
import pytest
from firmware_rigs import rig

from calib.core.errors import BadInputError
from calib.stages.actuator.parameters import Stiffness
from calib.stages.actuator.pump import ElongationForce
from calib.stages.control.laws import Pid, PidState, step
from calib.stages.firmware.constants import Known, control_groups
from calib.stages.firmware.literals import literals, values


def _of(kind: str) -> dict[str, float]:
    return values(literals(control_groups(Known(rig(kind), "rig.yaml"), 60.0)))


def _summed(c: dict[str, float], errors: np.ndarray, clamping: bool) -> np.ndarray:
    KPDI, KD, half = (c[f"CALIB_ORIENTATION_{n}_PWM_PER_RAD"] for n in ("KPDI", "KD_PER_DT", "KI_HALF_DT"))
    P = e1 = 0.0
    out = []
    for e in errors:
        u = KPDI * e + (P - KD * e1)
        if clamping and not 0.0 <= u <= 255.0:
            u, P = u - half * (e + e1), P + half * (e - e1)
        else:
            P += 2.0 * half * e
        e1 = e
        out.append(u)
    return np.array(out)


@pytest.mark.parametrize("clamping", [False, True])
def test_the_summed_form_is_the_incremental_one(clamping: bool) -> None:
    """Random errors that cross both limits, against `calib.stages.control.laws`."""
    errors = 0.15 * np.cumsum(np.random.default_rng(1).normal(0.0, 0.3, 400))
    pid, state, wanted = Pid(1000.0, 1000.0, 10.0, clamping=clamping), PidState(), []
    for e in errors.tolist():
        state, u = step(pid, state, e)
        wanted.append(u)
    found = _summed(_of("nominal"), errors, clamping)
    assert np.abs(found - wanted).max() < 1e-6 * np.abs(wanted).max() + 1e-3


def test_the_incremental_factors_are_those_of_D9() -> None:
    c = _of("nominal")
    h = 1.0 / 60.0
    for i, value in enumerate((1000.0 + 500.0 * h + 10.0 / h, -1000.0 + 500.0 * h - 20.0 / h, 10.0 / h)):
        assert c[f"CALIB_ORIENTATION_E{i}_PWM_PER_RAD"] == pytest.approx(value)


def test_the_nominal_table_holds_the_lengths_of_the_pump() -> None:
    """PWM values of the table give the table's elongations by (2.13)."""
    c = _of("nominal")
    size, pump = int(c["CALIB_FF_TABLE_SIZE"]), ElongationForce()
    pwm = np.array([c[f"calib_ff_table_pwm[{i}]"] for i in range(size)])
    reached = 1e-3 * np.polyval(pump.elongation_mm, pump.supply_V * pwm / 255.0)
    inside = pwm < 253.0
    assert inside.sum() >= 12
    assert np.abs(np.maximum(reached, 0.0) - 0.002 * np.arange(size))[inside].max() < 2e-5
    assert (np.diff(pwm) > 0.0).all()


def test_the_tuned_table_balances_the_springs() -> None:
    c, tuned = _of("full"), rig("full").controller
    assert tuned is not None
    assert c["CALIB_FF_USE_TABLE"] == 1.0
    force, pwm = np.array(tuned.feedforward.force_pwm).T
    spring = Stiffness((47.7, 1092.9))
    for i in range(3, int(c["CALIB_FF_TABLE_SIZE"]) - 1):
        eps = 0.002 * i
        wanted = spring.secant(eps) * eps / 0.99
        assert np.interp(c[f"calib_ff_table_pwm[{i}]"], pwm, force) == pytest.approx(wanted, rel=1e-5)


def test_gains_of_the_tuned_controller_and_its_anti_windup() -> None:
    c = _of("full")
    assert c["CALIB_ORIENTATION_HAS_BACK"] == 1.0
    assert c["CALIB_ORIENTATION_CLAMPING"] == 0.0
    assert c["CALIB_ORIENTATION_BACK"] == pytest.approx(1.0 / 60.0 / 0.4)
    assert c["CALIB_ORIENTATION_KPDI_PWM_PER_RAD"] == pytest.approx(800.0 + 12.0 * 60.0 + 900.0 / 120.0)
    assert (c["CALIB_PUMP_LOW_PWM"], c["CALIB_PUMP_HIGH"]) == (5.0, 250.0)


def test_limits_that_no_register_holds_are_refused() -> None:
    tuned = rig("full").controller
    assert tuned is not None
    odd = rig("full").model_copy(update={"controller": tuned.model_copy(update={"pwm_high": 250.5})})
    with pytest.raises(
        BadInputError, match=r"pwm_low and pwm_high are 5 and 250\.5, expected rising whole numbers"
    ):
        control_groups(Known(odd, "rig.yaml"), 60.0)
