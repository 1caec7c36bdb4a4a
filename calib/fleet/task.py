"""The work on one rig, as it goes to a process: a function of the rig and the options alone.

Nothing is kept between rigs and nothing is written but scratch, so that a rig that is tried again,
elsewhere or later, gives the same bytes.
"""

from __future__ import annotations

import contextlib
import json
import platform
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from calib.errors import EXIT_INTERNAL, CalibError
from calib.files import sha256
from calib.fleet.fetch import MOST_BYTES, local_folder
from calib.fleet.manifest import RigSpec, without_secrets
from calib.fleet.outcome import SAME, Outcome, verdict_of
from calib.fleet.stages import kind_of, rig_folder, run_stages
from calib.running.cache import key_of, program_digest
from calib.running.folder import folder_digests

__all__ = ["Answer", "FleetOptions", "calibrate_rig", "peak_memory_MB", "program"]

_MOST_KEPT_BYTES = 30_000_000


@dataclass(frozen=True)
class FleetOptions:
    """What holds for all rigs.

    Attributes
    ----------
    pages : whether each rig's page is made and brought back.
    attempts : to fetch a file. most_bytes : of a folder that is fetched.
    """

    pages: bool = False
    attempts: int = 3
    most_bytes: int = MOST_BYTES


@dataclass(frozen=True)
class Answer:
    """An outcome with the results that belong to it."""

    outcome: Outcome
    files: dict[str, bytes]


@cache
def program() -> str:
    """What results follow from beside their inputs: this program and the libraries under it."""
    import cv2
    import numpy
    import scipy

    versions = (platform.python_version(), numpy.__version__, scipy.__version__, cv2.__version__)
    return sha256(json.dumps([program_digest(), *versions]).encode())


def calibrate_rig(spec: RigSpec, options: FleetOptions, known: str = "", scratch: str = "") -> Answer:
    """Calibrate one rig; every failure is an outcome, none an exception. One at a time in a process.

    Parameters
    ----------
    known : key of an earlier result; where it still is the key, the rig is not calibrated again.
    scratch : folder for what is fetched and made, removed afterwards; the system's own without.
    """
    blank = Outcome(spec.name, spec.serial, without_secrets(spec.source), "failed", EXIT_INTERNAL)
    with _measured() as spent:
        try:
            with tempfile.TemporaryDirectory(prefix="rig-", dir=scratch or None) as place:
                answer = _calibrated(spec, options, known, Path(place), blank)
        except CalibError as error:
            answer = _failed(blank, error.exit_code, str(error))
        except Exception as error:
            words = " ".join(str(error).split())[:200]
            answer = _failed(blank, EXIT_INTERNAL, f"internal error: {type(error).__name__}: {words}")
    seconds, peak = spent
    return Answer(replace(answer.outcome, seconds=round(seconds, 3), peak_MB=peak), answer.files)


def _failed(blank: Outcome, code: int, sentence: str) -> Answer:
    return Answer(replace(blank, status=verdict_of(code), code=code, sentence=sentence), {})


def _calibrated(spec: RigSpec, options: FleetOptions, known: str, place: Path, blank: Outcome) -> Answer:
    root = local_folder(spec.source, place / "fetched", options.attempts, options.most_bytes)
    folder = rig_folder(root)
    kind = kind_of(folder)
    inputs = {folder.name_of(path): digest for path, digest in folder_digests(folder).items()}
    chosen = [word for pair in spec.options for word in pair]
    command = ("fleet", kind, str(options.pages), program(), *chosen)
    key = key_of(command, inputs, "")
    if known == key:
        return Answer(replace(blank, status=SAME, code=0, key=key), {})
    import cv2

    from calib.workers import at_most

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with at_most(1):
            ended = run_stages(folder, kind, spec.options, place / "out", options.pages)
    finally:
        cv2.setNumThreads(threads)
    files = _kept(ended.out, ended.files, options.pages)
    outcome = replace(
        blank,
        status=verdict_of(ended.code),
        code=ended.code,
        sentence=ended.reasons[0] if ended.reasons else "",
        key=key,
        kind=kind,
        reasons=ended.reasons,
        stages=ended.stages,
        values=_values(ended.out / "rig.yaml"),
        files={name: sha256(data) for name, data in files.items()},
    )
    return Answer(outcome, files)


def _kept(out: Path, names: tuple[str, ...], pages: bool) -> dict[str, bytes]:
    """Results that come back: constants, firmware and, where asked for, the page; states stay away."""
    files, total = {}, 0
    for name in sorted(names):
        if name == "rig.yaml" or name.startswith("firmware/") or (pages and name == "report.html"):
            data = (out / name).read_bytes()
            total += len(data)
            if total <= _MOST_KEPT_BYTES:
                files[name] = data
    return files


def _values(rig: Path) -> dict[str, tuple[float, float | None]]:
    from calib.rigvalues import constants
    from calib.running.sections import sections_of

    return {f"{one.section}.{one.name}": (one.value, one.sigma) for one in constants(sections_of(rig).values)}


@contextlib.contextmanager
def _measured() -> Iterator[list[float]]:
    """Seconds and largest memory in megabytes of what is done inside, in a list that is filled at the end."""
    with contextlib.suppress(OSError):
        # 5 makes the kernel forget the largest memory so far (proc(5), clear_refs).
        Path("/proc/self/clear_refs").write_text("5")
    began, spent = time.perf_counter(), list[float]()
    try:
        yield spent
    finally:
        spent += [time.perf_counter() - began, peak_memory_MB()]


def peak_memory_MB() -> float:
    """Largest resident memory of this process in megabytes, since it was last forgotten."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return round(1.024e-3 * int(line.split()[1]), 1)
    with contextlib.suppress(ImportError):
        import resource

        return round(1.024e-3 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, 1)
    return float("nan")
