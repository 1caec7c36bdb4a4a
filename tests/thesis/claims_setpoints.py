"""Claims about feed-forward, set-points and the control of both bellows (4.2)."""

from __future__ import annotations

import math

import numpy as np

from calib.stages.actuator.kinematics import forward, inverse
from calib.stages.actuator.pump import ElongationForce
from calib.stages.control.laws import FeedForward, feed_forward
from calib.stages.control.references import Ellipse, PolynomialElongation
from thesis.outcome import Finding, claim, exactly, near, on_twin
from thesis.runs import PRINTED_C_DMP, nominal, tried, with_plant

__all__ = ["CLAIMS"]

_REST_M = 0.065
_START_M = 0.0681
_LONGEST_MM = 91.0
"""With both pumps at 12 V, by the text."""
_STATIC_MM = (-0.3034, -0.06754)


@claim(
    "ctl.ff",
    "4.6",
    "the feed-forward is a line through the steady elongations",
    "0 below 0.067 m, 5498.1 per m, 110",
    basis="printed",
)
def feedforward() -> Finding:
    line, law = FeedForward(), ElongationForce()
    u = np.linspace(110.0, 255.0, 300)
    length = _REST_M + 1e-3 * np.polyval(law.elongation_mm, law.supply_V * u / 255.0)
    inside = (length >= line.from_m) & (length <= 0.091)
    ours = np.array([feed_forward(line, q) for q in length[inside].tolist()])
    off = ours - u[inside]
    worst, slope = float(np.abs(off).max()), float(np.polyfit(length[inside], u[inside], 1)[0])
    at_91 = feed_forward(line, 0.091)
    return Finding(
        f"within {worst:.0f} PWM of (2.13), RMS {math.sqrt(float(np.mean(off**2))):.1f}",
        exactly(worst < 0.1 * 255.0),
        "line against the inverse of (2.13), with its typing error corrected, from 67 to 91 mm; a straight "
        f"fit to that curve has a slope of {slope:.0f} per m. At 91 mm it gives {at_91:.0f}, it saturates at "
        f"{1e3 * line.saturates_at_m:.1f} mm",
        {"worst_pwm": worst, "slope_pwm_per_m": slope, "at_91mm_pwm": at_91},
    )


@claim("ctl.setpoint", "4.7", "third-order set-point of the length", basis="equations")
def setpoint() -> Finding:
    free = PolynomialElongation(hold_s=100.0)
    at_5, at_10 = (1e3 * float(free.bellows_m(np.array(t))[0]) for t in (5.0, 10.0))
    return Finding(
        f"{at_5:.0f} mm at 5 s, {at_10:.0f} mm at 10 s",
        exactly(at_10 > 1e3 * _REST_M),
        "the printed polynomial, evaluated: it peaks at 5 s and then falls below any length an actuator can "
        "have; the figures show it held from there on",
        {"at_5s_mm": at_5, "at_10s_mm": at_10},
    )


@claim(
    "ctl.pdff_max",
    "4.2",
    "largest error with PD control and feed-forward on (4.7)",
    "2.149e-3 m",
    "plant",
    basis="chosen",
)
def largest_error() -> Finding:
    mm = tried("elongation")[1]["largest_error_mm"]
    return Finding(
        f"{1e-3 * (mm or math.nan):.3e} m",
        on_twin(near(mm, 2.149)),
        "simulated rig with the printed gains, from its rest length; the set-point begins 2 mm above it",
        {"largest_mm": mm or math.nan},
        simulated=True,
    )


@claim(
    "ctl.pdff_static",
    "4.2",
    "mean errors of both bellows after about 6 s",
    "-3.034e-4 m, -6.754e-5 m",
    "plant",
    basis="chosen",
)
def static_error() -> Finding:
    run, _ = tried("elongation")
    late = run.t_s >= 6.0
    wanted = PolynomialElongation().bellows_m(run.t_s)
    mm = 1e3 * np.mean((wanted - run.states[:, :2])[late], axis=0)
    return Finding(
        f"{1e-3 * mm[0]:.2e} m, {1e-3 * mm[1]:.2e} m",
        on_twin(all(near(float(ours), printed) for ours, printed in zip(mm, _STATIC_MM, strict=True))),
        "simulated rig, whose two pumps are alike; the printed errors lie on both sides of its own and have "
        "its sign, their difference is that of the real pumps",
        {"q1_mm": float(mm[0]), "q2_mm": float(mm[1])},
        simulated=True,
    )


@claim(
    "ctl.integral_delay",
    "4.2",
    "without feed-forward PID control does nothing for this long",
    "almost 2 s",
    "plant",
    basis="twin",
)
def integral_delay() -> Finding:
    run, _ = tried("elongation", controller="pid")
    stretched = run.states[:, 0] - _REST_M
    moves = float(np.nonzero(stretched > 5e-4)[0][0] * run.tick_s)
    first = float(np.nonzero(run.pwm[:, 0] >= 100.0)[0][0] * run.tick_s)
    return Finding(
        f"{moves:.2f} s",
        on_twin(near(moves, 2.0)),
        f"simulated rig: the output leaves the dead zone after {first:.2f} s, and then the length has grown "
        "by half a millimetre; the same effect, earlier",
        {"moves_s": moves, "leaves_dead_zone_s": first},
        simulated=True,
    )


