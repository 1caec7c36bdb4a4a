"""Figures of the ellipse: 4.14 to 4.21, 4.24, 4.25.

Runs with sensors are of the rig with unlike pumps; the model is nominal and gets its true state. Phases are
those of the source: both bellows' references rise or fall, faster or slower.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator.kinematics import forward
from calib.stages.control.laws import FeedForward, LoopState, Pid, PositionControl, step_position
from calib.stages.control.references import Ellipse
from calib.twin.scenarios import at_rest
from calib.twin.simulate import Run, Seen, simulate
from thesis.drawn import Band, Curve, Plot, drawn
from thesis.drawn_lengths import unlike_rig
from thesis.runs import nominal

__all__ = ["FIGURES", "ellipse_run", "phases", "recorded_run", "wanted_ellipse"]

_SECONDS = 20.0
_FROM_S = 2.0
_CONTROL = PositionControl(Pid(10000.0, 0.0, 1000.0), FeedForward())
_SEEN = "what the firmware sees of a simulated rig with unlike pumps, feedback from its sensors"
_GAINS = "Kp = 10000, Kd = 1000"
Pair = tuple[float, float]


def wanted_ellipse() -> FloatArray:
    """q_ref (n, 2) [m] of (4.9) at the ticks of 20 s."""
    t = nominal().pump.tick_s * np.arange(round(_SECONDS / nominal().pump.tick_s), dtype=np.float64)
    return Ellipse().bellows_m(t, nominal().plant.bellows_radius_m)


def _followed(q_ref_m: FloatArray, feedback: str) -> Run:
    rows = q_ref_m.tolist()

    def law(k: int, memory: LoopState, seen: Seen) -> tuple[LoopState, Pair]:
        memory, command = step_position(_CONTROL, memory, (rows[k][0], rows[k][1]), seen.q_m)
        return memory, command.pwm

    rig = unlike_rig() if feedback == "sensors" else nominal()
    return simulate(rig, at_rest(rig), law, len(rows), 0, feedback)


@lru_cache(maxsize=2)
def ellipse_run(feedback: str = "sensors") -> Run:
    """A run around the ellipse."""
    return _followed(wanted_ellipse(), feedback)


def seen_lengths(run: Run) -> FloatArray:
    """Lengths (n, 2) [m] that the controller got."""
    assert run.seen is not None
    return np.asarray(run.seen[:, 1:])


@lru_cache(maxsize=1)
def recorded_run() -> Run:
    """A run along what the firmware saw on the ellipse, as a reference."""
    return _followed(seen_lengths(ellipse_run()), "sensors")


def phases(q_ref_m: FloatArray, tick_s: float) -> tuple[Band, ...]:
    """Stretches in which rates and accelerations of both bellows' references have the signs of I to IV."""
    rate = np.gradient(q_ref_m, tick_s, axis=0)
    bend = np.gradient(rate, tick_s, axis=0)
    out = []
    for name, (up, faster) in zip(
        ("I", "II", "III", "IV"), ((1, 1), (1, -1), (-1, -1), (-1, 1)), strict=True
    ):
        inside = np.all((up * rate > 0.0) & (faster * bend > 0.0), axis=1)
        # The ends of the differences are not to be trusted.
        inside[:3] = inside[3]
        inside[-3:] = inside[-4]
        edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
        spans = [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        if spans:
            a, b = max(spans, key=lambda span: span[1] - span[0])
            out.append(Band(a * tick_s, b * tick_s, name))
    return tuple(out)


def _rms_mm(error_mm: FloatArray, run: Run) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(error_mm[run.t_s >= _FROM_S] ** 2, axis=0)))


def _head(q_m: FloatArray) -> FloatArray:
    return 1e3 * forward(q_m, nominal().plant.bellows_radius_m)[..., :2]


def _place(run: Run, reference: FloatArray, source: str, name: str = "seen by the firmware") -> Plot:
    seen, wanted, true = _head(seen_lengths(run)), _head(reference), _head(run.states[:, :2])
    off = _rms_mm(np.linalg.norm(true - wanted, axis=1), run)
    return Plot(
        "x (mm)",
        "y (mm), away from the base",
        (
            Curve(name, seen[:, 0], seen[:, 1], colour=0),
            Curve("reference", wanted[:, 0], wanted[:, 1], "dashed", -1),
            Curve("start", seen[:1, 0], seen[:1, 1], "points", 1),
        ),
        source,
        f"RMS of the true head's distance from the reference after {_FROM_S:g} s: {float(off):.2f} mm.",
        numbers={"rms_mm": float(off), "half_width_mm": float(np.abs(wanted[:, 0]).max())},
        equal=True,
        down=True,
    )


