"""Calibrate a cheap camera and an IMU on a machine, down to the constants in its firmware.

    import calib
    rig = calib.Rig.load("rig.yaml", missing_ok=True)
    rig.camera = calib.intrinsics("images/")
    rig.plane = calib.extrinsics("images/plane/", rig)
    rig.save("rig.yaml")

Each verb of the command line is a function here: it takes paths (or a pattern), the rig, and the verb's
options in SI units or as text with a unit, and returns the section of rig.yaml with its verdict. No file
has it until `save`. Names are loaded when they are first used.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from typing import Any

from calib.core import __version__ as __version__

_PLACES = {
    "Rig": "calib.core.rig:Rig",
    "Log": "calib.io.logs:Log",
    "Verdict": "calib.core.verdict:Verdict",
    "Finding": "calib.core.verdict:Finding",
    "plots": "calib.show.draw:plots",
    "run": "calib.runner.outputs:calibrate",
    "simulate": "calib.twin.scenarios:simulate",
}
"""Names of the front door that are no stages, and where they are."""

_BY_DEFAULT = {"identify": "identify logs"}
"""Verb of two words that its first word alone stands for."""

__all__ = [
    "Finding",
    "Log",
    "Rig",
    "Verdict",
    "align",
    "control",
    "distortion",
    "extrinsics",
    "firmware",
    "identify",
    "imu",
    "intrinsics",
    "lowpass",
    "plots",
    "replay",
    "run",
    "simulate",
    "validate",
]


def __getattr__(name: str) -> Any:
    if name in _PLACES:
        module, _, attribute = _PLACES[name].partition(":")
        value: Any = getattr(importlib.import_module(module), attribute)
        if inspect.isfunction(value):
            from calib.core.arguments import checked

            value = checked(value, name)
    elif name in __all__:
        value = _verb(name)
    else:
        raise AttributeError(f"module 'calib' has no attribute {name!r}")
    globals()[name] = value
    return value


def _verb(name: str) -> Callable[..., Any]:
    """The function of a verb, with those of two words: `calib.imu.static` is `calib imu static`."""
    from calib.stages import STAGES, function

    members = {one.split()[-1]: function(one) for one in STAGES if one.startswith(f"{name} ")}
    alone = _BY_DEFAULT.get(name, name)

    def choose(*args: Any, **options: Any) -> Any:
        from calib.core.errors import UsageError

        del args, options
        names = ", ".join(f"calib.{name}.{one}" for one in members)
        raise UsageError(f"calib.{name} is no function by itself; call one of {names}")

    value = function(alone) if alone in STAGES else choose
    value.__name__ = value.__qualname__ = name
    lines = [
        value.__doc__ or "The functions of this name.",
        *(["", "    Functions", "    ---------"] if members else []),
    ]
    for one, made in members.items():
        lines.append(f"    calib.{name}.{one} : {(made.__doc__ or '').splitlines()[0]}")
        setattr(value, one, made)
    value.__doc__ = "\n".join(lines)
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
