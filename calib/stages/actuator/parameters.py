"""Parameters of the actuator: mass, springs, dampers, bending and creep.

The defaults are the nominal plant: a set fitted to the source's text, not to measurements. A value
that the model cannot run with is refused with one sentence; creep whose energy grows by itself is
refused together with its growth rate.

Forces are positive when they pull the bellows back to the rest length l0, eps = q - l0:

    spring    F = c_spr k(eps) eps, k = k0 + k1 eps + k2 eps^2 + k3 eps^3 for eps >= 0, k0 below  (3.38, 3.47)
    damper    F = 2 c_dmp zeta dq sqrt(m k / 2)                                                 (3.41, 3.48)
    bending   dM/dq1 = k_bnd phi |phi| = -dM/dq2                                                (3.44)
    creep     dz/dt = -lambda1 z + lambda2 dq, and lambda3 z on the right-hand side        (3.45, 3.46)

Departures from print: the spring's sign in (3.38) is exponentially unstable on the left-hand side;
k_bnd = 169.49 can only be mN/rad^2; lambda1 = -0.1047 makes the creep grow. (3.41) is the axial
relation, so zeta = 0.0513 measured laterally needs c_dmp = 3.3.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace

import numpy as np

from calib.core.errors import BadInputError

DAMPING_SCALE_FREE = 3.3
"""c_dmp of a swing with the hoses off."""

DAMPING_SCALE_PUMPS = 16.0
"""c_dmp with the pumps connected: the air in hoses and orifices damps as well."""

SUPPLY_V = 12.0
"""Of the pumps at PWM 255."""

TICK_S = 1.0 / 60.0
"""Of the commands, and so of the board's loop."""

LONGEST_ELONGATION_M = 0.04
"""Up to here a stiffness law has to stay positive; 12 V reach 0.0266 m."""

_ELONGATIONS_M = np.linspace(0.0, LONGEST_ELONGATION_M, 81)


class UnstablePlantWarning(UserWarning):
    """The parameters describe a plant that moves away from rest by itself."""


@dataclass(frozen=True)
class Stiffness:
    """Spring law of one bellows, F = k(eps) eps (3.38).

    Attributes
    ----------
    coefficients : k0 [N/m], k1 [N/m^2], ... up to k3; a single one is a linear spring. Below the rest
        length the spring is linear with k0.

    Raises `BadInputError` for a law that is not positive up to `LONGEST_ELONGATION_M`.
    """

    coefficients: tuple[float, ...] = (47.7, 1092.9)

    def __post_init__(self) -> None:
        softest = float(np.polyval(self.coefficients[::-1], _ELONGATIONS_M).min())
        if softest <= 0.0:
            raise BadInputError(
                f"stiffness: found {softest:g} N/m between 0 and {LONGEST_ELONGATION_M:g} m of elongation, "
                "expected a positive law"
            )

    @property
    def padded(self) -> tuple[float, float, float, float]:
        """k0 .. k3 with the missing ones as zero."""
        k = (*self.coefficients, 0.0, 0.0, 0.0)
        return k[0], k[1], k[2], k[3]

    def secant(self, eps: float) -> float:
        """k(eps) [N/m] of (3.38) at the elongation eps [m]."""
        stretch, total = max(eps, 0.0), 0.0
        for value in reversed(self.coefficients):
            total = total * stretch + value
        return total

    def tangent(self, eps: float) -> float:
        """dF/deps [N/m] at the elongation eps [m]."""
        stretch = max(eps, 0.0)
        return sum((n + 1) * value * stretch**n for n, value in enumerate(self.coefficients))


@dataclass(frozen=True)
class Creep:
    """Viscoelastic creep of (3.45), (3.46), z in newton.

    The element stores |lambda3 / lambda2| z^2 / 2 and loses lambda1 times twice that, so it is passive
    exactly for lambda1 >= 0 and lambda2 lambda3 < 0.

    Attributes
    ----------
    lambda1_per_s : relaxation rate; negative ones make z grow.
    lambda2_N_per_m : force per strain.
    lambda3 : factor on the right-hand side.
    """

    lambda1_per_s: float = 3.0
    lambda2_N_per_m: float = 10.0
    lambda3: float = -1.0

    @property
    def rates(self) -> tuple[float, float, float]:
        """lambda1 [1/s], lambda2 [N/m], lambda3."""
        return self.lambda1_per_s, self.lambda2_N_per_m, self.lambda3


