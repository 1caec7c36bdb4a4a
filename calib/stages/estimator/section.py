"""The section `estimator` of rig.yaml, which `calib replay --tune` writes, and what a log comes to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import ConfigDict, Field, PrivateAttr

from calib.core.errors import BadInputError, package
from calib.core.result import Count, Number, Result, Section, Sigma, quantity
from calib.core.words import Block, Table, number

if TYPE_CHECKING:
    from calib.core.arrays import FloatArray

Positive = Annotated[Number, Field(gt=0, le=1e9)]
NotNegative = Annotated[Number, Field(ge=0, le=1e9)]
Gain = Annotated[Number, Field(gt=0, lt=1)]
# The length of a late and precise picture is corrected by more than its residual, which its rate shares.
LateGain = Annotated[Number, Field(gt=0, lt=2)]


@dataclass(frozen=True)
class EstimatorLevel:
    """Process noise of one level, for phi [rad] and for the length [m].

    Attributes
    ----------
    name : for what it is made.
    accel_phi_radps2, accel_length_mps2 : standard deviation of the acceleration.
    memory_s : T_a of both. friction_s : T_v of the length; that of phi is infinite.
    walk_phi_rad_per_sqrt_s, walk_length_m_per_sqrt_s : density of w_p.
    """

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")

    name: str
    accel_phi_radps2: Positive
    accel_length_mps2: Positive
    memory_s: Positive
    friction_s: Positive
    walk_phi_rad_per_sqrt_s: NotNegative
    walk_length_m_per_sqrt_s: NotNegative

    def numbers(self) -> list[float]:
        """(1/T_a, 1/T_v, density of w_a, of w_p) of phi and then of the length."""
        b, c = 1.0 / self.friction_s, 1.0 / self.memory_s
        return [
            c, 0.0, 2.0 * self.accel_phi_radps2**2 * c, self.walk_phi_rad_per_sqrt_s**2,
            c, b, 2.0 * self.accel_length_mps2**2 * c, self.walk_length_m_per_sqrt_s**2,
        ]  # fmt: skip


@dataclass(frozen=True)
class EstimatorGain:
    """What the fused estimator of `calib.stages.estimator.constant_gain` runs with on a controller.

    Lengths are in metres, rates per tick.

    Attributes
    ----------
    rate_hz : of the ticks, 1 / T. delay_ticks : D, age of a picture. lever_m : l0 / 2 + d.
    camera_phi : K_c. accel_phi : K_a. bias : K_b.
    moving_length : K_m. moving_rate : K_v. rest_length : K_r. rate_decay : K_d.
    slow : K_s. moving_m : s_0. still_m : v_0. gate_m : of the residuals of a picture.
    """

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")

    rate_hz: Positive
    delay_ticks: Annotated[Number, Field(ge=0, le=8)]
    lever_m: Positive
    camera_phi: Gain
    accel_phi: Gain
    bias: Gain
    moving_length: LateGain
    moving_rate: Gain
    rest_length: Gain
    rate_decay: Gain
    slow: Gain
    moving_m: Positive
    still_m: Positive
    gate_m: Positive


class EstimatorDriven(Section):
    """Process noise of the driven model; densities of the walks of `calib.stages.estimator.driven.Drive`."""

    walk_disturbance_N_per_sqrt_s: Positive
    walk_turning_radps_per_sqrt_s: Positive
    walk_growing_mps_per_sqrt_s: Positive
    walk_forces_N_per_sqrt_s: Positive


class Estimator(Result):
    """Noise of the sensors and of the process, by maximum likelihood of innovations.

    Attributes
    ----------
    jitter_px : of the tracker, before rounding. accel_noise_mps2, gyro_noise_radps : of one sample.
    sigma : standard deviations by key, of the logarithm for the levels' factors.
    levels : the bank; none for the built-in one. driven : none where the logs had no commands.
    constant_gain : for a controller.
    gain_per_row : log likelihood that the tuning has won, per row of the logs.
    """

    jitter_px: Positive = quantity(label="tracker's jitter", digits=3, le=1e3)
    accel_noise_mps2: Positive | None = quantity(None, label="accel noise", digits=4, le=1e3)
    gyro_noise_radps: Positive | None = quantity(None, label="gyro noise", digits=4, le=1e3)
    sigma: Sigma = {}
    levels: list[EstimatorLevel] = []
    driven: EstimatorDriven | None = None
    constant_gain: EstimatorGain | None = None
    gain_per_row: Number | None = quantity(None, label="log likelihood won per row", digits=4)
    logs: list[str] = quantity([], label="logs")


# ----------------------------------------------------------------------
# A replayed log. It is no section of rig.yaml, but has a verdict and words as one has.

Errors = dict[str, float]
"""Errors against the truth after the first two seconds, by `consistency.Tally.rmse`."""

_ERRORS = {
    "q1_mm": ("q1, mm", 3),
    "q2_mm": ("q2, mm", 3),
    "mean_q_mm": ("mean, mm", 3),
    "phi_deg": ("phi, \N{DEGREE SIGN}", 4),
    "nees": ("NEES (2)", 2),
}
"""Those that are shown, and their digits behind the point."""


class SensorCheck(Section):
    """Innovations of a sensor after the first two seconds.

    Attributes
    ----------
    degrees : readings at a time. readings, gated : used, and gated out.
    nis, low, high : mean NIS and the 95 % band of white innovations; null where every reading was gated out.
    inside : share of readings within the 95 % band of a single one.
    correlation, correlation_bound : with the reading before, the largest of its axes, and its 95 % bound.
    """

    degrees: Count = quantity(label="degrees")
    readings: Count = quantity(label="readings")
    gated: Count = quantity(0, label="gated")
    nis: Number | None = quantity(None, label="NIS", digits=2)
    low: Number | None = quantity(None, label="95 % from", digits=2)
    high: Number | None = quantity(None, label="to", digits=2)
    inside: Number | None = quantity(None, label="inside", show="%", digits=1)
    correlation: Number | None = quantity(None, label="correlation", digits=2)
    correlation_bound: Number | None = None


@dataclass(frozen=True)
class Held:
    """Arrays of a replayed log.

    Attributes
    ----------
    trace : rows for figures, thinned out: `kinematic.OUT`, then q1, q2, phi of the baseline, then the truth.
    columns : of the states. states : (n, columns), None where they were written to a file or not wanted.
    """

    trace: FloatArray
    columns: tuple[str, ...]
    states: FloatArray | None


class Replayed(Result):
    """What a log has come to: its states, errors against a truth, consistency, and a verdict.

    Attributes
    ----------
    source, rows, duration_s : of the log. estimator : "fused", "smoothed", "baseline" or "filterpy".
    driven_share : of the rows, in which the driven model speaks; null where there is none.
    rmse, compared : errors against the truth, of this estimator and of others.
    sensors : consistency by sensor. flags : rows by flag. jitter_px : of the tracker, that was used.
    pose_noise_mm : of the tip's place where that stands for pictures, in either direction.
    """

    source: str = quantity(label="log")
    rows: Count = quantity(label="rows")
    duration_s: Number = quantity(label="duration", digits=2)
    estimator: str = quantity(label="estimator")
    driven_share: Number | None = quantity(None, label="driven model speaks in", show="%", digits=0)
    jitter_px: Number | None = quantity(None, label="tracker's jitter", digits=2)
    pose_noise_mm: Number | None = quantity(None, label="noise of the tip's place", digits=2)
    rmse: Errors = {}
    compared: dict[str, Errors] = {}
    sensors: dict[str, SensorCheck] = quantity({}, label="sensor")
    flags: dict[str, int] = {}

    _tuned: Estimator | None = PrivateAttr(default=None)

    @property
    def tuned(self) -> Estimator | None:
        """The noise that was learnt from the logs before they were replayed, None without `tune`."""
        return self._tuned

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the states."""
        held: Held = self.evidence
        return held.columns

    @property
    def states(self) -> FloatArray:
        """The states (n, columns). Raises `BadInputError` where they were written to a file."""
        held: Held = self.evidence
        if held.states is None:
            raise BadInputError(
                f"the states of {self.source} were written to a file and are not held as well"
            )
        return held.states

    def to_pandas(self) -> Any:
        """The states as a pandas DataFrame. Raises `BadInputError` without pandas."""
        pandas = package("pandas", "a table for pandas needs pandas: pip install pandas")
        return pandas.DataFrame(self.states, columns=list(self.columns))

    def save(self, path: str | Path) -> None:
        """Write the states as .csv, .parquet or .mcap. Raises `BadInputError`."""
        from calib.io.states import states_writer

        with states_writer(Path(path), self.columns) as add:
            add(self.states)

    def more_words(self) -> list[Block]:
        """Errors of this estimator and of others, side by side."""
        if not self.rmse:
            return []

        def cells(name: str, errors: Errors) -> tuple[str, ...]:
            shown = ((errors.get(key), places) for key, (_, places) in _ERRORS.items())
            return (name, *(number(value, places=places) for value, places in shown))

        head = ("RMSE after 2 s", *(label for label, _ in _ERRORS.values()))
        rows = [cells("this", self.rmse), *(cells(name, errors) for name, errors in self.compared.items())]
        return [Table(head, tuple(rows), head[0])]
