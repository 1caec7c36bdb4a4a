"""Lengths, angle and pose from logs of camera and IMU; with --tune the noise is learnt from them first.

Logs may be longer than memory, so `solve` reads and writes block by block; what `read` hands over are paths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from calib.core.errors import BadInputError, UsageError
from calib.core.options import LogOptions, option
from calib.core.stage import Files, Output, Stage, later

if TYPE_CHECKING:
    from calib.core.rig import Rig
    from calib.stages.estimator.section import Replayed


@dataclass(frozen=True)
class ReplayOptions(LogOptions):
    """Which estimator, and what it may use."""

    states_format: Literal["csv", "parquet", "mcap"] = option(
        "csv", "Of the states of several logs.", flag="format"
    )
    estimator: Literal["fused", "baseline", "filterpy"] = option(
        "fused",
        "The fused filter, the low-pass pipeline that it replaces, or the extended filter of the filterpy "
        "library, to check the equations.",
    )
    model: Literal["auto", "kinematic", "driven"] = option(
        "auto", "Driven by the commands in the log, kinematic, or (auto) whichever explains the log better."
    )
    smooth: bool = option(False, "Look at the whole log, forward and backward.")
    tune: bool = option(False, "Learn the noise from these logs; written to the rig's file.")


def _read(
    files: Files, rig: Rig, options: ReplayOptions
) -> tuple[Files, Rig, ReplayOptions, Sequence[Path | None]]:
    from calib.core.writing import check_folder, check_writable, make_folder
    from calib.io.states import STATES_FILE

    if options.estimator != "fused" and (options.smooth or options.tune):
        raise UsageError(f"--estimator {options.estimator}: cannot be smoothed or tuned")
    outputs: list[Path | None] = [files.output] * len(files.paths)
    if files.output is not None and len(files.named) > 1:
        check_folder(files.output)
        make_folder(files.output)
        outputs = _names(files.paths, files.output, options.states_format)
    elif files.output is not None:
        check_writable(files.output, STATES_FILE)
    if options.tune:
        files.hashes |= rig.identities("camera", "plane", "imu", "align")
        for path in files.paths:
            files.taken(path)
    return files, rig, options, outputs


def _names(paths: Sequence[Path], folder: Path, ending: str) -> list[Path | None]:
    """A file in a folder for the states of each log.

    Names of logs may hold anything, and two logs in different folders may share one.
    """
    from calib.core.files import inside, shown, slug
    from calib.core.writing import check_writable
    from calib.io.states import STATES_FILE

    slugs: list[str] = []
    out: list[Path | None] = []
    for path in paths:
        slugs.append(slug(path.stem, slugs))
        states = folder / f"{slugs[-1]}_states.{ending}"
        if states.is_symlink() and not inside(states, folder):
            raise BadInputError(f"{shown(states)}: is a link out of {shown(folder)}, nothing was written")
        check_writable(states, STATES_FILE)
        out.append(states)
    return out


def _solve(files: Files, rig: Rig, options: ReplayOptions, outputs: Sequence[Path | None]) -> list[Replayed]:
    """From logs with the files for their states."""
    from calib.core.files import shown
    from calib.stages.estimator.replay import replay_log

    tuned = None
    if options.tune:
        from calib.stages.estimator.tuning import tuned_section

        with files.progress("tuning") as progress:
            tuned = tuned_section(files.paths, rig, files.rig_path, progress, options)
        tuned.made_by("replay", files.hashes)
        rig = rig.with_sections({"estimator": tuned})
    results = []
    for path, output in zip(files.paths, outputs, strict=True):
        with files.one_of_several(path), files.progress(f"replaying {path.name}") as progress:
            result = replay_log(
                path,
                rig,
                files.rig_path,
                options.estimator,
                options.model,
                options.smooth,
                options,
                output,
                progress,
                files.figures,
                files.keep,
            )
            result._tuned = tuned
            results.append(result)
            if output is not None:
                files.narrate(f"states written to {shown(output)}")
    if not results:
        files.finish()
    return results


def _document(results: list[Replayed]) -> dict[str, Any]:
    from calib.core.result import section_json

    return {"replay": {"logs": [section_json(one, whole=True) for one in results]}}


replay = Stage(
    "replay",
    "States",
    """Estimate lengths, angle and pose from logs, with standard deviations and what they are worth.

    The head is that of an actuator that bends with constant curvature; a pendulum has none. Exits 1 when the
    innovations of a log contradict its covariance or a sensor is missing.
    """,
    _read,
    _solve,
    ReplayOptions,
    sources="Logs of camera and IMU, or of motion capture in place of the camera.",
    metavar="LOG...",
    leaves_out=True,
    output=Output(
        "States to write, .csv, .parquet or .mcap; with several logs a folder, made if needed.", None
    ),
    writes=("estimator",),
    parts=lambda results: (results[0].tuned,),
    on_request="tune",
    uses=("camera", "plane", "geometry", "imu", "align", "actuator", "pump", "estimator"),
    document=_document,
    plots=later("calib.stages.estimator.plots", "plots"),
)
