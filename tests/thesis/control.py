"""Control of the angle, of the length and around the ellipse (chapter 4).

A function `ctl_dt` computes what the claim `ctl.dt` of thesis.yaml is judged by; `figure_4_2` the curves of
Fig. 4.2 and the values in the sentence under it.

In place of the source's experiments stand runs of the simulated rig in which the controller gets what the
firmware makes of the sensors' readings; what is shown is what it got. Models run on the true state. The
source's u2 drives the bellows that bends towards the reference; in the model's frame that is bellows 1.
"""

from __future__ import annotations

import math

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.plot import Band, Curve, Plot
from calib.stages.actuator.kinematics import forward, inverse
from calib.stages.actuator.pump import PWM_MAX, ElongationForce
from calib.stages.control.laws import Channel, FeedForward, Pid, feed_forward
from calib.stages.control.references import Ellipse, PolynomialElongation
from calib.stages.control.rig_model import PWM_MIN
from calib.twin.scenarios import StepResponse, at_rest, length_law, step_response
from calib.twin.simulate import Run, simulate
from thesis.plot import curve, curves_of
from thesis.runs import (
    RigMaker,
    Values,
    figure,
    first_time_s,
    lengths_m,
    nominal,
    once,
    printed_damping,
    printed_in_millinewton,
    printed_in_newton,
    seen,
    tried,
    unlike_rig,
)

_ANGLE_RAD, _JUMP_RAD, _JUMP_S = 0.7, 0.3, 5.0
_REST_M, _START_M = 0.065, 0.0681
_GAINS = (500, 1000, 2000, 5000)
_PID = Pid(1000.0, 1000.0, 10.0)
_CLAMPED = Pid(1000.0, 1000.0, 10.0, clamping=True)
_RADIUS_M = nominal().plant.bellows_radius_m

# Angle (4.1)


def ctl_dt() -> Values:
    return {"tick_s": Pid(1.0).tick_s}


def ctl_p() -> Values:
    peaks: Values = {
        f"peak_{gain}_rad": figure("peak_rad", "orientation", 5.0, controller="p", Kp=str(gain))
        for gain in _GAINS
    }
    return peaks | {"highest_rad": max(peaks.values())}


def ctl_pid_discrete() -> Values:
    h, k = 1.0 / 60.0, np.arange(300)
    errors = 0.7 * np.exp(-k / 40.0) + 0.1 * np.sin(0.9 * k)
    before = np.concatenate([[0.0], errors[:-1]])
    # Proportional, trapezoidal integral and backward difference, each on its own (D.6).
    sums = _PID.Kp * errors + _PID.Ki * h * np.cumsum(0.5 * (errors + before))
    sums += _PID.Kd / h * (errors - before)
    channel = Channel(_PID)
    ours = np.array([channel.step(error) for error in errors.tolist()])
    return {"error_pwm": float(np.abs(ours - sums).max())}


def ctl_pid_peak() -> Values:
    peak = figure("peak_rad", "orientation", 5.0)
    over = 1e3 * (peak - _ANGLE_RAD)
    return {"peak_rad": peak, "overshoot_mrad": over, "printed_deg": math.degrees(0.7288)}


def ctl_pid_settle() -> Values:
    run = tried("orientation", 5.0)
    return {
        "settle_s": figure("settle_s", "orientation", 5.0),
        "reach_s": figure("reach_s", "orientation", 5.0),
        "desaturation_s": first_time_s(run, run.pwm[:, 0] < PWM_MAX),
    }


def ctl_windup() -> Values:
    (before, early), (after, late) = (
        [figure(key, "orientation", controller=name) for key in ("overshoot_after_jump_rad", "reach_s")]
        for name in ("pid", "clamping")
    )
    return {
        "overshoot_rad": before,
        "clamped_overshoot_rad": after,
        "left_percent": 100.0 * after / before,
        "reach_s": early,
        "clamped_reach_s": late,
        "later_s": late - early,
    }


def _saturated_percent(rig: RigMaker) -> float:
    return float(100.0 * np.mean(tried("orientation", 5.0, rig=rig).pwm[:, 0] >= PWM_MAX))


