"""The section `controller`: written, read again, and refused key by key."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from control_models import NOMINAL

from calib.control.computed_torque import ComputedTorque
from calib.control.observer import design_observer
from calib.control.tuning import Criterion, Tuned, tune_orientation, tune_position
from calib.controlsections import controller_section, source_margins
from calib.errors import BadInputError
from calib.rig import Rig, read_rig, rig_text
from calib.rig_controller import Controller

GOOD = {
    "clamping": {"overshoot_after_jump_rad": 0.12, "rise_s": 1.2},
    "back_calculation": {"overshoot_after_jump_rad": 0.01, "rise_s": 0.9},
}


@pytest.fixture(scope="module")
def tuned() -> tuple[Tuned, Tuned]:
    criterion = Criterion()
    return tune_orientation(NOMINAL, criterion), tune_position(NOMINAL, criterion)


def _section(tuned: tuple[Tuned, Tuned], anti: dict[str, dict[str, float]]) -> Controller:
    observer = design_observer(NOMINAL)
    return controller_section(NOMINAL, Criterion(), *tuned, 0.5, 0.25, anti, observer, ComputedTorque())


def test_it_is_read_as_it_was_written(tuned: tuple[Tuned, Tuned], tmp_path: Path) -> None:
    section = _section(tuned, GOOD)
    path = tmp_path / "rig.yaml"
    path.write_text(rig_text(Rig(controller=section)))
    assert read_rig(path).controller == section
    assert rig_text(Rig(controller=section)) == path.read_text()


def test_the_map_in_it_is_the_model_s(tuned: tuple[Tuned, Tuned]) -> None:
    """Straight lines between its 41 pairs, as a microcontroller reads them, are within a PWM value."""
    import numpy as np

    from calib.control.inverse_model import feed_forward_pwm, holding_force

    known = _section(tuned, GOOD).feedforward
    q = np.random.default_rng(2).uniform(0.0665, 0.089, size=(300, 2))
    eps = q - known.rest_length_m
    k0, k1, k2, k3 = known.stiffness_N_per_m
    F = (k0 + eps * (k1 + eps * (k2 + eps * k3))) * eps
    phi = (q[:, 0] - q[:, 1]) / (2.0 * known.bellows_radius_m)
    F += (known.bending_N_per_rad2 * phi * np.abs(phi))[:, None] * np.array([1.0, -1.0])
    assert holding_force(NOMINAL.plant, q) == pytest.approx(F, abs=1e-9)
    table = np.array(known.force_pwm)
    inside = (F > 0.02) & (table[-1, 0] > F)
    pwm = np.interp(F, table[:, 0], table[:, 1])
    assert np.abs(pwm - feed_forward_pwm(NOMINAL, q))[inside].max() < 1.0


def test_the_verdict(tuned: tuple[Tuned, Tuned]) -> None:
    assert _section(tuned, GOOD).verdict == "ok"
    slow = {**GOOD, "back_calculation": {"overshoot_after_jump_rad": 0.05, "rise_s": 1.5}}
    poor = _section(tuned, slow)
    assert poor.verdict == "poor" and len(poor.reasons) == 2
    assert "overshoots by 0.050 rad" in poor.reasons[0] and "later than with clamping" in poor.reasons[1]


def test_the_source_s_margins_beside(tuned: tuple[Tuned, Tuned]) -> None:
    told = source_margins(NOMINAL, *tuned)
    assert not all(row.stable for row in told["PID 1000/1000/10"])
    assert all(row.stable for row in told["PD 15000/150"])
    assert [row.q_m for row in told["PD 10000/1000"]] == [
        row.q_m for row in _section(tuned, GOOD).margins if row.loop == "position"
    ]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda c: c.update(pwm_low=200.0, pwm_high=100.0), "expected pwm_low below pwm_high|pwm_low below"),
        (lambda c: c.update(pwm_high=300.0), "controller.pwm_high is 300.0"),
        (lambda c: c.update(tick_s="1/60"), "controller.tick_s is '1/60', expected a number"),
        (lambda c: c["orientation"].update(Kp_pwm_per_rad=-1.0), "controller.orientation.Kp_pwm_per_rad"),
        (lambda c: c["orientation"].update(back_calculation_s=0.0), "back_calculation_s is 0.0"),
        (lambda c: c["orientation"].update(sign=2), "controller.orientation.sign is 2"),
        (lambda c: c["criterion"].update(gain_margin=0.5), "controller.criterion.gain_margin is 0.5"),
        (lambda c: c["position"].update(Kq=1.0), "controller.position.Kq is not a key"),
        (lambda c: c.pop("feedforward"), "controller.feedforward is missing"),
        (lambda c: c["feedforward"].update(force_pwm=[[0.0, 0.0]]), "force_pwm is"),
    ],
)
def test_values_that_cannot_be(
    tuned: tuple[Tuned, Tuned], tmp_path: Path, change: Callable[[dict[str, Any]], None], sentence: str
) -> None:
    document = yaml.safe_load(rig_text(Rig(controller=_section(tuned, GOOD))))
    change(document["controller"])
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(BadInputError, match=sentence):
        read_rig(path)
