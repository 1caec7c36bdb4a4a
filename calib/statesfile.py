"""The states file that `calib replay` writes, block by block."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.files import check_writable, shown

__all__ = ["STATES", "StatesFile", "states_writer"]

STATES = (
    "t_s", "q1_m", "q2_m", "dq1_mps", "dq2_mps", "phi_rad", "length_m", "x_m", "y_m", "gyro_bias_radps",
    "sigma_q1_m", "sigma_q2_m", "sigma_phi_rad", "nis_camera", "nis_accel", "nis_gyro",
    "gated_camera", "gated_accel", "gated_gyro", "flags", "rest_weight", "swing_weight",
    "driven_weight",
)  # fmt: skip
"""Columns of the states file."""


def _text(values: FloatArray, names: tuple[str, ...]) -> str:
    whole = [name.startswith("gated") or name == "flags" for name in names]
    lines = []
    for row in values.tolist():
        cells = [f"{row[0]:.6f}"]
        for value, flag in zip(row[1:], whole[1:], strict=True):
            cells.append("" if value != value else f"{value:.0f}" if flag else f"{value:.9g}")
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n" if lines else ""


class StatesFile:
    """A states file that is being written."""

    def __init__(self, stream: IO[str], names: tuple[str, ...]) -> None:
        self._stream, self._names = stream, names
        stream.write(",".join(names) + "\n")

    def add(self, values: FloatArray) -> None:
        """Rows (n, len(names)); NaN becomes a blank cell."""
        self._stream.write(_text(values, self._names))


@contextmanager
def states_writer(path: Path, names: tuple[str, ...] = STATES) -> Iterator[StatesFile]:
    """Write a states file block by block; it appears under its name when it is whole.

    Raises `BadInputError` where the place cannot be written.
    """
    check_writable(path)
    target = Path(os.path.realpath(path))
    temporary: Path | None = None
    try:
        if target.exists() and not target.is_file():
            with target.open("w", encoding="utf-8") as stream:
                yield StatesFile(stream, names)
            return
        descriptor, name = tempfile.mkstemp(prefix=f".{target.name[:40]}.", suffix=".tmp", dir=target.parent)
        temporary = Path(name)
        with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
            yield StatesFile(stream, names)
            stream.flush()
            os.fsync(stream.fileno())
        mode = target.stat().st_mode & 0o777 if target.exists() else 0o666 & ~_umask()
        temporary.chmod(mode)
        temporary.replace(target)
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be written: {error.strerror or error}") from error
    finally:
        if temporary is not None:
            with contextlib.suppress(FileNotFoundError):
                temporary.unlink()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