def ctl_sim_saturates() -> Values:
    rigs = {"": nominal, "printed_mN_": printed_in_millinewton, "printed_N_": printed_in_newton}
    return {f"{name}percent": _saturated_percent(rig) for name, rig in rigs.items()}


def _angle_run(controller: str, gain: int = 1000, seconds: float = 5.0, feedback: str = "sensors") -> Run:
    """The simulated rig under control of its angle: 0.7 rad, and 0.3 rad from 5 s on."""
    options = {"controller": controller} | ({"Kp": str(gain)} if controller == "p" else {})
    return tried("orientation", seconds, feedback=feedback, **options)


def _angle_reference(run: Run) -> Curve:
    reference = np.where(run.t_s + 1e-9 < _JUMP_S, _ANGLE_RAD, _JUMP_RAD)
    return curve("reference", run.t_s, reference, "dotted", -1)


def unsaturated(run: Run, pid: Pid) -> FloatArray:
    """Outputs (n, 2) [PWM] of the controllers before the limits, from what they got in a run."""
    errors = (_angle_reference(run).y - seen(run)[:, 0]).tolist()
    first, second = Channel(pid), Channel(pid)
    return np.array([(first.step(error), second.step(-error)) for error in errors])


def _response(run: Run, phi: FloatArray) -> StepResponse:
    return step_response(run.tick_s, phi[run.t_s < _JUMP_S - 1e-6], _ANGLE_RAD)


_LIMITS = (Band("y", PWM_MAX, 1e6, "beyond 255"), Band("y", -1e6, PWM_MIN, "below 0"))


def figure_4_2() -> tuple[Plot, Values]:
    runs = {gain: _angle_run("p", gain) for gain in _GAINS}
    curves = [
        curve(f"Kp = {gain}", run.t_s, seen(run)[:, 0], colour=k)
        for k, (gain, run) in enumerate(runs.items())
    ]
    plot = Plot("time (s)", "angle (rad)", (*curves, _angle_reference(runs[500])))
    return plot, {f"peak_{gain}_rad": float(run.phi_rad.max()) for gain, run in runs.items()}


def figure_4_3() -> tuple[Plot, Values]:
    curves, values = [], {}
    for k, gain in enumerate(_GAINS):
        run = _angle_run("p", gain)
        u = unsaturated(run, Pid(float(gain)))[:, 0]
        curves.append(curve(f"Kp = {gain}", run.t_s, u, colour=k))
        values[f"first_{gain}_pwm"] = float(u[0])
        values[f"free_{gain}_s"] = first_time_s(run, u < PWM_MAX)
    label = "output of the driving controller (PWM)"
    return Plot("time (s)", label, (_LIMITS[0], *curves), y_limits=(0.0, 3700.0)), values


def figure_4_4() -> tuple[Plot, Values]:
    run, model = _angle_run("pid"), _angle_run("pid", feedback="truth")
    ours, true = _response(run, seen(run)[:, 0]), _response(model, model.phi_rad)
    curves = (
        curve("seen by the firmware", run.t_s, seen(run)[:, 0], colour=0),
        curve("fed with the true state", model.t_s, model.phi_rad, "dashed", 1),
        _angle_reference(run),
    )
    return Plot("time (s)", "angle (rad)", curves), {
        "reach_s": ours.reach_s or math.nan,
        "peak_rad": ours.peak,
        "true_reach_s": true.reach_s or math.nan,
        "true_peak_rad": true.peak,
        "true_settle_s": true.settle_s or math.nan,
    }


def figure_4_5() -> tuple[Plot, Values]:
    run = _angle_run("pid")
    u = unsaturated(run, _PID)
    curves = (
        curve("driving controller (the source's u2)", run.t_s, u[:, 0], colour=0),
        curve("the other", run.t_s, u[:, 1], colour=1),
    )
    return Plot("time (s)", "output (PWM)", (*_LIMITS, *curves), y_limits=(-1400.0, 1400.0)), {
        "free_s": first_time_s(run, u[:, 0] < PWM_MAX),
        "late_pwm": float(u[-60:, 0].mean()),
        "first_pwm": float(u[0, 0]),
    }


