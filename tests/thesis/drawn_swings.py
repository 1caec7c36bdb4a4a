"""Figures of free swings, and of the models that are held against them: 3.11 to 3.15, 3.18 to 3.20.

In place of the source's setup stands a rig whose parameters differ from the nominal ones, seen with the
camera's noise. The original model is that of 3.3: no bending, no creep, damping by (3.41). The improved one
is fitted to three swings of that rig, as in 3.4; the swing that is shown is not one of them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator.identify import Decrement, Nominal, Solution, Track, decrement, fit_tracks, made
from calib.stages.actuator.parameters import Creep
from calib.twin.rig import SimulatedRig
from calib.twin.sensors import normal, stream
from calib.twin.simulate import Run
from thesis.drawn import Curve, Plot, drawn
from thesis.runs import first_model, nominal, tried

__all__ = ["FIGURES", "columns_of", "fitted", "other_rig", "seen_swing", "swing_of"]

_RELEASED_RAD = (0.5, 0.42, -0.46)
_SHOWN_RAD = 0.55
_DURATION_S = 4.0
_SIGMA = (0.004, 0.0003)
"""Noise of angle [rad] and length [m] by the camera alone."""
_NOISE = 30


def other_rig() -> SimulatedRig:
    """A rig that no model was made for: softer, bending and creeping more, its pumps not alike."""
    rig = nominal()
    plant = replace(
        rig.plant,
        stiffness_scale=0.93,
        bending_N_per_rad2=0.21,
        creep=Creep(3.6, 12.0, -1.0),
        damping_scale=17.5,
    )
    return replace(rig, plant=plant, free_damping_scale=3.0, pump_strength=(1.0, 0.96))


def columns_of(run: Run) -> FloatArray:
    """q1, q2 [m] and phi [rad] (n, 3) at the ticks."""
    return np.column_stack([run.states[:, :2], run.phi_rad])


@lru_cache(maxsize=8)
def swing_of(which: str, phi_rad: float = _SHOWN_RAD) -> Run:
    """A swing of the other rig, of the first model, or of the fitted one."""
    if which == "fitted":
        found = fitted()
        plant, _ = made(Nominal(), found.values, False, nominal().pump.tick_s)
        rig = replace(nominal(), plant=plant, free_damping_scale=plant.damping_scale)
    else:
        rig = {"other": other_rig, "first": first_model}[which]()
    return tried("swing", _DURATION_S, rig=rig, phi_rad=str(phi_rad))[0]


@lru_cache(maxsize=8)
def seen_swing(phi_rad: float = _SHOWN_RAD) -> FloatArray:
    """Angle [rad] and length [m] (n, 2) of a swing of the other rig, with the camera's noise."""
    at = columns_of(swing_of("other", phi_rad))
    head = np.column_stack([at[:, 2], 0.5 * (at[:, 0] + at[:, 1])])
    bits = stream(_RELEASED_RAD.index(phi_rad) if phi_rad in _RELEASED_RAD else 9, _NOISE)
    return np.asarray(head + np.array(_SIGMA) * normal(bits, len(head), 2))


def _track(phi_rad: float) -> Track:
    run, head = swing_of("other", phi_rad), seen_swing(phi_rad)
    W = np.broadcast_to(np.diag(1.0 / np.array(_SIGMA)), (len(head), 2, 2)).copy()
    return Track(f"swing from {phi_rad:g} rad", run.tick_s, run.pwm, False, run.t_s, head, W)


@lru_cache(maxsize=1)
def fitted() -> Solution:
    """The improved model: the parameters of Table 3.2 from three swings."""
    return fit_tracks(Nominal(), [_track(phi) for phi in _RELEASED_RAD], delay_s=0.0, threads=1)


@lru_cache(maxsize=1)
def _decay() -> Decrement:
    return decrement(swing_of("other").t_s, seen_swing()[:, 0], _SIGMA[0])


_RIG = "swing of a simulated rig from 0.55 rad, hoses off, which is not the nominal one; camera's noise"


def _bellows(which: int) -> tuple[FloatArray, FloatArray]:
    """Time and a bellows' length [mm] as the camera shows it."""
    head = seen_swing()
    turned = nominal().plant.bellows_radius_m * head[:, 0] * (1.0 if which == 0 else -1.0)
    return swing_of("other").t_s, 1e3 * (head[:, 1] + turned)


