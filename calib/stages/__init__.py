"""The stages of a calibration: each folder has its mathematics, its section of rig.yaml and its verb.

`STAGES` lists them in the order of a calibration; all that is derived from a stage looks here.
"""

from __future__ import annotations

import glob
import importlib
import inspect
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib.core.arguments import taken
from calib.core.command import one_command
from calib.core.errors import BadInputError, SomeFailedError, UsageError
from calib.core.options import options_of
from calib.core.stage import AnyStage, Files

if TYPE_CHECKING:
    from calib.core.rig import Rig

STAGES = {
    "intrinsics": "calib.stages.camera.stage",
    "extrinsics": "calib.stages.camera.stage",
    "distortion": "calib.stages.camera.stage",
    "lowpass": "calib.stages.lowpass.stage",
    "imu static": "calib.stages.imu.stage",
    "imu intrinsics": "calib.stages.imu.stage",
    "imu tune": "calib.stages.imu.stage",
    "imu drift": "calib.stages.imu.stage",
    "align": "calib.stages.align.stage",
    "identify logs": "calib.stages.actuator.stage",
    "identify arm": "calib.stages.arm.stage",
    "identify pump": "calib.stages.actuator.stage",
    "identify stiffness": "calib.stages.actuator.stage",
    "replay": "calib.stages.estimator.stage",
    "control run": "calib.stages.control.stage",
    "control check": "calib.stages.control.stage",
    "control tune": "calib.stages.control.stage",
    "validate": "calib.stages.actuator.stage",
    "firmware": "calib.stages.firmware.stage",
}
"""Module of each stage by the words of its verb; the last word is its name there."""


def stage(name: str) -> AnyStage:
    """The stage with this verb."""
    found: AnyStage = getattr(importlib.import_module(STAGES[name]), name.split()[-1])
    return found


def expanded(sources: Any) -> tuple[Path, ...]:
    """Paths from a path, a pattern such as `logs/swing*.csv`, or several of them."""
    if sources is None:
        return ()
    if isinstance(sources, str | Path):
        text = str(sources)
        if not glob.has_magic(text) or Path(text).exists():
            return (Path(text),)
        matches = sorted(glob.glob(text, recursive=True))  # noqa: PTH207  a pattern may be absolute
        if not matches:
            raise BadInputError(f"{text}: matches no file")
        return tuple(Path(one) for one in matches)
    # A table would give the names of its columns.
    table = isinstance(sources, bytes | Mapping) or hasattr(sources, "columns")
    if table or not isinstance(sources, Iterable):
        raise UsageError(f"found {type(sources).__name__}, expected a path, a pattern, or several of them")
    return tuple(path for one in sources for path in expanded(one))


def function(name: str) -> Callable[..., Any]:
    """The Python function of a stage: `calib.NAME(sources, rig, option=value)` returns its result.

    Of a stage that answers for each file by itself it is a list, or the one result of one file.
    """
    made, told = stage(name), f"calib.{name.replace(' ', '.')}"
    streams = made.output is not None and made.output.write is None

    def call(
        sources: str | Path | Sequence[str | Path] | None = None, rig: Rig | None = None, **options: Any
    ) -> Any:
        from calib.core.rig import Rig

        rig = Rig() if rig is None else taken(rig, Rig, f"{told}: rig")
        output = taken(options.pop("output", None), Path | None, f"{told}: output") if streams else None
        paths = expanded(sources)
        if made.sources and not made.optional and not paths:
            raise UsageError(f"{told}: found no paths; it takes: {made.sources}")
        files = Files(
            paths,
            output=output,
            narrate=logging.getLogger("calib").info,
        )
        with one_command(files.paths):
            outcome = made.run(files, rig, options_of(made.options, options, told))
        try:
            files.finish()
        except SomeFailedError as error:
            why = (words for _, words in files.failed.values())
            raise SomeFailedError("; ".join([str(error), *why]), error.exit_code) from None
        return outcome[0] if isinstance(outcome, list) and len(outcome) == 1 else outcome

    def call_without_sources(rig: Rig | None = None, **options: Any) -> Any:
        return call(None, rig, **options)

    public: Any = call if made.sources else call_without_sources
    kind = inspect.Parameter
    parameters = [
        kind("rig", kind.POSITIONAL_OR_KEYWORD, default=None),
        *(
            kind(one.name, kind.KEYWORD_ONLY, default=None if one.default is MISSING else one.default)
            for one in fields(made.options)
        ),
    ]
    if streams:
        parameters.insert(1, kind("output", kind.KEYWORD_ONLY, default=None))
    if made.sources:
        parameters.insert(0, kind("sources", kind.POSITIONAL_OR_KEYWORD, default=kind.empty))
    options = "\n".join(f"    {one.name} : {one.metadata['words']}" for one in fields(made.options))
    public.__name__, public.__qualname__ = name.split()[-1], name.replace(" ", ".")
    public.__module__ = "calib"
    public.__doc__ = made.summary.rstrip() + (
        f"\n\n    Returns the result; the file and the exit code are those of `calib {name}` alone."
        + (f"\n\n    Options\n    -------\n{options}\n    " if options else "")
    )
    public.__signature__ = inspect.Signature(parameters)
    made_function: Callable[..., Any] = public
    return made_function