def figure_4_6() -> tuple[None, Values]:
    run = _angle_run("clamping", seconds=10.0)
    k = round(0.4 / run.tick_s)
    phi, (sent1, sent2), (u1, u2) = seen(run)[k, 0], run.pwm[k], unsaturated(run, _CLAMPED)[k]
    outside = ["no" if PWM_MIN <= u <= PWM_MAX else "yes" for u in (u1, u2)]
    return None, {
        "reference_rad": _ANGLE_RAD,
        "seen_rad": float(phi),
        "error_rad": float(_ANGLE_RAD - phi),
        "true_rad": float(run.phi_rad[k]),
        "u1_pwm": float(u1),
        "u2_pwm": float(u2),
        "sent1_pwm": float(sent1),
        "sent2_pwm": float(sent2),
        "outside": ", ".join(outside),
    }


def _jumps() -> dict[str, tuple[Curve, Curve, Run]]:
    """Angle, output before the limits and run of both controllers over 10 s."""
    out = {}
    for k, (name, pid) in enumerate((("PID", _PID), ("PID with clamping", _CLAMPED))):
        run = _angle_run("clamping" if pid.clamping else "pid", seconds=10.0)
        angle = curve(name, run.t_s, seen(run)[:, 0], colour=k)
        output = curve(name, run.t_s, unsaturated(run, pid)[:, 0], colour=k)
        out["clamping" if pid.clamping else "pid"] = angle, output, run
    return out


def figure_4_7() -> tuple[Plot, Values]:
    values: Values = {}
    for name, (_, _, run) in _jumps().items():
        below = _JUMP_RAD - float(run.phi_rad[run.t_s >= _JUMP_S].min())
        values[f"{name}_overshoot_rad"] = max(below, 0.0)
        values[f"{name}_to_95_percent_s"] = first_time_s(run, run.phi_rad > 0.95 * _ANGLE_RAD)
    curves = [angle for angle, _, _ in _jumps().values()]
    return Plot("time (s)", "angle (rad)", (*curves, _angle_reference(_jumps()["pid"][2]))), values


def figure_4_8() -> tuple[Plot, Values]:
    curves = [output for _, output, _ in _jumps().values()]
    label = "output of the driving controller (PWM)"
    return Plot("time (s)", label, (*_LIMITS, *curves), y_limits=(-700.0, 900.0)), {
        f"{name}_below_s": float(np.sum(output.y[run.t_s >= _JUMP_S] < PWM_MIN) * run.tick_s)
        for name, (_, output, run) in _jumps().items()
    }


def figure_4_9() -> tuple[Plot, Values]:
    cases = {f"Kp = {gain}": ("p", gain) for gain in _GAINS} | {"PID": ("pid", 1000)}
    curves, values = [], {"saturated_percent": _saturated_percent(nominal)}
    for k, (name, (controller, gain)) in enumerate(cases.items()):
        run, model = (_angle_run(controller, gain, feedback=feedback) for feedback in ("sensors", "truth"))
        curves.append(curve(name, run.t_s, seen(run)[:, 0], "line", k))
        curves.append(curve("", model.t_s, model.phi_rad, "dashed", k))
        off = float(1e3 * (seen(run)[:, 0] - model.phi_rad)[-60:].mean())
        values[f"off_{name.replace('Kp = ', 'p')}_mrad"] = off
    return Plot("time (s)", "angle (rad)", tuple(curves)), values


# Length, with feed-forward (4.2)


def _steady_lengths(from_pwm: float, count: int) -> tuple[FloatArray, FloatArray]:
    """PWM values and the steady lengths [m] of (2.13), corrected, from a value to full."""
    law, pwm = ElongationForce(), np.linspace(from_pwm, PWM_MAX, count)
    return pwm, _REST_M + 1e-3 * np.polyval(law.elongation_mm, law.supply_V * pwm / PWM_MAX)


def _saturates_m(line: FeedForward) -> float:
    """Length of a bellows from which the limit holds."""
    return line.from_m + (line.limit_pwm - line.offset_pwm) / line.slope_pwm_per_m


def ctl_ff() -> Values:
    line, (u, length) = FeedForward(), _steady_lengths(110.0, 300)
    inside = (length >= line.from_m) & (length <= 0.091)
    off = feed_forward(line, length[inside]) - u[inside]
    return {
        "worst_pwm": float(np.abs(off).max()),
        "rms_pwm": float(np.sqrt(np.mean(off**2))),
        "slope_pwm_per_m": float(np.polyfit(length[inside], u[inside], 1)[0]),
        "at_91mm_pwm": float(feed_forward(line, 0.091)),
        "saturates_mm": 1e3 * _saturates_m(line),
    }