@dataclass(frozen=True)
class Plant:
    """Mechanical parameters of one section.

    Attributes
    ----------
    mass_kg, inertia_kgm2, bellows_radius_m, rest_length_m : Table 3.1.
    stiffness : law of one bellows; stiffness_scale is c_spr of (3.47), on the spring alone.
    damping_ratio, damping_scale : zeta of (3.41) and c_dmp of (3.48).
    bending_N_per_rad2 : k_bnd of (3.44) in newton.
    creep : `Creep` or None.
    gravity_mps2 : (x, y) in the world frame. Off by default, since l0 is the hanging rest length.
    allow_unstable : warn instead of refusing parameters that grow by themselves.

    Raises `BadInputError` for values that no plant can have.
    """

    mass_kg: float = 0.0166
    inertia_kgm2: float = 1.27e-5
    bellows_radius_m: float = 0.0126
    rest_length_m: float = 0.065
    stiffness: Stiffness = Stiffness()
    stiffness_scale: float = 1.0
    damping_ratio: float = 0.0513
    damping_scale: float = DAMPING_SCALE_FREE
    bending_N_per_rad2: float = 0.1695
    creep: Creep | None = Creep()
    gravity_mps2: tuple[float, float] = (0.0, 0.0)
    allow_unstable: bool = False

    def __post_init__(self) -> None:
        growth = growth_rate_per_s(self)
        if growth <= 0.0:
            return
        l1, l2, l3 = self.creep_rates
        sentence = (
            f"creep: lambda1 = {l1:g} 1/s, lambda2 = {l2:g} N/m, lambda3 = {l3:g} make the plant unstable: "
            f"it leaves rest at {growth:.3g} 1/s (e-fold in {1.0 / growth:.3g} s)"
        )
        if not self.allow_unstable:
            raise BadInputError(f"{sentence}; expected lambda1 > 0 and lambda2 lambda3 < 0")
        warnings.warn(sentence, UnstablePlantWarning, stacklevel=3)

    @property
    def creep_rates(self) -> tuple[float, float, float]:
        """lambda1 [1/s], lambda2 [N/m], lambda3; zeros without creep."""
        return (0.0, 0.0, 0.0) if self.creep is None else self.creep.rates

    @property
    def damping_Ns_per_sqrt_N_per_m(self) -> float:
        """2 c_dmp zeta sqrt(m / 2) of (3.48): times sqrt(k) it is a bellows' damping [N s/m]."""
        return 2.0 * self.damping_scale * self.damping_ratio * math.sqrt(0.5 * self.mass_kg)


def pumps_connected() -> Plant:
    """The nominal plant with the pumps connected."""
    return replace(Plant(), damping_scale=DAMPING_SCALE_PUMPS)


def growth_rate_per_s(plant: Plant) -> float:
    """Fastest growth [1/s] of small motion about the straight rest, without gravity; 0 if none grows.

    Stretching and bending decouple there. With mu = m / 2 for stretching and J_0 / (2 r_B^2),
    J_0 = m l0^2 / 4 + J, for bending, both follow

        (mu s^2 + c s + k)(s + lambda1) = lambda2 lambda3 s,

    which has no growing root when its coefficients pass the test of Routh and Hurwitz.
    """
    k = plant.stiffness_scale * plant.stiffness.secant(0.0)
    c = plant.damping_Ns_per_sqrt_N_per_m * math.sqrt(plant.stiffness.secant(0.0))
    l1, l2, l3 = plant.creep_rates
    J0 = 0.25 * plant.mass_kg * plant.rest_length_m**2 + plant.inertia_kgm2
    worst = 0.0
    for mu in (0.5 * plant.mass_kg, 0.5 * J0 / plant.bellows_radius_m**2):
        a3, a2, a1, a0 = mu, c + mu * l1, k + c * l1 - l2 * l3, k * l1
        if min(a2, a1, a0) >= 0.0 and a2 * a1 >= a3 * a0:
            continue
        roots = np.roots([a3, a2, a1, a0])
        growth = float(roots.real.max())
        # Rounding puts the roots of an undamped plant on either side of the axis.
        if growth > 1e-9 * float(np.abs(roots).max()):
            worst = max(worst, growth)
    return worst