def _lengths(run: Run, reference: FloatArray, source: str) -> Plot:
    seen = 1e3 * seen_lengths(run)
    return Plot(
        "time (s)",
        "length of a bellows (mm)",
        (
            Curve("bellows 1", run.t_s, seen[:, 0], colour=0),
            Curve("bellows 2", run.t_s, seen[:, 1], colour=1),
            Curve("references", run.t_s, 1e3 * reference[:, 0], "dashed", -1),
            Curve("", run.t_s, 1e3 * reference[:, 1], "dashed", -1),
        ),
        source,
        f"References from {1e3 * reference.min():.1f} to {1e3 * reference.max():.1f} mm.",
        numbers={
            "least_ref_mm": float(1e3 * reference.min()),
            "greatest_ref_mm": float(1e3 * reference.max()),
        },
    )


def _errors(run: Run, reference: FloatArray, source: str) -> Plot:
    error = 1e3 * (reference - seen_lengths(run))
    rms = _rms_mm(error, run).tolist()
    bands = phases(wanted_ellipse(), run.tick_s)
    between = np.ones(len(error), dtype=bool)
    for band in bands:
        between &= ~((run.t_s >= band.begin) & (run.t_s < band.end))
    between &= run.t_s >= _FROM_S
    inside = ~between & (run.t_s >= _FROM_S)
    true = 1e3 * (reference - run.states[:, :2])
    jump = float(run.t_s[1 + int(np.argmax(np.abs(np.diff(error - true, axis=0)).max(axis=1)))])
    spike, rest = (float(np.abs(true[some]).max()) for some in (between, inside))
    return Plot(
        "time (s)",
        "reference less length (mm)",
        (
            Curve("bellows 1", run.t_s, error[:, 0], colour=0),
            Curve("bellows 2", run.t_s, error[:, 1], colour=1),
        ),
        source,
        f"RMS {rms[0]:.2f} and {rms[1]:.2f} mm after {_FROM_S:g} s. True errors are at most {spike:.2f} "
        "mm between the "
        f"phases and {rest:.2f} mm in them: the source's spikes between them are not seen here. The jump at "
        f"{jump:.1f} s is a wrong picture.",
        bands,
        {"rms_q1_mm": rms[0], "rms_q2_mm": rms[1], "between_mm": spike, "inside_mm": rest},
        y_limits=(-4.0, 4.0),
    )


_RUN = f"{_SEEN}; PD with feed-forward, {_GAINS}"


@drawn("4.14", "ellipse_in_the_plane", "The ellipse in the plane")
def plane() -> Plot:
    return _place(ellipse_run(), wanted_ellipse(), _RUN)


@drawn("4.15", "ellipse_bellows", "The ellipse in lengths of the bellows")
def bellows() -> Plot:
    return _lengths(ellipse_run(), wanted_ellipse(), "the run of Fig. 4.14")


@drawn("4.16", "ellipse_errors", "Errors of the bellows on the ellipse, with the four phases")
def ellipse_errors() -> Plot:
    return _errors(ellipse_run(), wanted_ellipse(), "the run of Fig. 4.14")


def _angles() -> tuple[Run, FloatArray, FloatArray]:
    run, r = ellipse_run(), nominal().plant.bellows_radius_m
    wanted = wanted_ellipse()
    assert run.seen is not None
    return run, (wanted[:, 0] - wanted[:, 1]) / (2.0 * r), np.asarray(run.seen[:, 0])


@drawn("4.17", "ellipse_angle", "Angle on the ellipse")
def ellipse_angle() -> Plot:
    run, wanted, seen = _angles()
    return Plot(
        "time (s)",
        "angle (rad)",
        (
            Curve("seen by the firmware", run.t_s, seen, colour=0),
            Curve("reference", run.t_s, wanted, "dashed", -1),
        ),
        "the run of Fig. 4.14",
        f"The reference swings by {np.abs(wanted).max():.3f} rad to each side: 2 atan(x / y), where the "
        "source "
        "prints a tangent.",
        numbers={"greatest_ref_rad": float(np.abs(wanted).max())},
    )


