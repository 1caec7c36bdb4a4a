"""Camera and IMU in line: time offset, mount angle, scales and biases from logs in motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from calib.core.errors import BadInputError
from calib.core.options import LogOptions, option
from calib.core.stage import Files, Stage, later
from calib.core.units import parse_length_m
from calib.core.verdict import Finding, Verdict

if TYPE_CHECKING:
    from calib.core.rig import Geometry, Rig
    from calib.stages.align.section import Align
    from calib.stages.align.solve import AlignLog, Settings


@dataclass(frozen=True)
class AlignOptions(LogOptions):
    """What a person has measured."""

    marker_offset_m: float | None = option(
        None,
        "Marker beyond the head, such as 15mm, measured to 1 mm.",
        flag="marker-offset",
        metavar="LENGTH",
        parse=parse_length_m,
    )


_SIGNED = ("ax_mps2", "ay_mps2", "gz_radps")
"""Columns of `geometry.imu_sign`."""


def _read(
    files: Files, rig: Rig, options: AlignOptions
) -> tuple[Sequence[AlignLog], Settings, Geometry | None, Mapping[str, int]]:
    from calib.core.rig import Geometry
    from calib.io.logs import read_log
    from calib.stages.align.read import align_log, settings_from_rig

    rig.current_plane(files.rig_path)
    files.hashes |= rig.identities("geometry", "camera", "plane")
    logs: list[AlignLog] = []
    signs: dict[str, int] = {}
    board = dict(zip(_SIGNED, (rig.geometry and rig.geometry.imu_sign) or (1, 1, 1), strict=True))
    for path in files.paths:
        read = read_log(path, options, files.remarks, rig.picture_px)
        log, remarks = align_log(read)
        if read.map is not None:
            sources = read.map.sources
            own = {name: -1 if sources[name].factor < 0.0 else 1 for name in _SIGNED if name in sources}
            signs |= {name: sign for name, sign in own.items() if sign != board[name]}
        files.remarks += remarks
        if log is not None:
            logs.append(replace(log, source=files.taken(path, read.beginning)))
    if not logs:
        raise BadInputError(files.remarks[-1])
    settings = settings_from_rig(rig, files.rig_path, logs, options.marker_offset_m)
    drawn = None if options.marker_offset_m is not None else rig.geometry or Geometry()
    return logs, settings, drawn, signs


def _solve(
    logs: Sequence[AlignLog], settings: Settings, drawing: Geometry | None, signs: Mapping[str, int]
) -> Align:
    """Fit, judge by the logs alone, weigh the drawing in, and assemble the section.

    Parameters
    ----------
    drawing : of the marker, None where it was measured.
    signs : by column that with which the logs were read, where the board has another one.
    """
    import numpy as np

    from calib.core.result import CovarianceTable, finite_or_none, judged
    from calib.stages.align.section import SENSORS_OF, Align
    from calib.stages.align.solve import align as fit
    from calib.stages.align.solve import judge, with_drawn_marker
    from calib.stages.estimator.sensors import SENSOR

    found = fit(logs, settings)
    verdict = judge(found)
    if drawing is not None:
        found, drawn = with_drawn_marker(found, drawing)
        verdict = Verdict.of([*verdict.findings, drawn])
    if signs:
        names = ", ".join(signs)
        text = f"{names}: the sign is turned where the logs are read, or on the board, alone"
        wanted = ", ".join(f"{sign:d} for {name}" for name, sign in signs.items())
        state = f"the board reads the sensor itself: state {wanted} in geometry.imu_sign, of ax, ay and gz"
        verdict = Verdict.of([*verdict.findings, Finding("poor", text, state)])

    def by_key(values: Mapping[str, Any]) -> dict[str, Any]:
        listed = {key: [values[name] for name in names] for key, names in SENSORS_OF.items()}
        return {key: some if len(some) > 1 else some[0] for key, some in listed.items()}

    sigma = dict(zip(SENSOR, map(finite_or_none, found.sigma.tolist()), strict=True))
    bounded = bool(np.isfinite(found.covariance).all())
    return Align(
        **by_key(dict(zip(SENSOR, found.sensor.tolist(), strict=True))),
        rest_angle_rad=found.rest_angle_rad,
        sigma=by_key(sigma) | {"rest_angle_rad": finite_or_none(found.rest_angle_sigma)},
        prior_sigma=dict(zip(SENSOR, found.prior.tolist(), strict=True)),
        covariance=CovarianceTable(order=list(SENSOR), values=found.covariance.tolist()) if bounded else None,
        jitter_px=found.noise.jitter_px,
        outlier_share=found.noise.share,
        accel_noise_mps2=found.noise.imu[:2].tolist(),
        gyro_noise_radps=float(found.noise.imu[2]),
        imu_age_s=found.noise.age_s or None,
        logs=list(found.logs),
        **judged(verdict),
    ).with_evidence(found)


align = Stage(
    "align",
    "Camera and IMU together",
    """Find time offset, mount angle, scales and biases between camera and IMU from logs in motion.

    A free swing shows the time offset, slow motion to large angles all the rest. Writes the section align
    of the rig's file. The head is that of an actuator that bends with constant curvature; a pendulum has
    none. Exits 1 when the verdict is not ok.
    """,
    _read,
    _solve,
    AlignOptions,
    sources="Logs of the rig in motion, static ones as well.",
    metavar="LOG...",
    leaves_out=True,
    writes=("align",),
    needs=("camera", "plane"),
    uses=("geometry", "imu", "imu_intrinsics"),
    plots=later("calib.stages.align.plots", "plots"),
)