@claim(
    "ctl.ellipse",
    "4.9",
    "the reference draws an ellipse of alpha and beta; phi_ref by a tangent",
    basis="equations",
)
def ellipse() -> Finding:
    radius, t = nominal().plant.bellows_radius_m, np.linspace(0.0, 20.0, 401)
    drawn = Ellipse()
    pose = drawn.pose(t)
    printed = pose.copy()
    printed[:, 2] = np.tan(pose[:, 0] / pose[:, 1])
    wide = float(np.abs(forward(inverse(printed, radius), radius)[:, 0]).max())
    exact = float(np.abs(forward(drawn.bellows_m(t, radius), radius)[:, :2] - pose[:, :2]).max())
    return Finding(
        f"{1e3 * wide:.1f} mm to each side instead of {1e3 * drawn.x_m:.0f}",
        exactly(near(wide, drawn.x_m, 0.05)),
        "bellows by (3.12) from the printed reference, and the head that they give: the chord of an arc "
        f"points at half its angle, so phi_ref = 2 atan(x / y), which returns the ellipse to {exact:.0e} m",
        {"half_width_m": wide, "exact_error_m": exact},
    )


@claim("ctl.ellipse_range", "4.2", "the ellipse lies within what the actuator reaches", basis="printed")
def ellipse_range() -> Finding:
    q = 1e3 * Ellipse().bellows_m(np.linspace(0.0, 20.0, 2001), nominal().plant.bellows_radius_m)
    low, high = float(q.min()), float(q.max())
    return Finding(
        f"q_ref from {low:.1f} to {high:.1f} mm",
        exactly(low >= 1e3 * _REST_M and high <= _LONGEST_MM),
        f"bellows of the exact reference, against the printed range of 65 to {_LONGEST_MM:.0f} mm; "
        "whether they "
        "are reached in time is another question",
        {"least_mm": low, "greatest_mm": high},
    )


@claim(
    "ctl.ellipse_wobble",
    "Fig. 4.16",
    "errors spike where the directions of the bellows change, between phases I, II and III, IV",
    "-",
    "plant",
    basis="chosen",
)
def ellipse_wobble() -> Finding:
    run, _ = tried("ellipse")
    t = run.t_s
    error = 1e3 * np.abs(Ellipse().bellows_m(t, run.plant.bellows_radius_m) - run.states[:, :2]).max(axis=1)
    late = t >= 2.0
    change = ((t >= 4.0) & (t <= 6.0)) | ((t >= 14.0) & (t <= 16.0))
    spike, rest = float(error[change].max()), float(np.sqrt(np.mean(error[late & ~change] ** 2)))
    return Finding(
        f"at most {spike:.2f} mm there, RMS {rest:.2f} mm elsewhere",
        on_twin(spike > 3.0 * rest),
        "simulated rig on the ellipse, a quarter and three quarters of the way round; a spike would be three "
        "times the rest. The source's own simulation does not show it either",
        {"spike_mm": spike, "rms_elsewhere_mm": rest},
        simulated=True,
    )


@claim(
    "ctl.initial",
    "Fig. 4.22",
    "started from 0.0681 m the simulation oscillates widely",
    "l(0) = 0.0681 m",
    "plant",
    basis="twin",
)
def initial() -> Finding:
    def ringing(damping_scale: float | None) -> float:
        rig = None if damping_scale is None else with_plant(damping_scale=damping_scale)
        run, _ = tried("elongation", 2.0, rig=rig, start_m=str(_START_M))
        nodes = run.trajectory.nodes[:, 0]
        # What comes back after the first fall, which is not yet an oscillation.
        low = int(np.argmin(nodes[:75]))
        return float(1e3 * (nodes[low : low + 60].max() - nodes[low]))

    ours, printed = ringing(None), ringing(PRINTED_C_DMP)
    return Finding(
        f"{printed:.1f} mm with the printed damping, {ours:.1f} mm with the nominal one",
        on_twin(printed > 1.0),
        "simulated rig from 3.1 mm beyond its rest length; how far the length comes back within 0.2 s of its "
        "first minimum. It rings with c_dmp of Table 3.2, and is damped with the pumps connected, as the "
        "experiment is",
        {"rebound_printed_mm": printed, "rebound_nominal_mm": ours},
        simulated=True,
    )


CLAIMS = (
    feedforward,
    setpoint,
    largest_error,
    static_error,
    integral_delay,
    ellipse,
    ellipse_range,
    ellipse_wobble,
    initial,
)
"""In the order of the source."""