@drawn("4.18", "ellipse_angle_error", "Error of the angle on the ellipse")
def ellipse_angle_error() -> Plot:
    run, wanted, seen = _angles()
    error = wanted - seen
    rms = float(_rms_mm(error, run))
    turns = run.t_s[np.flatnonzero(np.diff(np.sign(np.gradient(wanted)))[3:-3]) + 3].tolist()
    return Plot(
        "time (s)",
        "reference less angle (rad)",
        (Curve("error", run.t_s, error, colour=0),),
        "the run of Fig. 4.14",
        f"RMS {1e3 * rms:.1f} mrad after {_FROM_S:g} s. The reference turns back at "
        + " and ".join(f"{t:.1f} s" for t in turns)
        + ", where the source sees its large errors.",
        numbers={"rms_rad": rms, "turns": float(len(turns))},
        y_limits=(-0.1, 0.1),
    )


_AGAIN = "a second run, whose reference is what the firmware saw in the run of Fig. 4.14"


@drawn("4.19", "recorded_in_the_plane", "The recorded run as a reference, in the plane")
def recorded_plane() -> Plot:
    return _place(recorded_run(), seen_lengths(ellipse_run()), f"{_AGAIN}; {_GAINS}")


@drawn("4.20", "recorded_bellows", "The recorded run as a reference, lengths of the bellows")
def recorded_bellows() -> Plot:
    return _lengths(recorded_run(), seen_lengths(ellipse_run()), _AGAIN)


@drawn("4.21", "recorded_errors", "Errors along the recorded run")
def recorded_errors() -> Plot:
    return _errors(recorded_run(), seen_lengths(ellipse_run()), _AGAIN)


@drawn("4.24", "ellipse_against_model", "The ellipse in the plane: run with sensors against the model")
def model_plane() -> Plot:
    made = plane.make()
    assert isinstance(made, Plot)
    model = ellipse_run("truth")
    head = _head(model.states[:, :2])
    apart = _rms_mm(np.linalg.norm(head - _head(seen_lengths(ellipse_run())), axis=1), model)
    return Plot(
        made.x,
        made.y,
        (*made.curves[:2], Curve("nominal model", head[:, 0], head[:, 1], colour=1), made.curves[2]),
        "the run of Fig. 4.14, and the same controller on the nominal model, fed with its true state",
        f"They are {float(apart):.2f} mm apart (RMS after {_FROM_S:g} s).",
        numbers={"apart_mm": float(apart)},
        equal=True,
        down=True,
    )


@drawn(
    "4.25", "ellipse_bellows_against_model", "The ellipse in lengths of the bellows: run against the model"
)
def model_bellows() -> Plot:
    run, model = ellipse_run(), ellipse_run("truth")
    seen, told, wanted = 1e3 * seen_lengths(run), 1e3 * model.states[:, :2], 1e3 * wanted_ellipse()
    rms = _rms_mm(told - seen, run).tolist()
    curves = []
    for i in range(2):
        curves += [
            Curve(f"bellows {i + 1}, firmware", run.t_s, seen[:, i], colour=i),
            Curve(f"bellows {i + 1}, model", run.t_s, told[:, i], "dashed", i),
            Curve("" if i else "references", run.t_s, wanted[:, i], "dotted", -1),
        ]
    return Plot(
        "time (s)",
        "length of a bellows (mm)",
        tuple(curves),
        "the runs of Fig. 4.24",
        f"RMS of model less run {rms[0]:.2f} and {rms[1]:.2f} mm after {_FROM_S:g} s.",
        numbers={"rms_q1_mm": rms[0], "rms_q2_mm": rms[1]},
    )


BEFORE = (
    plane,
    bellows,
    ellipse_errors,
    ellipse_angle,
    ellipse_angle_error,
    recorded_plane,
    recorded_bellows,
    recorded_errors,
)
AFTER = (model_plane, model_bellows)
FIGURES = (*BEFORE, *AFTER)
"""In the order of the source."""
