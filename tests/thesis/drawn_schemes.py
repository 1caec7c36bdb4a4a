"""The control schemes of Figs. 4.6 and 4.10, with the values of one tick of a run on their wires."""

from __future__ import annotations

import numpy as np

from calib.stages.actuator.pump import PWM_MAX
from calib.stages.control.laws import FeedForward, Pid, feed_forward
from thesis.drawn import Box, Diagram, Wire, drawn
from thesis.drawn_angle import WANTED_RAD, angle_run, unsaturated
from thesis.drawn_ellipse import ellipse_run, seen_lengths, wanted_ellipse

__all__ = ["FIGURES"]

_EARLY_S, _ELLIPSE_S = 0.4, 7.0


@drawn("4.6", "scheme_with_clamping", "Scheme of the angle's control with integrator clamping")
def clamping() -> Diagram:
    run = angle_run("clamping", seconds=10.0)
    assert run.seen is not None
    k = round(_EARLY_S / run.tick_s)
    phi, sent = float(run.seen[k, 0]), run.pwm[k].tolist()
    u = unsaturated(run, Pid(1000.0, 1000.0, 10.0, clamping=True))[k].tolist()
    outside = [not 0.0 <= value <= PWM_MAX for value in u]
    boxes = (
        Box(1.8, 2.0, "-", 0.6, 0.6, round=True),
        Box(4.2, 2.0, "PID (4.4)", 1.6, 1.0),
        Box(7.4, 2.0, "limit\n0 to 255", 1.6, 1.0),
        Box(10.4, 2.0, "pumps and\nactuator", 1.8, 1.0),
        Box(7.4, 3.8, "outside?\nthen Ki = 0", 1.8, 0.9),
        Box(7.0, 0.3, "MM filter (2.3)", 2.0, 0.8),
    )
    answers = ", ".join("yes" if one else "no" for one in outside)
    wires = (
        Wire(((-0.4, 2.0), (1.5, 2.0)), f"reference\n{WANTED_RAD:.3f} rad", (0.3, 2.6)),
        Wire(((2.1, 2.0), (3.4, 2.0)), f"error\n+-{WANTED_RAD - phi:.3f} rad", (2.7, 2.6)),
        Wire(((5.0, 2.0), (6.6, 2.0)), f"u\n{u[0]:.0f}, {u[1]:.0f}", (5.8, 1.4)),
        Wire(((8.2, 2.0), (9.5, 2.0)), f"PWM\n{sent[0]:.0f}, {sent[1]:.0f}", (8.85, 2.6)),
        Wire(((11.3, 2.0), (13.0, 2.0)), f"angle\n{run.phi_rad[k]:.3f} rad", (12.2, 2.6)),
        Wire(((5.8, 2.0), (5.8, 3.65), (6.5, 3.65))),
        Wire(((6.5, 4.0), (4.2, 4.0), (4.2, 2.5)), answers, (5.2, 4.3)),
        Wire(((12.4, 2.0), (12.4, 0.3), (8.0, 0.3)), "acceleration, rate", (10.2, -0.05)),
        Wire(((6.0, 0.3), (1.8, 0.3), (1.8, 1.7)), f"angle {phi:.3f} rad", (3.8, -0.05)),
    )
    first = "lies beyond the limits and is computed without its integral"
    second = "is within the limits and has its integral"
    return Diagram(
        boxes,
        wires,
        f"{_EARLY_S:g} s after the beginning of the run with clamping of Fig. 4.7; two controllers with "
        "errors of "
        "opposite sign",
        " ".join(f"Output {i + 1} {first if out else second}." for i, out in enumerate(outside)),
        {"phi_rad": phi, "error_rad": WANTED_RAD - phi, "u1_pwm": u[0], "u2_pwm": u[1], "sent1_pwm": sent[0]},
    )


@drawn("4.10", "scheme_with_feed_forward", "Scheme of the control of both bellows with feed-forward")
def with_feedforward() -> Diagram:
    run = ellipse_run()
    k = round(_ELLIPSE_S / run.tick_s)
    wanted, seen = wanted_ellipse()[k], seen_lengths(run)[k]
    extra = np.array([feed_forward(FeedForward(), q) for q in wanted.tolist()])
    error = wanted - seen
    before = wanted_ellipse()[k - 1] - seen_lengths(run)[k - 1]
    feedback = 10000.0 * error + 1000.0 * (error - before) / run.tick_s
    sent = run.pwm[k]

    def pair(values: np.ndarray, form: str) -> str:
        return ", ".join(format(v, form) for v in values.tolist())

    boxes = (
        Box(1.8, 2.0, "-", 0.6, 0.6, round=True),
        Box(4.2, 2.0, "PD (4.8)", 1.6, 1.0),
        Box(4.2, 3.9, "feed-forward\n(4.6)", 2.0, 0.9),
        Box(6.4, 2.0, "+", 0.6, 0.6, round=True),
        Box(8.4, 2.0, "limit\n0 to 255", 1.5, 1.0),
        Box(11.1, 2.0, "pumps and\nactuator", 1.8, 1.0),
        Box(10.2, 0.2, "camera, low-pass,\nMM filter", 2.4, 0.9),
        Box(5.6, 0.2, "inverse\nkinematics (3.12)", 2.4, 0.9),
    )
    wires = (
        Wire(((-0.4, 2.0), (1.5, 2.0)), f"q_ref, mm\n{pair(1e3 * wanted, '.2f')}", (0.3, 2.6)),
        Wire(((2.1, 2.0), (3.4, 2.0)), f"error, mm\n{pair(1e3 * error, '+.2f')}", (2.7, 2.6)),
        Wire(((5.0, 2.0), (6.1, 2.0)), f"u\n{pair(feedback, '+.0f')}", (5.5, 2.6)),
        Wire(((1.0, 2.0), (1.0, 3.9), (3.2, 3.9))),
        Wire(((5.2, 3.9), (6.4, 3.9), (6.4, 2.3)), f"u_ff\n{pair(extra, '.0f')}", (6.95, 3.4)),
        Wire(((6.7, 2.0), (7.65, 2.0))),
        Wire(((9.15, 2.0), (10.2, 2.0)), f"PWM\n{pair(sent, '.0f')}", (9.65, 2.6)),
        Wire(((12.0, 2.0), (12.9, 2.0), (12.9, 0.2), (11.4, 0.2))),
        Wire(((9.0, 0.2), (6.8, 0.2)), "x, y, phi", (7.9, 0.5)),
        Wire(((4.4, 0.2), (1.8, 0.2), (1.8, 1.7)), f"q, mm: {pair(1e3 * seen, '.2f')}", (3.1, -0.15)),
    )
    total = feedback + extra
    return Diagram(
        boxes,
        wires,
        f"{_ELLIPSE_S:g} s after the beginning of the run of Fig. 4.14",
        f"Sum before the limits: {pair(total, '.0f')}.",
        {
            "total1_pwm": float(total[0]),
            "total2_pwm": float(total[1]),
            "sent1_pwm": float(sent[0]),
            "sent2_pwm": float(sent[1]),
        },
    )


FIGURES = (clamping, with_feedforward)
"""In the order of the source."""
