"""Speed of the dynamics: `python tests/bench/dynamics.py [swing]`; with `swing` only the last of these.

Figures of the first two are simulated time over wall time, the best of several, with the error in the
bellows' lengths against DOP853 at 1e-12.

- one core: 1 ms steps with both pumps, random commands at every tick, the kernel and the public call;
- batch: 200 parameter sets of 10 s on two threads;
- against a usual implementation: 20 s of free swing by `solve_ivp` (RK45, 1e-3, 1e-6, the settings of
  ode45) on M, C and N that sympy derived and lambdified; also by jsrm (`pip install jsrm`), where it is
  installed.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import _here  # noqa: F401
import numpy as np
import sympy
from _rows import Row, fastest, interleaved, print_rows
from open_loop import simulate, swing
from scipy.integrate import solve_ivp

from adaptive import simulate_adaptive, swing_adaptive
from calib.core.arrays import FloatArray
from calib.stages.actuator.dynamics import coefficients
from calib.stages.actuator.parameters import Plant, Stiffness, pumps_connected
from calib.stages.actuator.pump import Orifice, Pump, delayed, pump_coefficients, static_force_N
from calib.stages.actuator.simulate import rig_at_rest, run, simulate_batch, state_row

STEPS_PER_TICK = 17
PUMP = Pump(tick_s=STEPS_PER_TICK * 1e-3)
"""Ticks of 17 ms, so that the steps are exactly 1 ms."""


def commands(ticks: int, seed: int) -> FloatArray:
    return np.random.default_rng(seed).uniform(0, 255, (ticks, 2))


def one_core(pump: Pump) -> tuple[float, float, float]:
    """Times real time of the kernel and of `simulate`, and the largest error [m]."""
    plant, pwm = pumps_connected(), commands(600, 1)
    c, p = coefficients(plant), pump_coefficients(pump)
    start = rig_at_rest(plant, pump).row
    static = static_force_N(pump, delayed(pump, pwm))
    out = np.empty((len(pwm), 10))
    simulated = len(pwm) * pump.tick_s

    def kernel() -> None:
        run(c, p, start, static, pump.tick_s, STEPS_PER_TICK, STEPS_PER_TICK, out)

    def public() -> None:
        simulate(plant, pump, pwm, substeps=STEPS_PER_TICK)

    public()
    bare, whole = fastest(kernel, 200), fastest(public, 200)
    few = pwm[:120]
    exact = simulate_adaptive(plant, pump, few, rtol=1e-12, atol=1e-14)
    error = np.abs(simulate(plant, pump, few, substeps=STEPS_PER_TICK).q_m - exact.q_m).max()
    return simulated / bare, simulated / whole, float(error)


def batch(sets: int, threads: int) -> tuple[float, float]:
    """Times real time, all sets together, by the wall and by the processor time of one core."""
    rng, pwm = np.random.default_rng(2), commands(589, 3)
    plants = [
        replace(pumps_connected(), stiffness=Stiffness((float(k), 1092.9))) for k in rng.uniform(40, 55, sets)
    ]
    start = state_row(plants[0])

    def work() -> None:
        simulate_batch(plants, [PUMP] * sets, pwm, start, STEPS_PER_TICK, threads)

    work()
    simulated = sets * len(pwm) * PUMP.tick_s
    return simulated / fastest(work, 10), simulated / fastest(work, 10, time.process_time)


def usual(plant: Plant) -> Callable[[float, FloatArray], FloatArray]:
    """Right-hand side from sympy's M, C and N, lambdified, with the matrices solved by numpy."""
    q1, q2, v1, v2 = sympy.symbols("q1 q2 v1 v2", real=True)
    q, v, r = sympy.Matrix([q1, q2]), sympy.Matrix([v1, v2]), plant.bellows_radius_m
    phi, ell = (q1 - q2) / (2 * r), (q1 + q2) / 2
    # The series (3.10) up to the seventh order, as the source has them.
    odd = sum((-1) ** n * phi ** (2 * n + 1) / sympy.factorial(2 * n + 2) for n in range(4))
    even = sum((-1) ** n * phi ** (2 * n) / sympy.factorial(2 * n + 1) for n in range(4))
    Jp = sympy.Matrix([ell * odd, ell * even]).jacobian(q)
    rate = Jp.diff(q1) * v1 + Jp.diff(q2) * v2
    turning = plant.inertia_kgm2 / (4 * r**2) * sympy.Matrix([[1, -1], [-1, 1]])
    M, C = plant.mass_kg * Jp.T * Jp + turning, plant.mass_kg * Jp.T * rate
    k0, k1, _, _ = plant.stiffness.padded
    k = [k0 + k1 * sympy.Max(x - plant.rest_length_m, 0) for x in q]
    damping = plant.damping_Ns_per_sqrt_N_per_m
    bent = plant.bending_N_per_rad2 * phi * sympy.Abs(phi)
    N = sympy.Matrix(
        [
            k[i] * (q[i] - plant.rest_length_m) + damping * sympy.sqrt(k[i]) * v[i] + (-1) ** i * bent
            for i in range(2)
        ]
    )
    matrices = sympy.lambdify((q1, q2, v1, v2), (M, C, N), "numpy", cse=True)
    l1, l2, l3 = plant.creep_rates

    def slope(_: float, y: FloatArray) -> FloatArray:
        mass, coriolis, forces = matrices(*y[:4])
        ddq = np.linalg.solve(mass, l3 * y[4:] - coriolis @ y[2:4] - forces[:, 0])
        return np.concatenate([y[2:4], ddq, -l1 * y[4:] + l2 * y[2:4]])

    return slope


