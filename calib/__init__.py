"""Calibrate a cheap camera and an IMU on a machine, down to the constants in its firmware.

    import calib
    rig = calib.Rig.load("rig.yaml", missing_ok=True)
    rig.camera = calib.intrinsics("images/")
    rig.plane = calib.extrinsics("images/plane/", rig)
    rig.save("rig.yaml")

Each verb of the command line is a function here: it takes paths (or a pattern), the rig, and the verb's
options in SI units, and returns the section of rig.yaml with its verdict. Names are loaded when they are
first used.
"""

from __future__ import annotations

import importlib
from types import SimpleNamespace
from typing import Any

__version__ = "0.1.0"

_CLASSES = {
    "Rig": "calib.core.rig",
    "Verdict": "calib.core.verdict",
    "Finding": "calib.core.verdict",
    "plots": "calib.show.draw",
}
"""Names of the front door that are no verbs, and where they are."""

_BY_DEFAULT = {"identify": "identify logs"}
"""Verb of two words that its first word alone stands for."""

__all__ = [
    "Finding",
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
]


def __getattr__(name: str) -> Any:
    if name in _CLASSES:
        value: Any = getattr(importlib.import_module(_CLASSES[name]), name)
    elif name in __all__:
        from calib.stages import STAGES, function

        # Verbs of two words: `calib.imu.static` is `calib imu static`.
        group = {one.split()[-1]: function(one) for one in STAGES if one.startswith(f"{name} ")}
        alone = _BY_DEFAULT.get(name, name)
        value = function(alone) if alone in STAGES else SimpleNamespace(**group)
    else:
        raise AttributeError(f"module 'calib' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
