"""The output folder of a fleet: what is kept of each rig, and which of it still holds.

    rigs/NAME/               results of a rig, as a single run leaves them
    .fleet/outcomes/NAME.json    how it ended; written last, so that what it tells of is there
    .fleet/lock              one fleet at a time
    .fleet/scratch/          of a local cluster, gone at the end

All is written by one process, the one that was started by a person: workers need not see this folder.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from calib.errors import BadInputError
from calib.files import check_folder, check_writable, make_folder, sha256, shown, write_atomically
from calib.fleet.manifest import RigSpec, is_url
from calib.fleet.outcome import Outcome, from_json, to_json
from calib.fleet.task import Answer
from calib.running.folder import digest_of
from calib.running.lock import held

__all__ = ["HIDDEN", "Store", "check_apart", "opened_store"]

HIDDEN = ".fleet"
_MOST_BYTES = 5_000_000


class Store:
    """An output folder that is ours while it is open."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.scratch = out / HIDDEN / "scratch"

    def _file(self, name: str) -> Path:
        return self.out / HIDDEN / "outcomes" / f"{name}.json"

    def outcome(self, name: str) -> Outcome | None:
        """How a rig has ended, None where that is not known."""
        path = self._file(name)
        with contextlib.suppress(OSError, ValueError):
            if path.stat().st_size <= _MOST_BYTES:
                found = from_json(path.read_text(encoding="utf-8"))
                return found if found is not None and found.name == name else None
        return None

    def known(self, name: str) -> str:
        """Key of a rig's result, "" where there is none or its files are not what they were."""
        found = self.outcome(name)
        if found is None or not found.key:
            return ""
        for file, digest in found.files.items():
            path = self.out / "rigs" / name / file
            try:
                if path.is_symlink() or digest_of(path) != digest:
                    return ""
            except BadInputError:
                return ""
        return found.key

    def keep(self, answer: Answer) -> None:
        """Write a rig's results, then its outcome."""
        outcome = answer.outcome
        place = self.out / "rigs" / outcome.name
        if place.is_symlink():
            raise BadInputError(f"{shown(place)}: is a symbolic link, expected a place in the output folder")
        with contextlib.suppress(OSError):
            # What is about to be replaced must not count as a result any more.
            self._file(outcome.name).unlink()
        shutil.rmtree(place, ignore_errors=True)
        for name, data in answer.files.items():
            parts = PurePosixPath(name).parts
            if len(parts) > 2 or ".." in parts or name.startswith("/") or sha256(data) != outcome.files[name]:
                raise BadInputError(f"{outcome.name}: a worker has sent {name[:80]!r}, which is no result")
            make_folder((place / name).parent)
            write_atomically(place / name, data)
        write_atomically(self._file(outcome.name), to_json(outcome))

    def result(self, name: str, file: str) -> Path:
        """Path of one of a rig's results."""
        return self.out / "rigs" / name / file


def check_apart(out: Path, rigs: Iterable[RigSpec]) -> None:
    """Raise `BadInputError` where results would be written into a rig's folder, or over one."""
    place = Path(os.path.realpath(out))
    for rig in rigs:
        if is_url(rig.source):
            continue
        source = Path(os.path.realpath(rig.source))
        if place.is_relative_to(source):
            raise BadInputError(f"{shown(out)}: lies in the folder of {rig.name}, expected another one")
        if source.is_relative_to(place / "rigs") or source.is_relative_to(place / HIDDEN):
            raise BadInputError(
                f"{shown(rig.source)}: the folder of {rig.name} is where results are written, expected "
                "another output folder"
            )


@contextmanager
def opened_store(out: Path, verb: str, outputs: tuple[str, ...]) -> Iterator[tuple[Store, bool]]:
    """Make and lock an output folder; yields it, and whether the last run there was interrupted.

    Parameters
    ----------
    outputs : names of the files that will be written in it at the end.

    Raises `BadInputError` when it cannot be written or another process is at work there.
    """
    check_folder(out)
    hidden = out / HIDDEN
    for path in (hidden, out / "rigs", hidden / "outcomes", hidden / "scratch"):
        if path.is_symlink():
            raise BadInputError(f"{shown(path)}: is a symbolic link, expected a place in the output folder")
    if (out / "rigs").exists() and not hidden.exists():
        raise BadInputError(
            f"{shown(out / 'rigs')}: is there, and is not the work of {verb}; expected another output folder"
        )
    make_folder(hidden / "outcomes")
    for name in outputs:
        check_writable(out / name)
    with held(hidden / "lock", out, verb) as interrupted:
        told = hidden / "verb.json"
        before = _verb(told)
        if before not in ("", verb):
            raise BadInputError(f"{shown(out)}: holds the results of {before}, expected another folder")
        write_atomically(told, json.dumps({"verb": verb}) + "\n")
        for folder in (out, hidden / "outcomes", hidden):
            for left in folder.glob(".*.tmp"):
                with contextlib.suppress(OSError):
                    left.unlink()
        yield Store(out), interrupted is not None
        shutil.rmtree(hidden / "scratch", ignore_errors=True)


def _verb(path: Path) -> str:
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        return str(json.loads(path.read_text(encoding="utf-8"))["verb"])
    return ""