def ctl_setpoint() -> Values:
    free = PolynomialElongation(hold_s=100.0)
    return {f"at_{t}_s_mm": 1e3 * float(free.bellows_m(np.array(float(t)))[0]) for t in (5, 10)}


def ctl_pdff_max() -> Values:
    return {"largest_mm": figure("largest_error_mm", "elongation")}


def ctl_pdff_static() -> Values:
    run = tried("elongation")
    errors = PolynomialElongation().bellows_m(run.t_s) - lengths_m(run)
    q1, q2 = (1e3 * errors[run.t_s >= 6.0].mean(axis=0)).tolist()
    return {"q1_mm": q1, "q2_mm": q2}


def _moves_s(run: Run) -> float:
    """Time [s] at which bellows 1 has grown by half a millimetre."""
    return first_time_s(run, lengths_m(run)[:, 0] > _REST_M + 5e-4)


def ctl_integral_delay() -> Values:
    run = tried("elongation", controller="pid")
    return {"moves_s": _moves_s(run), "leaves_dead_zone_s": first_time_s(run, run.pwm[:, 0] >= 100.0)}


def _rebound_mm(run: Run) -> float:
    """How far the length of bellows 1 comes back [mm] within 0.2 s of its first minimum."""
    nodes = run.trajectory.nodes[:, 0]
    low = int(np.argmin(nodes[:75]))
    return float(1e3 * (nodes[low : low + 60].max() - nodes[low]))


def ctl_initial() -> Values:
    return {
        f"rebound_{name}_mm": _rebound_mm(tried("elongation", 2.0, rig=rig, start_m=str(_START_M)))
        for name, rig in (("printed", printed_damping), ("nominal", nominal))
    }


def _length_run(controller: str, start_m: float = _REST_M) -> Run:
    """A run along (4.7) of the rig with unlike pumps, with sensors."""
    options = {"controller": controller, "start_m": str(start_m)}
    return tried("elongation", 10.0, rig=unlike_rig, feedback="sensors", **options)


def _length_model(rig: RigMaker) -> Run:
    return tried("elongation", 10.0, rig=rig, controller="pd+ff", start_m=str(_START_M))


def _set_point_m(run: Run) -> FloatArray:
    return PolynomialElongation().bellows_m(run.t_s)


def _seen_length_mm(run: Run) -> FloatArray:
    """Length (n,) [mm] of the backbone as the controller got it."""
    return np.asarray(1e3 * seen(run)[:, 1:].mean(axis=1))


def _true_length_mm(run: Run) -> FloatArray:
    return np.asarray(1e3 * lengths_m(run).mean(axis=1))


def figure_4_11() -> tuple[Plot, Values]:
    line, (pwm, steady) = FeedForward(), _steady_lengths(100.0, 120)
    q = np.concatenate([np.linspace(0.062, line.from_m - 1e-9, 40), np.linspace(line.from_m, 0.097, 160)])
    output = feed_forward(line, q)
    curves = (
        curve("(4.6)", 1e3 * q, output, colour=0),
        curve("steady lengths of (2.13), corrected", 1e3 * steady, pwm, "dashed", 1),
    )
    values: Values = {
        "at_91mm_pwm": float(feed_forward(line, 0.091)),
        "saturates_mm": 1e3 * _saturates_m(line),
    }
    return Plot("wanted length of a bellows (mm)", "feed-forward (PWM)", curves), values


def figure_4_12() -> tuple[Plot, Values]:
    names = {"pd+ff": "PD with feed-forward", "pd": "PD", "pid": "PID"}
    curves, values = [], {}
    for k, (name, words) in enumerate(names.items()):
        run = _length_run(name)
        curves.append(curve(words, run.t_s, _seen_length_mm(run), colour=k))
        errors = 1e3 * (_set_point_m(run) - lengths_m(run))
        values[f"rms_{name.replace('+', '_')}_mm"] = float(np.sqrt(np.mean(errors**2)))
        values[f"end_{name.replace('+', '_')}_mm"] = float(_true_length_mm(run)[-1])
    values["pid_moves_s"] = _moves_s(_length_run("pid"))
    reference = curve("reference", run.t_s, 1e3 * _set_point_m(run)[:, 0], "dotted", -1)
    return Plot("time (s)", "length of the actuator (mm)", (*curves, reference)), values