def jsrm_swings(duration: float) -> tuple[dict[str, Callable[[], object]], dict[str, str]]:
    """The same swing of a rod of one constant-strain segment (bending and axial strain) by jsrm, compiled.

    Another model than ours: its mass is along the rod. Mass, length, radius, 4 Hz and damping ratio are ours.
    jsrm gives the slope; what integrates it is JAX's own dopri5 at the settings of ode45, and RK4 in steps of
    1 ms as ours. Its slope is not smooth where the rod is nearly straight: steps of 1 ms and of 0.5 ms end
    some hundredths of a radian apart, and dopri5 takes 25 s at 1e-6. Returns the calls, and what is to be
    said of each. Raises `ImportError` where jsrm is not installed.
    """
    jsrm, jax = importlib.import_module("jsrm"), importlib.import_module("jax")
    jax.config.update("jax_enable_x64", True)
    np_ = importlib.import_module("jax.numpy")
    expressions = Path(jsrm.__file__).parent / "symbolic_expressions" / "planar_pcs_ns-1.dill"
    factory = importlib.import_module("jsrm.systems.planar_pcs").factory
    _, _, matrices, _ = factory(expressions, np_.array([True, False, True]))
    plant = Plant()
    length, radius = plant.rest_length_m, plant.bellows_radius_m
    values: dict[str, object] = {
        "th0": 0.0, "l": [length], "r": [radius], "g": [0.0, 0.0], "E": [7.7e3], "G": [2.6e3],
        "rho": [plant.mass_kg / (np.pi * radius**2 * length)], "D": np.diag([4.3e-8, 0.0, 4.8e-4]),
    }  # fmt: skip
    parameters = {name: np_.array(value) for name, value in values.items()}
    slope = importlib.import_module("jsrm.integration").ode_factory(matrices, parameters, np_.zeros(2))
    odeint = importlib.import_module("jax.experimental.ode").odeint
    start, times, h = np_.array([0.5 / length, 0.0, 0.0, 0.0]), np_.linspace(0.0, duration, 2001), 1e-3

    def step(x: Any, _: object) -> tuple[Any, Any]:
        k1 = slope(0.0, x)
        k2 = slope(0.0, x + 0.5 * h * k1)
        k3 = slope(0.0, x + 0.5 * h * k2)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + slope(0.0, x + h * k3))
        return x, x

    fixed = jax.jit(lambda x: jax.lax.scan(step, x, None, length=round(duration / h))[1])
    adaptive = jax.jit(lambda x: odeint(lambda y, t: slope(t, y), x, times, rtol=1e-3, atol=1e-6))
    found: dict[str, Any] = {
        "jsrm, RK4 1 ms": fixed,
        "jsrm, dopri5 1e-3": adaptive,
    }
    notes, angles = dict[str, str](), dict[str, FloatArray]()
    for name, solve in found.items():
        began = time.perf_counter()
        angle = np.asarray(solve(start).block_until_ready())[:, 0] * length
        angles[name] = angle[9::10] if solve is fixed else angle[1:]
        compiled = time.perf_counter() - began
        apart = np.abs(angles[name] - angles["jsrm, RK4 1 ms"]).max()
        notes[name] = f"one segment; compiled in {compiled:.0f} s; {apart:.0e} rad from RK4"
    angle = angles["jsrm, RK4 1 ms"][:200]
    crossings = np.flatnonzero(np.diff(np.sign(angle)))
    assert 3.5 < 0.5 / (0.01 * np.diff(crossings).mean()) < 4.5 and np.abs(angle).max() < 0.6
    return {name: partial(lambda s: s(start).block_until_ready(), f) for name, f in found.items()}, notes


