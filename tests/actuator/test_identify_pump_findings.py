"""Groups of settled runs, departures and jumps in runs that are made to have them."""

from __future__ import annotations

import numpy as np
from identifytrials import LAG_TRUTH, pump_records

from calib.actuator.identify_pump import fit_pump
from calib.actuator.identify_pump_findings import departures, jumps, settled_groups
from calib.actuator.identify_pump_models import LAG, PumpRecord, simulate_pump

T = 0.02 * np.arange(250)
PWM = np.where(T > 0.03, 255.0, 0.0)


def _run(name: str, extra: np.ndarray | float = 0.0) -> PumpRecord:
    clean = simulate_pump(LAG, LAG_TRUTH, PumpRecord(name, T, PWM, 0.0 * T), start_s=-1.0)
    return PumpRecord(name, T, PWM, clean + extra)


def test_runs_that_settle_apart_are_told_apart() -> None:
    late = 6.0 * np.clip(T - 2.0, 0.0, 1.0)
    groups = settled_groups([_run("a"), _run("b", 0.1), _run("c", late)])
    assert [g.names for g in groups] == [("a", "b"), ("c",)]
    assert abs(groups[1].value - groups[0].value - 6.0) < 0.2
    assert groups[0].pwm == (255.0, 255.0)
    low = PumpRecord("low", T, 0.5 * PWM, _run("low").value)
    assert settled_groups([low]) == ()


def test_a_departure_is_dated_and_the_pwm_acquitted_or_not() -> None:
    fit = fit_pump(pump_records(LAG, LAG_TRUTH), LAG)
    late = 6.0 * np.clip(T - 2.0, 0.0, 1.0)
    (gone,) = departures(fit, [_run("a"), _run("c", late)])
    assert gone.name == "c"
    assert abs(gone.at_s - 2.0) < 0.2
    assert gone.error > 4.0
    assert not gone.pwm_moved
    run = _run("d", late)
    moved = PumpRecord("d", T, np.where((T > 1.9) & (T < 1.96), 200.0, PWM), run.value)
    assert departures(fit, [moved])[0].pwm_moved


def test_a_jump_at_the_start_is_found() -> None:
    leap = 4.0 * (T > 0.13)
    found = jumps([_run("a"), _run("b", leap)])
    assert [name for name, _, _ in found] == ["b"]
    assert abs(found[0][1] - 4.0) < 1.2