def figure_4_13() -> tuple[Plot, Values]:
    run = _length_run("pd+ff")
    errors, true = (1e3 * (_set_point_m(run) - q) for q in (seen(run)[:, 1:], lengths_m(run)))
    q1, q2 = errors[run.t_s >= 6.0].mean(axis=0).tolist()
    curves = tuple(curve(f"bellows {i + 1}", run.t_s, errors[:, i], colour=i) for i in range(2))
    return Plot("time (s)", "reference less length (mm)", (Band("x", 6.0, 10.0, "static"), *curves)), {
        "largest_mm": float(np.abs(errors).max()),
        "largest_true_mm": float(np.abs(true).max()),
        "static_q1_mm": q1,
        "static_q2_mm": q2,
    }


def figure_4_22() -> tuple[Plot, Values]:
    run, model, printed = (
        _length_run("pd+ff", _START_M),
        _length_model(nominal),
        _length_model(printed_damping),
    )
    early = run.t_s <= 3.0
    t = run.t_s[early]
    curves = (
        curve("printed damping", t, _true_length_mm(printed)[early], colour=1),
        curve("nominal model", t, _true_length_mm(model)[early], colour=0),
        curve("seen by the firmware", t, _seen_length_mm(run)[early], "points", -1),
        curve("reference", t, 1e3 * _set_point_m(run)[early, 0], "dotted", -1),
    )
    return Plot("time (s)", "length of the actuator (mm)", curves), {"swings_back_mm": _rebound_mm(printed)}


def figure_4_23() -> tuple[Plot, Values]:
    run = _length_run("pd+ff", _START_M)
    off = _true_length_mm(_length_model(nominal)) - _seen_length_mm(run)
    values: Values = {"largest_mm": float(np.abs(off).max()), "late_mm": float(off[run.t_s >= 6.0].mean())}
    off_by = curve("nominal model less run", run.t_s, off, colour=0)
    return Plot("time (s)", "model less run (mm)", (off_by,)), values


# Ellipse (4.2)


def ctl_ellipse() -> Values:
    drawn, t = Ellipse(), np.linspace(0.0, 20.0, 401)
    pose = drawn.pose(t)
    printed = pose.copy()
    printed[:, 2] = np.tan(pose[:, 0] / pose[:, 1])
    heads = [forward(q, _RADIUS_M) for q in (inverse(printed, _RADIUS_M), drawn.bellows_m(t, _RADIUS_M))]
    return {
        "half_width_mm": float(1e3 * np.abs(heads[0][:, 0]).max()),
        "drawn_mm": 1e3 * drawn.x_m,
        "exact_error_m": float(np.abs(heads[1][:, :2] - pose[:, :2]).max()),
    }


def ctl_ellipse_range() -> Values:
    q = 1e3 * Ellipse().bellows_m(np.linspace(0.0, 20.0, 2001), _RADIUS_M)
    return {"least_mm": float(q.min()), "greatest_mm": float(q.max())}


def ctl_ellipse_wobble() -> Values:
    run = tried("ellipse")
    t, errors = run.t_s, Ellipse().bellows_m(run.t_s, _RADIUS_M) - lengths_m(run)
    error = 1e3 * np.abs(errors).max(axis=1)
    change = ((t >= 4.0) & (t <= 6.0)) | ((t >= 14.0) & (t <= 16.0))
    spike, rest = error[change].max(), np.sqrt(np.mean(error[(t >= 2.0) & ~change] ** 2))
    return {"spike_mm": float(spike), "rms_elsewhere_mm": float(rest), "ratio": float(spike / rest)}


def _ellipse_m() -> FloatArray:
    """q_ref (n, 2) [m] of (4.9) at the ticks of 20 s."""
    tick_s = nominal().pump.tick_s
    return Ellipse().bellows_m(tick_s * np.arange(round(20.0 / tick_s), dtype=np.float64), _RADIUS_M)