@drawn("3.11", "angle_after_release", "Angle after the release, pumps not connected")
def angle_after_release() -> Plot:
    t, phi, found = swing_of("other").t_s, seen_swing()[:, 0], _decay()
    return Plot(
        "time (s)",
        "angle (rad)",
        (
            Curve("as the camera shows it", t, phi, colour=0),
            Curve("peaks that are used", found.peak_at_s, found.peak, "points", 1),
        ),
        _RIG,
        f"Damping by the decrement from peak to peak: {found.zeta:.4f} +- {found.sigma:.4f} at "
        f"{found.frequency_hz:.2f} Hz. The middle of the swing creeps back to zero.",
        numbers={"zeta": found.zeta, "frequency_hz": found.frequency_hz},
    )


@drawn("3.12", "bellows_after_release", "Length of bellows 1 after the release")
def bellows_after_release() -> Plot:
    t, q1 = _bellows(0)
    rest = 1e3 * nominal().plant.rest_length_m
    return Plot(
        "time (s)",
        "length of bellows 1 (mm)",
        (
            Curve("as the camera shows it", t, q1, colour=0),
            Curve("rest length", t[[0, -1]], np.full(2, rest), "dotted", -1),
        ),
        _RIG,
        f"From {q1[:3].mean():.1f} mm back to {q1[-30:].mean():.1f} mm.",
        numbers={"first_mm": float(q1[:3].mean()), "last_mm": float(q1[-30:].mean())},
    )


def _against(model: str, column: int) -> Plot:
    """A quantity of the swing against that of a model."""
    t = swing_of("other").t_s
    simulated = columns_of(swing_of(model))[:, column]
    scale, unit = (1e3, "mm") if column < 2 else (1.0, "rad")
    seen = _bellows(column)[1] if column < 2 else seen_swing()[:, 0]
    told = scale * simulated
    true = scale * columns_of(swing_of("other"))[:, column]
    norm = float(np.linalg.norm(told - seen))
    rms = norm / np.sqrt(len(t))
    name = "original model" if model == "first" else "improved model"
    what = f"length of bellows {column + 1} (mm)" if column < 2 else "angle (rad)"
    largest = float(np.abs(told - true).max())
    noise = _SIGMA[0]
    hertz = [
        decrement(t, columns_of(swing_of(which))[:, 2], noise).frequency_hz for which in ("other", model)
    ]
    source = _RIG + (
        "; the model of 3.3, without bending and creep"
        if model == "first"
        else "; a model fitted to three other swings"
    )
    return Plot(
        "time (s)",
        what,
        (
            Curve("simulated rig", t, seen, "points", -1),
            Curve(name, t, told, colour=1 if model == "first" else 0),
        ),
        source,
        f"L2 norm of the error over {len(t)} samples {norm:.3g} {unit}, RMS {rms:.3g} {unit}, at most "
        f"{largest:.2g} {unit} from the truth. "
        f"The model swings at {hertz[1]:.2f} Hz, the rig at {hertz[0]:.2f} Hz.",
        numbers={
            "norm": norm,
            "rms": float(rms),
            "largest": largest,
            "rig_hz": hertz[0],
            "model_hz": hertz[1],
        },
    )


@drawn("3.13", "bellows_1_original_model", "Bellows 1: original model against the rig")
def original_q1() -> Plot:
    return _against("first", 0)


@drawn("3.14", "bellows_2_original_model", "Bellows 2: original model against the rig")
def original_q2() -> Plot:
    return _against("first", 1)


@drawn("3.15", "angle_original_model", "Angle: original model against the rig")
def original_phi() -> Plot:
    return _against("first", 2)


@drawn("3.18", "bellows_1_improved_model", "Bellows 1: improved model against the rig")
def improved_q1() -> Plot:
    return _against("fitted", 0)


@drawn("3.19", "bellows_2_improved_model", "Bellows 2: improved model against the rig")
def improved_q2() -> Plot:
    return _against("fitted", 1)


@drawn("3.20", "angle_improved_model", "Angle: improved model against the rig")
def improved_phi() -> Plot:
    return _against("fitted", 2)


ORIGINAL = (angle_after_release, bellows_after_release, original_q1, original_q2, original_phi)
IMPROVED = (improved_q1, improved_q2, improved_phi)
FIGURES = (*ORIGINAL, *IMPROVED)
"""In the order of the source."""
