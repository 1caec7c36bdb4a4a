"""The stages of a run: each is a command as a person would type it, and what it depends on.

A later verb joins by one row in `STAGES`. A stage sees only the sections of the rig's file that its row
names (and what the person wrote into the folder's own rig.yaml), so that what it does cannot depend on
anything else, and the sections that it writes are those that its row names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from calib.running.folder import Folder, LogFile, with_topics

__all__ = ["STAGES", "Job", "Planned", "Stage", "jobs_of", "urgency"]

_IMU = ("ax_mps2", "ay_mps2", "gz_radps")
_CAMERA = ("u_px", "v_px")
_PUMP = ("pwm1", "pwm2")


@dataclass(frozen=True)
class Planned:
    """Arguments of a stage's verb, without those that all stages have, and the files that it reads."""

    arguments: tuple[str, ...]
    inputs: tuple[Path, ...]


Plan = Callable[[Folder], Planned | str]
"""What a stage does with a folder, or why it has nothing to do."""


@dataclass(frozen=True)
class Stage:
    """A row of the table.

    Attributes
    ----------
    name : the stage's folder and anchor. title : its heading.
    verb : words of the command.
    plan : arguments and inputs for a folder; `plan_log` instead for a stage that runs once for each log.
    writes : sections of the rig's file. needs : sections without which it cannot run. uses : sections that
        it reads where they are.
    output : name of what it writes with -o, "" for nothing. figures : whether it draws.
    flashed : whether its result goes into the firmware.
    seconds : about how long it takes, by which the runner begins what holds up most.
    """

    name: str
    title: str
    verb: tuple[str, ...]
    plan: Plan | None = None
    plan_log: Callable[[LogFile], Planned | str] | None = None
    writes: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    output: str = ""
    figures: bool = True
    flashed: bool = False
    seconds: float = 1.0


@dataclass(frozen=True)
class Job:
    """A stage with its part of the folder: what to run, or why not.

    Attributes
    ----------
    name : unique, and safe as a path: that of the stage, or stage and log.
    log : of a stage that runs for each log.
    planned : None where `reason` says why there is nothing to do.
    """

    name: str
    stage: Stage
    log: LogFile | None
    planned: Planned | None
    reason: str = ""


def _given(paths: tuple[Path, ...], *more: str) -> Planned:
    return Planned((*(str(path) for path in paths), *more), with_topics(paths))


def _logs(folder: Folder, kind: str, *columns: str) -> tuple[Path, ...]:
    return tuple(log.path for log in folder.logs if log.kind == kind and log.has(*columns))


def _linked(folder: Folder, start: str) -> str:
    return next((sentence for sentence in folder.left_out if sentence.startswith(start)), "")


def _intrinsics(folder: Folder) -> Planned | str:
    if not folder.pictures:
        return "no pictures in images/"
    linked = _linked(folder, "images/board.yaml")
    board = () if folder.board is None else (folder.board,)
    return linked or Planned(tuple(map(str, folder.pictures)), (*folder.pictures, *board))


def _extrinsics(folder: Folder) -> Planned | str:
    if not folder.plane:
        return "no pictures in images/plane/"
    if linked := _linked(folder, "images/plane/"):
        return linked
    board = () if folder.plane_board is None else (folder.plane_board,)
    return Planned((str(folder.root / "images" / "plane"),), (*folder.plane, *board))


def _static(folder: Folder) -> Planned | str:
    logs = _logs(folder, "rest", *_IMU)
    return _given(logs) if logs else "no logs of an IMU at rest, logs/static*.csv"


def _poses(folder: Folder) -> Planned | str:
    logs = _logs(folder, "poses", *_IMU)
    return _given(logs[:1]) if logs else "no log of rests in different poses, logs/poses*.csv"


def _moving(folder: Folder) -> Planned | str:
    logs = _logs(folder, "motion", *_IMU)
    return _given(logs) if logs else "no logs of an IMU in motion in logs/"


def _drift(folder: Folder) -> Planned | str:
    logs = (*_logs(folder, "rest", *_IMU), *_logs(folder, "motion", *_IMU)[:1])
    # What is installed beside calib must not change the page.
    return _given(logs, "--no-peers") if logs else "no logs of an IMU in logs/"


def _lowpass(folder: Folder) -> Planned | str:
    logs = _logs(folder, "motion", *_CAMERA)
    if not logs:
        return Planned((), ())
    return Planned(("--log", str(logs[0])), with_topics(logs[:1]))


def _both(folder: Folder) -> Planned | str:
    logs = _logs(folder, "motion", *_IMU, *_CAMERA)
    return _given(logs) if logs else "no logs of camera and IMU in motion in logs/"