def _followed(reference_m: FloatArray, rig: RigMaker, feedback: str) -> Run:
    pid = Pid(10000.0, 0.0, 1000.0)
    law = length_law(pid, reference_m, feed_forward(FeedForward(), reference_m))
    return simulate(rig(), at_rest(rig()), law, len(reference_m), 0, feedback)


@once
def _ellipse_run() -> Run:
    return _followed(_ellipse_m(), unlike_rig, "sensors")


@once
def _ellipse_model() -> Run:
    return _followed(_ellipse_m(), nominal, "truth")


def _recorded_m() -> FloatArray:
    """What the firmware saw on the ellipse (n, 2) [m], as a reference."""
    return seen(_ellipse_run())[:, 1:]


@once
def _recorded_run() -> Run:
    return _followed(_recorded_m(), unlike_rig, "sensors")


def phases(reference_m: FloatArray, tick_s: float) -> tuple[Band, ...]:
    """Stretches in which rates and accelerations of both bellows' references have the signs of I to IV."""
    rate = np.gradient(reference_m, tick_s, axis=0)
    bend = np.gradient(rate, tick_s, axis=0)
    out = []
    for name, up, faster in (("I", 1, 1), ("II", 1, -1), ("III", -1, -1), ("IV", -1, 1)):
        inside = np.all((up * rate > 0.0) & (faster * bend > 0.0), axis=1)
        # The ends of the differences are not to be trusted.
        inside[:3], inside[-3:] = inside[3], inside[-4]
        edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
        if len(edges):
            longest = int(np.argmax(np.diff(edges)[::2]))
            out.append(Band("x", edges[2 * longest] * tick_s, edges[2 * longest + 1] * tick_s, name))
    return tuple(out)


def _late_rms(run: Run, errors: FloatArray) -> FloatArray:
    """RMS over the ticks from 2 s on."""
    return np.asarray(np.sqrt(np.mean(errors[run.t_s >= 2.0] ** 2, axis=0)))


def _head_mm(q_m: FloatArray) -> FloatArray:
    return 1e3 * forward(q_m, _RADIUS_M)[..., :2]


def _place(run: Run, reference_m: FloatArray) -> tuple[Plot, Values]:
    ours, reference, true = (_head_mm(q) for q in (seen(run)[:, 1:], reference_m, lengths_m(run)))
    curves = (
        curve("seen by the firmware", *ours.T, colour=0),
        curve("reference", *reference.T, "dashed", -1),
        curve("start", *ours[:1].T, "points", 1),
    )
    return Plot("x (mm)", "y (mm), away from the base", curves, equal=True, down=True), {
        "rms_mm": float(_late_rms(run, np.linalg.norm(true - reference, axis=1))),
        "half_width_mm": float(np.abs(reference[:, 0]).max()),
    }


def _lengths(run: Run, reference_m: FloatArray) -> tuple[Plot, Values]:
    ours, reference = 1e3 * seen(run)[:, 1:], 1e3 * reference_m
    curves = (
        curve("bellows 1", run.t_s, ours[:, 0], colour=0),
        curve("bellows 2", run.t_s, ours[:, 1], colour=1),
        curve("references", run.t_s, reference[:, 0], "dashed", -1),
        curve("", run.t_s, reference[:, 1], "dashed", -1),
    )
    values: Values = {"least_ref_mm": float(reference.min()), "greatest_ref_mm": float(reference.max())}
    return Plot("time (s)", "length of a bellows (mm)", curves), values


def _errors(run: Run, reference_m: FloatArray) -> tuple[Plot, Values]:
    t, bands = run.t_s, phases(_ellipse_m(), run.tick_s)
    ours, true = (1e3 * (reference_m - q) for q in (seen(run)[:, 1:], lengths_m(run)))
    inside = np.any([(t >= band.begin) & (t < band.end) for band in bands], axis=0)
    q1, q2 = _late_rms(run, ours).tolist()
    curves = tuple(curve(f"bellows {i + 1}", t, ours[:, i], colour=i) for i in range(2))
    return Plot("time (s)", "reference less length (mm)", (*bands, *curves), y_limits=(-4.0, 4.0)), {
        "rms_q1_mm": q1,
        "rms_q2_mm": q2,
        "between_mm": float(np.abs(true[~inside & (t >= 2.0)]).max()),
        "inside_mm": float(np.abs(true[inside & (t >= 2.0)]).max()),
        "wrong_picture_s": float(t[1 + int(np.argmax(np.abs(np.diff(ours - true, axis=0)).max(axis=1)))]),
    }