def rows(repeats: int = 5) -> list[Row]:
    """A swing of 20 s, each with steps and accuracy of its own."""
    plant, duration, job = Plant(), 20.0, "simulation, 20 s of free swing"
    start, times = state_row(plant, 0.5), np.linspace(0.0, duration, 2001)
    slope = usual(plant)

    def ode45() -> FloatArray:
        found = solve_ivp(slope, (0, duration), start[:6], t_eval=times, rtol=1e-3, atol=1e-6)
        return np.asarray(found.y[:2].T)

    def ours() -> FloatArray:
        return swing(plant, start, duration, 1e-3, every=10).q_m

    exact = swing_adaptive(plant, start, times, rtol=1e-12, atol=1e-14).q_m
    fine, rough = (float(np.abs(f() - exact).max()) for f in (ours, ode45))
    calls: dict[str, Callable[[], object]] = {"ours": ours, "lambdified solve_ivp": ode45}
    notes = {"lambdified solve_ivp": f"errors {fine:.0e} and {rough:.0e} m"}
    with contextlib.suppress(ImportError):
        rods, said = jsrm_swings(duration)
        calls, notes = calls | rods, notes | said
    for call in calls.values():
        call()
    seconds = interleaved(calls, repeats)
    own = seconds.pop("ours")
    out = [
        Row(job, name, own, found, 150.0 if name.startswith("jsrm") else 50.0, note=notes[name])
        for name, found in seconds.items()
    ]
    if len(seconds) == 1:
        out.append(Row(job, "jsrm", own, None, 150.0, note="not installed"))
    return out


def main() -> None:
    """Print what one core and two do, and the table."""
    began = time.perf_counter()
    simulate(pumps_connected(), PUMP, np.zeros((1, 2)))
    print(f"first call, compiled or loaded: {time.perf_counter() - began:.2f} s")
    for name, pump in (("rate limit", PUMP), ("orifice", replace(PUMP, deflation=Orifice()))):
        bare, whole, error = one_core(pump)
        print(f"one core, 1 ms, pumps with {name}: kernel {bare:.0f}, simulate() {whole:.0f} times real time")
        print(f"    largest error {error:.1e} m (target 8000 times, 1e-6 m)")
    for threads in (1, 2):
        wall, core = batch(200, threads)
        print(f"batch of 200 sets, {threads} threads: {wall:.0f} times real time, {core:.0f} per core in use")
    print("    target 18000 on two free cores")


if __name__ == "__main__":
    if "swing" not in sys.argv:
        main()
    print_rows(rows())