def _identify(folder: Folder) -> Planned | str:
    logs = _logs(folder, "motion", *_CAMERA, *_PUMP)
    # A fit without each log in turn takes as many times as long, and is left to the verb.
    return _given(logs, "--no-hold-back") if logs else "no logs with camera and PWM in logs/"


def _driven(folder: Folder) -> Planned | str:
    logs = _logs(folder, "motion", *_CAMERA, *_PUMP)
    return _given(logs) if logs else "no logs with camera and PWM in logs/"


def _nothing(_: Folder) -> Planned | str:
    return Planned((), ())


def _replay(log: LogFile) -> Planned | str:
    if not (log.has(*_CAMERA) or log.has(*_IMU)):
        return "the log has neither a camera nor an IMU"
    return Planned((str(log.path),), with_topics([log.path]))


_OPTICS = ("camera", "plane")
_SENSORS = (*_OPTICS, "lens", "imu", "imu_intrinsics", "orientation_filter", "lowpass", "align", "estimator")
_MACHINE = ("actuator", "pump")

STAGES: tuple[Stage, ...] = (
    Stage("intrinsics", "Camera", ("intrinsics",), _intrinsics, writes=("camera",), flashed=True,
          seconds=5.0),
    Stage("extrinsics", "Plane of motion", ("extrinsics",), _extrinsics, writes=("plane",), needs=("camera",),
          flashed=True, seconds=3.0),
    Stage("distortion", "Lens", ("distortion",), _nothing, writes=("lens",), needs=("camera",),
          uses=("plane",)),
    Stage("imu-static", "IMU at rest", ("imu", "static"), _static, writes=("imu",), flashed=True,
          seconds=4.0),
    Stage("imu-intrinsics", "IMU in poses", ("imu", "intrinsics"), _poses, writes=("imu_intrinsics",),
          uses=("imu",)),
    Stage("imu-tune", "Angle filter", ("imu", "tune"), _moving, writes=("orientation_filter",),
          uses=(*_OPTICS, "imu", "imu_intrinsics"), flashed=True, seconds=4.0),
    Stage("imu-drift", "Drift of the angle", ("imu", "drift"), _drift,
          uses=("imu", "imu_intrinsics", "orientation_filter"), seconds=2.0),
    Stage("lowpass", "Low-pass", ("lowpass",), _lowpass, writes=("lowpass",), uses=_OPTICS, flashed=True,
          seconds=3.0),
    Stage("align", "Camera and IMU together", ("align",), _both, writes=("align",), needs=_OPTICS,
          uses=("imu", "imu_intrinsics"), flashed=True, seconds=9.0),
    Stage("identify", "Model of the actuator", ("identify", "logs"), _identify, writes=_MACHINE,
          needs=_OPTICS, uses=_SENSORS, seconds=9.0),
    Stage("replay", "States", ("replay",), None, _replay, needs=_OPTICS, uses=(*_SENSORS, *_MACHINE),
          output="states.csv", seconds=2.0),
    Stage("control", "Controllers", ("control", "tune"), _nothing, writes=("controller",),
          uses=(*_OPTICS, *_MACHINE), flashed=True, seconds=3.0),
    Stage("validate", "Model against log", ("validate",), _driven, needs=_OPTICS,
          uses=(*_SENSORS, *_MACHINE, "controller"), seconds=8.0),
    Stage("firmware", "Firmware", ("firmware",), _nothing, needs=("camera",),
          uses=(*_SENSORS, *_MACHINE, "controller"), output="firmware", figures=False),
)  # fmt: skip
"""All stages, each after those whose sections it reads."""


def urgency(stages: tuple[Stage, ...] = STAGES) -> dict[str, float]:
    """Seconds from the start of each stage to the end of all that waits for it, by name."""
    out: dict[str, float] = {}
    for stage in reversed(stages):
        waits = [out[other.name] for other in stages if other.name in out
                 and {*other.needs, *other.uses} & set(stage.writes)]  # fmt: skip
        out[stage.name] = stage.seconds + max(waits, default=0.0)
    return out


def jobs_of(folder: Folder, stages: tuple[Stage, ...] = STAGES) -> Iterator[Job]:
    """The work that a folder asks for, in the table's order."""
    for stage in stages:
        if stage.plan_log is not None:
            if not folder.logs:
                yield Job(stage.name, stage, None, None, "no logs in logs/")
            for log in folder.logs:
                yield _job(f"{stage.name}-{log.slug}", stage, log, stage.plan_log(log))
        elif stage.plan is not None:
            yield _job(stage.name, stage, None, stage.plan(folder))


def _job(name: str, stage: Stage, log: LogFile | None, planned: Planned | str) -> Job:
    if isinstance(planned, str):
        return Job(name, stage, log, None, planned)
    return Job(name, stage, log, planned)