def figure_4_10() -> tuple[None, Values]:
    run, reference = _ellipse_run(), _ellipse_m()
    k = round(7.0 / run.tick_s)
    errors = reference - _recorded_m()
    u = 10000.0 * errors[k] + 1000.0 * (errors[k] - errors[k - 1]) / run.tick_s
    extra = feed_forward(FeedForward(), reference[k])
    pairs = {
        "ref_mm": 1e3 * reference[k], "error_mm": 1e3 * errors[k], "seen_mm": 1e3 * _recorded_m()[k],
        "feedback_pwm": u, "ff_pwm": extra, "total_pwm": u + extra, "sent_pwm": run.pwm[k],
    }  # fmt: skip
    return None, {f"{name}_{i + 1}": float(pair[i]) for name, pair in pairs.items() for i in range(2)}


def figure_4_14() -> tuple[Plot, Values]:
    return _place(_ellipse_run(), _ellipse_m())


def figure_4_15() -> tuple[Plot, Values]:
    return _lengths(_ellipse_run(), _ellipse_m())


def figure_4_16() -> tuple[Plot, Values]:
    return _errors(_ellipse_run(), _ellipse_m())


def _reference_angle_rad() -> FloatArray:
    return np.asarray(_ellipse_m() @ [1.0, -1.0] / (2.0 * _RADIUS_M))


def figure_4_17() -> tuple[Plot, Values]:
    run, reference = _ellipse_run(), _reference_angle_rad()
    curves = (
        curve("seen by the firmware", run.t_s, seen(run)[:, 0], colour=0),
        curve("reference", run.t_s, reference, "dashed", -1),
    )
    return Plot("time (s)", "angle (rad)", curves), {"greatest_ref_rad": float(np.abs(reference).max())}


def figure_4_18() -> tuple[Plot, Values]:
    run, reference = _ellipse_run(), _reference_angle_rad()
    error = reference - seen(run)[:, 0]
    turns = np.flatnonzero(np.diff(np.sign(np.gradient(reference)))[3:-3]) + 3
    off_by = curve("error", run.t_s, error, colour=0)
    return Plot("time (s)", "reference less angle (rad)", (off_by,), y_limits=(-0.1, 0.1)), {
        "rms_mrad": float(1e3 * _late_rms(run, error)),
        "turns": " and ".join(f"{t:.1f} s" for t in run.t_s[turns].tolist()),
    }


def figure_4_19() -> tuple[Plot, Values]:
    return _place(_recorded_run(), _recorded_m())


def figure_4_20() -> tuple[Plot, Values]:
    return _lengths(_recorded_run(), _recorded_m())


def figure_4_21() -> tuple[Plot, Values]:
    return _errors(_recorded_run(), _recorded_m())


def figure_4_24() -> tuple[Plot, Values]:
    plot, _ = figure_4_14()
    run, reference, start = curves_of(plot)
    head = _head_mm(lengths_m(_ellipse_model()))
    apart = _late_rms(_ellipse_model(), np.linalg.norm(head - _head_mm(_recorded_m()), axis=1))
    curves = (run, reference, curve("nominal model", *head.T, colour=1), start)
    return Plot(plot.x, plot.y, curves, equal=True, down=True), {"apart_mm": float(apart)}


def figure_4_25() -> tuple[Plot, Values]:
    run = _ellipse_run()
    ours, model, reference = (1e3 * q for q in (_recorded_m(), lengths_m(_ellipse_model()), _ellipse_m()))
    curves = []
    for i in range(2):
        curves += [
            curve(f"bellows {i + 1}, firmware", run.t_s, ours[:, i], colour=i),
            curve(f"bellows {i + 1}, model", run.t_s, model[:, i], "dashed", i),
            curve("" if i else "references", run.t_s, reference[:, i], "dotted", -1),
        ]
    q1, q2 = _late_rms(run, model - ours).tolist()
    return Plot("time (s)", "length of a bellows (mm)", tuple(curves)), {"rms_q1_mm": q1, "rms_q2_mm": q2}
