"""Claim about the low-pass of the camera's positions (2.2.2)."""

from __future__ import annotations

import numpy as np

from calib.stages.actuator.kinematics import forward
from calib.stages.lowpass.filters import Design, dc_delay_s, design_lowpass, filter_signal, frequency_response
from thesis.outcome import Finding, claim, on_twin
from thesis.runs import tried

__all__ = ["CLAIMS"]

_SWING_HZ = 4.0
_MOST_LOST = 0.05


@claim(
    "lp.cutoff",
    "2.2.2",
    "a low-pass at 1 Hz smooths the positions, keeps the motion and delays it little",
    "delay not printed",
    "plant",
    basis="twin",
)
def cutoff() -> Finding:
    filters = {order: design_lowpass(Design(1.0, 60.0, order)) for order in (1, 2)}
    delays = {order: dc_delay_s(f.exact, 60.0) for order, f in filters.items()}
    run, _ = tried("orientation")
    x = forward(run.states[:, :2], run.plant.bellows_radius_m)[:, 0]
    smooth = filter_signal(filters[1].exact, x)
    kept, late_m = float(np.ptp(smooth) / np.ptp(x)), float(np.abs(smooth - x).max())
    swing = float(np.abs(frequency_response(filters[1].exact, np.array([_SWING_HZ]), 60.0)[0]))
    return Finding(
        f"delay {delays[1]:.3f} s of order 1, {delays[2]:.3f} s of order 2",
        on_twin(kept > 1.0 - _MOST_LOST),
        "delay at zero frequency at 60 Hz, the order is not printed. Of the simulated head's x under PID "
        f"control with a jump order 1 keeps {100.0 * kept:.0f} % of the range, and being late it is up to "
        f"{1e3 * late_m:.1f} mm off; of a free swing at 4 Hz it keeps {100.0 * swing:.0f} %",
        {
            "delay_order1_s": delays[1],
            "delay_order2_s": delays[2],
            "kept_jump": kept,
            "kept_4hz": swing,
            "late_m": late_m,
        },
        simulated=True,
    )


CLAIMS = (cutoff,)
