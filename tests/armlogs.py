"""A simulated arm that is swung by hand in the vertical plane, with a sensor on it and its true angle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

G = 9.81


@dataclass(frozen=True)
class Arm:
    """Readings (n,) in the plane and the truth; gz is minus the rate of phi."""

    t_s: np.ndarray
    ax: np.ndarray
    ay: np.ndarray
    gz: np.ndarray
    phi: np.ndarray

    @property
    def phi_acc(self) -> np.ndarray:
        return np.arctan2(self.ay, self.ax)


def swung(
    seed: int = 0,
    duration_s: float = 30.0,
    rate_hz: float = 100.0,
    amplitude_rad: float = 0.4,
    lever_m: float = 0.2,
    bias_radps: float = 0.005,
    rest_s: float = 2.0,
) -> Arm:
    """Slow waves and quick moves after a rest; the sensor feels its own acceleration at the lever."""
    rng = np.random.default_rng(seed)
    finer = 10
    t = np.arange(round(duration_s * rate_hz) * finer) / (rate_hz * finer)
    phi = np.zeros_like(t)
    for _ in range(3):
        f = rng.uniform(0.05, 0.5)
        phi += (
            amplitude_rad
            * rng.uniform(0.2, 1.0)
            / (1.0 + 2.0 * f)
            * np.sin(2.0 * np.pi * f * t + rng.uniform(0, 6))
        )
    for _ in range(3):
        phi += amplitude_rad * rng.uniform(-0.4, 0.4) * np.tanh((t - rng.uniform(2.0, duration_s)) / 0.3)
    phi /= 1.0 + np.exp(-np.clip((t - rest_s - 1.0) / 0.2, -500.0, 500.0))
    rate = np.gradient(phi, t)
    turn = np.gradient(rate, t)
    at = slice(None, None, finer)
    n = len(t[at])
    ax = G * np.cos(phi) + lever_m * rate**2
    ay = G * np.sin(phi) + lever_m * turn
    gz = -1.005 * rate[at] - bias_radps - np.radians(0.01) * np.sqrt(rate_hz) * rng.normal(size=n)
    noise = 0.02 * rng.normal(size=(2, n))
    return Arm(t[at], ax[at] + 0.02 + noise[0], ay[at] + noise[1], gz, phi[at])


def write(path: Path, arm: Arm, truth: bool = True, rows: np.ndarray | None = None) -> Path:
    """The arm's log as CSV."""
    columns = [arm.t_s, arm.ax, arm.ay, arm.gz, *([arm.phi] if truth else [])]
    head = "t_s,ax_mps2,ay_mps2,gz_radps" + (",true_phi_rad" if truth else "")
    table = np.stack(columns, axis=1)[slice(None) if rows is None else rows]
    lines = [f"{row[0]:.6f}," + ",".join(f"{value:.8g}" for value in row[1:]) for row in table.tolist()]
    path.write_text("\n".join([head, *lines]) + "\n")
    return path
