"""A fleet: its manifest, the files and the run of each rig, rows of all, spread and drift, who stands out."""

from __future__ import annotations

import contextlib
import heapq
import ipaddress
import math
import os
import re
import socket
import tempfile
import time
import urllib.parse
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, ConfigDict

from calib.core.arrays import FloatArray
from calib.core.constants import constants
from calib.core.errors import EXIT_DONE, EXIT_INTERNAL, EXIT_POOR, BadInputError, CalibError, end_of
from calib.core.files import PICTURES, VIDEOS, one_line, read_yaml_mapping, sha256, shown
from calib.core.options import name_of_flag, options_of
from calib.core.plot import every
from calib.core.result import Section
from calib.core.rig import Rig
from calib.core.schema import validated
from calib.core.units import unit_of
from calib.core.words import as_words, several
from calib.core.workers import Processes, Task, at_most
from calib.core.writing import make_folder
from calib.io.tables import read_cells
from calib.runner.cache import key_of, program
from calib.runner.folder import LOGS, Folder, folder_digests, read_folder
from calib.runner.graph import STEPS, Job, Runner, opened_run
from calib.runner.outcomes import (
    LIMIT_S,
    SAME,
    Answer,
    Outcome,
    Progress,
    Store,
    arrow_table,
    column,
    run_all,
    texts,
    typed,
    write_table,
    write_timings,
)
from calib.runner.outputs import Calibrated, run_folder
from calib.runner.processes import Here, needed
from calib.stages import stage

# ----------------------------------------------------------------------
# The manifest of a fleet: one row per rig, as CSV or YAML.
#
#     name     what its results are called                path    its folder, or the URL of one
#     serial   optional: its place in the order of making
#     corners, square, model, loss, board                 optional: as the options of `calib intrinsics`
#
# A CSV has these as its header. A YAML file has a list `rigs` of such mappings, and perhaps `options` that
# hold for all. Relative paths start at the manifest's folder.

_SIGNS = frozenset(" -_.+#=@()")
_LONGEST = 80
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")


def _named(name: str) -> str:
    signs = "".join(sorted(_SIGNS)).strip()
    if not name or len(name.encode()) > _LONGEST:
        raise ValueError(f"expected a name of 1 to {_LONGEST} bytes for the rig's results")
    if name[0] in ".- " or name[-1] in ". ":
        raise ValueError("expected a name without a dot or dash in front, and without a dot at the end")
    if not all(c.isalnum() or c in _SIGNS for c in name):
        raise ValueError(f"expected a name of letters, digits and {signs}")
    return name


def _found(source: str) -> str:
    if not source or not source.isprintable():
        raise ValueError("expected the rig's folder, or the URL of one")
    if "::" in source and "://" in source:
        raise ValueError("expected a plain URL, not several in a chain")
    return source


def _numbered(serial: str) -> str:
    if len(serial) > _LONGEST or not serial.isprintable():
        raise ValueError("expected a short text")
    return serial


class _Options(Section):
    """What may differ from rig to rig."""

    model_config = ConfigDict(coerce_numbers_to_str=True, str_strip_whitespace=True)

    corners: str = ""
    square: str = ""
    model: str = ""
    loss: str = ""
    board: str = ""


class _Row(_Options):
    model_config = ConfigDict(extra="ignore")

    name: Annotated[str, AfterValidator(_named)]
    path: Annotated[str, AfterValidator(_found)]
    serial: Annotated[str, AfterValidator(_numbered)] = ""


class _Listed(Section):
    rigs: list[dict[str, Any]]
    options: _Options = _Options()


OPTIONS = tuple(_Options.model_fields)


@dataclass(frozen=True)
class RigSpec:
    """A rig of the manifest.

    Attributes
    ----------
    name : safe as the name of a folder.
    source : absolute path of its folder, or a URL.
    serial : as written, "" without.
    options : of its camera, by name.
    written : its folder or URL as the manifest has it, without secrets: the same wherever the fleet lies.
    """

    name: str
    source: str
    serial: str = ""
    options: tuple[tuple[str, str], ...] = ()
    written: str = ""


@dataclass(frozen=True)
class Manifest:
    """All rigs in their order, and the columns that mean nothing here."""

    rigs: tuple[RigSpec, ...]
    ignored: tuple[str, ...]


def is_url(source: str) -> bool:
    """Whether a source is a URL and not a path."""
    return _SCHEME.match(source) is not None


def without_secrets(source: str) -> str:
    """A source as it may be shown and kept: a URL without user, password and query, a path as it is."""
    if not is_url(source):
        return source
    scheme, _, rest = source.partition("://")
    host, slash, path = rest.partition("?")[0].partition("/")
    return one_line(f"{scheme}://{host.rpartition('@')[2]}{slash}{path}")


def serial_number(serial: str) -> float | None:
    """The number in a serial: all of it, or the digits at its end, as 17 of AX-0017. None without."""
    found = re.search(r"(\d{1,15})\D{0,2}$", serial)
    return float(found.group(1)) if found else None


def read_manifest(path: Path) -> Manifest:
    """The rigs of a manifest.

    Raises `BadInputError`, with line or entry, for a manifest without rigs, names that are no names, the
    same name twice, and options that `calib intrinsics` would refuse.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        rows, ignored = _from_yaml(path)
    else:
        rows, ignored = _from_csv(path)
    root, rigs, seen = path.absolute().parent, list[RigSpec](), dict[str, str]()
    for where, row in rows:
        rig = _rig(f"{shown(path)}, {where}", row, root)
        # Folders that differ in capitals only are one folder on some systems.
        before = seen.setdefault(rig.name.casefold(), where)
        if before != where:
            raise BadInputError(f"{shown(path)}, {where}: the name {rig.name!r} is that of {before}")
        rigs.append(rig)
    if not rigs:
        raise BadInputError(f"{shown(path)}: names no rigs, expected at least one row with name and path")
    return Manifest(tuple(rigs), ignored)


def twice_told(rigs: Iterable[RigSpec]) -> tuple[str, ...]:
    """Sentences on what several rigs have in common though it should be a rig's own."""
    said = []
    for what, key in (("folder", "source"), ("serial number", "serial")):
        seen, again = set[str](), list[str]()
        for rig in rigs:
            value = getattr(rig, key)
            if value and value in seen:
                again.append(rig.name)
            seen.add(value)
        if again:
            verb = "rig has" if len(again) == 1 else "rigs have"
            said.append(f"{len(again)} {verb} the {what} of one before, the first is {again[0]}")
    return tuple(said)


def _from_csv(path: Path) -> tuple[Iterator[tuple[str, Mapping[str, Any]]], tuple[str, ...]]:
    cells = read_cells(path, comments=False)
    head = [name.strip().lower() for name in cells.header]
    for name in ("name", "path"):
        if name not in head:
            found = one_line(", ".join(head))[:80]
            raise BadInputError(f"{shown(path)}: has no column {name}, found {found}")
    twice = next((name for name in head if name and head.count(name) > 1), None)
    if twice is not None:
        raise BadInputError(f"{shown(path)}: has the column {one_line(twice)!r} twice")
    rows = zip(cells.lines, cells.rows, strict=True)
    named = ((f"line {line}", dict(zip(head, row, strict=True))) for line, row in rows)
    return named, tuple(one_line(name) for name in head if name and name not in _Row.model_fields)


def _from_yaml(path: Path) -> tuple[Iterator[tuple[str, Mapping[str, Any]]], tuple[str, ...]]:
    whole = validated(_Listed, read_yaml_mapping(path), path)
    common = whole.options.model_dump(exclude_unset=True)
    rows = ((f"rig {number}", {**common, **entry}) for number, entry in enumerate(whole.rigs, start=1))
    strange = (key for entry in whole.rigs for key in entry if key not in _Row.model_fields)
    return rows, tuple(dict.fromkeys(map(one_line, strange)))


def _rig(where: str, row: Mapping[str, Any], root: Path) -> RigSpec:
    told = validated(_Row, {key: value for key, value in row.items() if value is not None}, where)
    options = tuple((key, value) for key in OPTIONS if (value := getattr(told, key)))
    try:
        options_of(stage("intrinsics").options, camera_options(options))
    except CalibError as error:
        raise BadInputError(f"{where}: {told.name}: {error}") from error
    source = told.path if is_url(told.path) else str(root / told.path)
    return RigSpec(told.name, source, told.serial, options, without_secrets(told.path))


def camera_options(options: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Options by the names that `intrinsics` has for them."""
    return {name_of_flag(stage("intrinsics").options, flag): value for flag, value in options}


# ----------------------------------------------------------------------
# A rig folder as this process can read it: where it lies, or fetched from a URL into a folder of scratch.
#
# What a server calls its files is not trusted: a name that leads out of the folder is refused, only files
# that a rig folder can hold are fetched, and their number and size are limited. A fault on the way is
# tried again; a file that is not there is not.
#
# A manifest may come from elsewhere. So a URL is of a scheme that is known to fetch and to do nothing
# else, or of one that a person allows; and a server of a private network, which this machine reaches and
# the manifest's author perhaps does not, is asked only where a person says so. Redirections are not
# followed.

SCHEMES = ("file", "gs", "https", "s3")
"""What may be fetched unasked."""
ATTEMPTS = 3
MOST_BYTES = 4_000_000_000
_MOST_FILES = 20_000
_PIECE = 1 << 20
_SUFFIXES = (*PICTURES, *VIDEOS, *LOGS, ".yaml")
_FOLDERS = ("", "images", "images/plane", "logs")
_FINAL = (FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError, NotImplementedError)
"""Another attempt would end in the same; the last is fsspec's for what a kind of URL cannot do."""


@dataclass(frozen=True)
class Allowed:
    """Schemes of URLs that are fetched, and whether servers of private networks are asked."""

    schemes: tuple[str, ...] = SCHEMES
    private: bool = False


def check_url(url: str, allowed: Allowed) -> None:
    """Raise `BadInputError` for a URL that is not to be fetched."""
    told = without_secrets(url)
    # fsspec lets one system stand on another: zip://a::https://b.
    schemes = [part.partition("://")[0].lower() for part in url.split("::")]
    for scheme in schemes:
        if scheme not in allowed.schemes:
            known = one_line(scheme)[:40]
            raise BadInputError(
                f"{told}: is of the scheme {known}, expected {', '.join(allowed.schemes)}; allow it with "
                f"--allow-scheme {known}"
            )
    if allowed.private or not {"http", "https"} & set(schemes):
        return
    try:
        found = socket.getaddrinfo(urllib.parse.urlsplit(url).hostname, None)
    except (OSError, ValueError) as error:
        raise BadInputError(f"{told}: its server is not known: {_words(error)}") from error
    if not all(ipaddress.ip_address(one[4][0]).is_global for one in found):
        raise BadInputError(f"{told}: its server is in a private network; allow that with --allow-private")


def local_folder(source: str, scratch: Path, allowed: Allowed = Allowed()) -> Path:
    """The rig's folder: the path itself, or `scratch` with what was fetched.

    Raises `BadInputError` for a URL that cannot be had, or is not to be fetched.
    """
    if not is_url(source):
        return Path(source)
    check_url(source, allowed)
    told = without_secrets(source)
    try:
        # Where a server sends one on to was not looked at.
        words = {"allow_redirects": False} if source.lower().startswith("http") else {}
        system, place = needed("fsspec.core").url_to_fs(source, **words)
    except ImportError as error:
        raise BadInputError(f"{told}: needs a package that is not here: {_words(error)}") from error
    except (ValueError, OSError) as error:
        raise BadInputError(f"{told}: is no URL that can be read: {_words(error)}") from error
    listed = _again(partial(_listed, system, str(place), told), told)
    if not listed:
        raise BadInputError(f"{told}: holds no pictures and no logs")
    total = 0
    for name, remote in listed.items():
        target = scratch / name
        make_folder(target.parent)
        total += _again(partial(_copied, system, remote, target, MOST_BYTES - total, told), told)
    return scratch


def _again(work: Callable[[], Any], told: str) -> Any:
    """What `work` returns; a fault that may pass is given time to."""
    for attempt in range(ATTEMPTS):
        try:
            return work()
        except BadInputError:
            raise
        except _FINAL as error:
            raise BadInputError(f"{told}: cannot be read: {_words(error)}") from error
        except Exception as error:  # each file system has errors of its own
            if attempt + 1 >= ATTEMPTS:
                raise BadInputError(
                    f"{told}: could not be fetched in {attempt + 1} attempts: {_words(error)}"
                ) from error
            time.sleep(min(0.2 * 4.0**attempt, 10.0))
    raise AssertionError


_SECRETS = (re.compile(r"(?<=://)[^/@\s]+@"), re.compile(r"(?<=://)([^\s?'\"]*)\?[^\s'\"),]*"))
"""User and password, and the query, of a URL in a text."""


def _words(error: BaseException) -> str:
    text = _SECRETS[1].sub(r"\1", _SECRETS[0].sub("", " ".join(str(error).split())))
    return one_line(text)[:200] or type(error).__name__


def _listed(system: Any, root: str, told: str) -> dict[str, str]:
    """Files to fetch by their names relative to the folder."""
    out: dict[str, str] = {}
    base = root.rstrip("/")
    for folder in _FOLDERS:
        place = f"{base}/{folder}".rstrip("/")
        try:
            entries = system.ls(place, detail=True)
        except (FileNotFoundError, NotADirectoryError):
            if not folder:
                raise
            continue
        for entry in entries:
            remote = str(entry["name"])
            # Of a listing only the last part of a name counts; a server's idea of a path does not.
            name = PurePosixPath(remote.rstrip("/").replace("\\", "/")).name
            if entry.get("type") == "directory" or not name.lower().endswith(_SUFFIXES):
                continue
            if name in ("", ".", "..") or name.startswith((".", "-")) or not name.isprintable():
                raise BadInputError(f"{told}: has a file with the name {one_line(remote)[:80]}")
            out[f"{folder}/{name}" if folder else name] = remote
            if len(out) > _MOST_FILES:
                raise BadInputError(f"{told}: has more than {_MOST_FILES} files")
    return dict(sorted(out.items()))


def _copied(system: Any, remote: str, target: Path, most: int, told: str) -> int:
    """Copy one file and return its size; what a listing says of sizes is not relied on."""
    size = 0
    with system.open(remote, "rb") as source, target.open("wb") as sink:
        while piece := source.read(_PIECE):
            size += len(piece)
            if size > most:
                raise BadInputError(f"{told}: is larger than {1e-9 * MOST_BYTES:g} GB")
            sink.write(piece)
    return size


# ----------------------------------------------------------------------
# One rig in this process: the stages of `calib run`, or those of a camera, one verb after the other.
#
# The verbs are those that a person types, with the same words, so that the results are the same bytes.
# Figures are drawn only for a page; they change no number.

CAMERA_STAGES = ("intrinsics", "extrinsics", "distortion")


def kind_of(folder: Folder) -> str:
    """ "camera" for a folder that holds only pictures, "run" for one with logs."""
    return "run" if folder.logs else "camera"


def run_stages(
    folder: Folder, kind: str, options: Sequence[tuple[str, str]], out: Path, page: bool = False
) -> Calibrated:
    """Run a folder's stages into a new output folder. Raises `BadInputError` as `calib run` does."""
    given = camera_options(options)
    steps = [step for step in STEPS if kind == "run" or step.name in CAMERA_STAGES]
    steps = [replace(step, options=given) if step.name == "intrinsics" else step for step in steps]
    steps = [replace(step, figures=step.figures and page) for step in steps]
    with opened_run(out, folder.root):
        return run_folder(Runner(folder, out, Here(), steps=tuple(steps), fresh=True), page=page)


def _code(done: Calibrated, kind: str) -> int:
    """As `calib run` ends; of a camera firmware apart: 3 when a stage has failed, 1 when one is poor."""
    statuses = {job.status for job in done.ended}
    if kind == "run" or done.decision.failed:
        return done.decision.exit_code
    return EXIT_DONE if "ok" in statuses <= {"ok", "skipped"} else EXIT_POOR


# ----------------------------------------------------------------------
# The work on one rig, as it goes to a process: a function of the rig and the options alone.
#
# Nothing is kept between rigs and nothing is written but scratch, so that a rig that is tried again,
# elsewhere or later, gives the same bytes.

_FETCHED = "fetched"
_MOST_KEPT_BYTES = 30_000_000
_STATUS = {EXIT_DONE: "ok", EXIT_POOR: "poor", EXIT_INTERNAL: "broken"}


@dataclass(frozen=True)
class FleetOptions:
    """What holds for all rigs.

    Attributes
    ----------
    pages : whether each rig's page is made and brought back.
    allowed : what may be fetched.
    """

    pages: bool = False
    allowed: Allowed = Allowed()


def calibrate_rig(spec: RigSpec, options: FleetOptions, known: str = "") -> Answer:
    """Calibrate one rig; every failure is an outcome, none an exception. One at a time in a process.

    Parameters
    ----------
    known : key of an earlier result; where it still is the key, the rig is not calibrated again.
    """
    with contextlib.suppress(OSError):
        # 5 makes the kernel forget the largest memory so far (proc(5), clear_refs).
        Path("/proc/self/clear_refs").write_text("5")
    began, place = time.perf_counter(), ""
    try:
        with tempfile.TemporaryDirectory(prefix="rig-") as place:
            answer = _calibrated(spec, options, known, Path(place))
    except Exception as error:
        code, sentence = end_of(error)
        for folder in (f"{place}/{_FETCHED}", spec.source):
            sentence = sentence.replace(shown(folder), spec.written)
        answer = Answer(
            Outcome(name=spec.name, status=_STATUS.get(code, "failed"), code=code, sentence=sentence)
        )
    spent = {"seconds": round(time.perf_counter() - began, 3), "peak_MB": peak_memory_MB()}
    return replace(answer, outcome=answer.outcome.model_copy(update=spent))


def reasons_of(ended: Sequence[Job]) -> tuple[str, ...]:
    """Why stages are not ok, first of those that have failed: the rig has no result for these."""
    weak = [job for job in ended if job.status not in ("ok", "skipped")]
    weak.sort(key=lambda job: job.status != "failed")
    return tuple(f"{job.step.title}: {job.reason}" for job in weak)


def _calibrated(spec: RigSpec, options: FleetOptions, known: str, place: Path) -> Answer:
    root = local_folder(spec.source, place / _FETCHED, allowed=options.allowed)
    folder = read_folder(root)
    kind = kind_of(folder)
    inputs = {folder.name_of(path): digest for path, digest in folder_digests(folder).items()}
    chosen = [word for pair in spec.options for word in pair]
    command = ("fleet", kind, str(options.pages), program(), *chosen)
    key = key_of(command, inputs, "")
    if known == key:
        return Answer(Outcome(name=spec.name, status=SAME, key=key))
    with at_most(1):
        done = run_stages(folder, kind, spec.options, place / "out", options.pages)
    files, code = _kept(done.out, done.files, options.pages), _code(done, kind)
    reasons = reasons_of(done.ended)
    decision = done.decision
    if kind == "run" and decision.lacking and not decision.failed:
        reasons = (decision.lacking, *reasons)
    rig = Rig.load(done.out / "rig.yaml")
    outcome = Outcome(
        name=spec.name,
        status=_STATUS.get(code, "failed"),
        code=code,
        sentence=reasons[0] if reasons else "",
        key=key,
        kind=kind,
        reasons=reasons,
        left_out=folder.left_out,
        stages={job.name: job.status for job in done.ended},
        simulated=rig.simulated,
        values=values_of(rig),
        files={name: sha256(data) for name, data in files.items()},
    )
    return Answer(outcome, files)


def values_of(rig: Rig) -> dict[str, tuple[float, float | None]]:
    """A rig's constants with their deviations, but for sections that their data do not determine."""
    told = {name: one for name, one in rig.values().items() if one.get("verdict") != "unidentifiable"}
    return {f"{one.section}.{one.name}": (one.value, one.sigma) for one in constants(told)}


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


def peak_memory_MB() -> float | None:
    """Largest resident memory of this process in megabytes since it was last forgotten; Linux alone tells."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return round(1.024e-3 * int(line.split()[1]), 1)
    return None


# ----------------------------------------------------------------------
# A fleet from its manifest to its outcomes: what still holds is left alone, all else is done.


def run_fleet(
    store: Store,
    processes: Processes,
    manifest: Manifest,
    options: FleetOptions,
    progress: Progress = lambda done, total: None,
    tell: Callable[[str], None] = lambda _: None,
    limit_s: float = LIMIT_S,
) -> Counter[str]:
    """Run all rigs whose results are not there, each in `limit_s` seconds at most. Raises as `run_all`."""
    named = {spec.name for spec in manifest.rigs}
    if others := {path.name for path in (store.out / "rigs").glob("*") if path.is_dir()} - named:
        left = several(sorted(map(one_line, others)))
        tell(f"rigs/: holds results of an earlier run of what the manifest does not name: {left}")
    tasks = (
        Task(spec.name, calibrate_rig, (spec, options, store.known(spec.name)), limit_s)
        for spec in manifest.rigs
    )
    return run_all(store, processes, tasks, len(manifest.rigs), "rig", progress, tell)


def check_apart(out: Path, rigs: Iterable[RigSpec]) -> None:
    """Raise `BadInputError` where results would be written into a rig's folder, or over one."""
    place = Path(os.path.realpath(out))
    for rig in rigs:
        if is_url(rig.source):
            continue
        source = Path(os.path.realpath(rig.source))
        if place.is_relative_to(source):
            raise BadInputError(f"{shown(out)}: lies in the folder of {rig.name}, expected another one")
        if source.is_relative_to(place / "rigs") or source.is_relative_to(place / ".fleet"):
            raise BadInputError(
                f"{shown(rig.source)}: the folder of {rig.name} is where results are written, expected "
                "another output folder"
            )


def finish(store: Store, manifest: Manifest) -> FleetSummary:
    """Write fleet.parquet and the timings, and return the summary.

    Raises `BadInputError` when a file cannot be written.
    """
    import pyarrow as pa

    times: list[tuple[str, float, float | None]] = []

    def kept() -> Iterator[tuple[RigSpec, Outcome]]:
        for rig in manifest.rigs:
            if (found := store.outcome(rig.name)) is not None:
                times.append((found.name, found.seconds, found.peak_MB))
                yield rig, found

    table = table_of(kept())
    write_timings(store.out, "name,seconds,peak_MB", times)
    summary, worst, which = summarise(table)
    known = np.isfinite(worst)
    table = table.append_column("outlier_z", pa.array(worst, mask=~known))
    table = table.append_column("outlier_of", pa.array(which, type=pa.string()))
    table = table.append_column("stands_out", pa.array(known & (worst > summary.limit)))
    write_table(store.out / "fleet.parquet", table)
    return summary


# Columns: name, serial, source, kind, simulated, verdict, code, sentence, reasons, left_out, `verdict.STAGE`
# for each stage, `SECTION.NAME` and `SECTION.NAME.sigma` for each constant, and at last outlier_z and
# outlier_of, the constant that stands out most against the fleet. A null stands where a rig has no number or
# its data do not determine it.

_FIRST = (
    "name", "serial", "source", "kind", "simulated", "verdict", "code", "sentence", "reasons", "left_out",
)  # fmt: skip
_MOST_COLUMNS = 8000


def table_of(rigs: Iterable[tuple[RigSpec, Outcome]]) -> Any:
    """Rigs with their outcomes as an Arrow table, a row for each."""
    whole = arrow_table((_row_of(rig, outcome) for rig, outcome in rigs), _FIRST)
    verdicts = [name for name in whole.column_names if name.startswith("verdict.")]
    constants = [name for name in whole.column_names if name not in (*_FIRST, *verdicts)]
    kinds = dict.fromkeys([*_FIRST, *verdicts], "string") | {"code": "int16", "simulated": "bool"}
    return typed(whole, [*_FIRST, *verdicts, *constants[:_MOST_COLUMNS]], kinds)


def _row_of(rig: RigSpec, outcome: Outcome) -> dict[str, Any]:
    row: dict[str, Any] = {
        "name": rig.name,
        "serial": rig.serial,
        "source": rig.written,
        "kind": outcome.kind,
        "simulated": outcome.simulated,
        "verdict": outcome.status,
        "code": outcome.code,
        "sentence": outcome.sentence,
        "reasons": "\n".join(outcome.reasons),
        "left_out": "\n".join(outcome.left_out),
    }
    row |= {f"verdict.{stage}": status for stage, status in outcome.stages.items()}
    for name, (value, sigma) in outcome.values.items():
        row[name], row[f"{name}.sigma"] = value, sigma
    return row


# ----------------------------------------------------------------------
# How one constant is spread over a fleet, and which rigs stand out.
#
# With m the median and s = 1.4826 MAD of the values x_i, the spread between rigs is tau^2 = max(s^2 -
# median(sigma_i^2), 0), since the standard deviations sigma_i of the calibrations have widened s, and
#
#     z_i = (x_i - m) / sqrt(tau^2 + sigma_i^2)
#
# is what a rig is judged by: a value that is poorly known does not stand out by that alone. When more than
# half of the values are equal, s is 0 and 1.2533 times the mean absolute deviation takes its place
# (Iglewicz and Hoaglin 1993, 3.4).
#
# Of a fleet without outliers some z is large by chance. The limit is such that in n rigs times k constants
# one is beyond it with a probability of 5 %. The MAD is known from n rigs about as well as a standard
# deviation from 0.37 n (its efficiency, Rousseeuw and Croux 1993), hence Student's t of so many degrees.

FEWEST = 8
"""Fewer rigs say nothing about what is usual."""

_TO_SIGMA = 1.482602218505602
_MEAN_TO_SIGMA = 1.2533141373155001
_EFFICIENCY = 0.37
_CHANCE = 0.05
_LEAST_LIMIT = 3.5
_NOISE = 1e-12


@dataclass(frozen=True)
class Spread:
    """Of one constant over the rigs.

    Attributes
    ----------
    count : rigs that have it. median, low, high : and the least and greatest value.
    scale : robust standard deviation of the values. between : of it what the calibrations do not explain.
    own : median of the rigs' own standard deviations, NaN where none is known.
    """

    count: int
    median: float
    low: float
    high: float
    scale: float
    between: float
    own: float


def spread_of(x: FloatArray, sigma: FloatArray) -> Spread:
    """Spread of values (n,) with standard deviations (n,), NaN where not known."""
    known = np.isfinite(x)
    x, sigma = x[known], sigma[known]
    if len(x) == 0:
        nan = float("nan")
        return Spread(0, nan, nan, nan, nan, nan, nan)
    m = float(np.median(x))
    off = np.abs(x - m)
    s = _TO_SIGMA * float(np.median(off))
    if s <= _NOISE * abs(m):
        s = _MEAN_TO_SIGMA * float(off.mean())
    if s <= _NOISE * abs(m):
        s = 0.0
    bars = sigma[np.isfinite(sigma)]
    own = float(np.median(bars)) if len(bars) else float("nan")
    between = float(np.sqrt(max(s**2 - (own**2 if len(bars) else 0.0), 0.0)))
    return Spread(len(x), m, float(x.min()), float(x.max()), s, between, own)


def robust_z(x: FloatArray, sigma: FloatArray, spread: Spread) -> FloatArray:
    """z (n,) of values, NaN where there is none, 0 where nothing differs."""
    own = np.where(np.isfinite(sigma), sigma, 0.0)
    # Without a spread between rigs their own standard deviations alone are no measure: they may be zero.
    scale = np.sqrt(spread.between**2 + own**2)
    scale = np.where(scale > 0.0, scale, spread.scale)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (x - spread.median) / scale
    return np.where(np.isfinite(x), np.nan_to_num(z, nan=0.0, posinf=0.0, neginf=0.0), np.nan)


def limit_of(rigs: int, constants: int) -> float:
    """|z| beyond which a rig stands out."""
    return max(_LEAST_LIMIT, _beyond(_EFFICIENCY * (rigs - 1), rigs * constants))


def _beyond(degrees: float, values: int) -> float:
    """The size of Student's t that one of so many values exceeds with the probability of `_CHANCE`."""
    from scipy.special import stdtrit

    return -float(stdtrit(max(degrees, 1.0), 0.5 * _CHANCE / max(values, 1)))


# ----------------------------------------------------------------------
# Whether a constant drifts over the serial numbers of a fleet: a robust straight line with its sigma.
#
# x_i = a + b t_i + noise, with Huber's estimate: residuals beyond 1.345 standard deviations count as such of
# that size, so that rigs that stand out do not turn the line. With the residuals r_i over their own scales
# c_i = sqrt(tau^2 + sigma_i^2), psi Huber's function and psi' its derivative, the covariance of (a, b) is
#
#     s^2 K^2 [n / (n - 2) mean(psi^2) / mean(psi')^2] (X' X)^-1,    K = 1 + 2 / n (1 - mean(psi')) /
# mean(psi')
#
# with X the rows (1, t_i) / c_i (Huber and Ronchetti 2009, eqs. 7.83 and 7.84).

_HUBER = 1.345
_STEPS = 200


@dataclass(frozen=True)
class Drift:
    """A line over the serial numbers.

    Attributes
    ----------
    slope, sigma : change of the constant per number. at_middle, middle : value there. count : rigs.
    """

    slope: float
    sigma: float
    at_middle: float
    middle: float
    count: int

    @property
    def z(self) -> float:
        """Slope over its standard deviation; 0 without one."""
        return self.slope / self.sigma if self.sigma > 0.0 else 0.0


def drift_of(serial: FloatArray, x: FloatArray, sigma: FloatArray, spread: Spread) -> Drift | None:
    """The line through values (n,) with standard deviations (n,) over numbers (n,), NaN where not known.

    None with too few rigs, or where serial numbers or values do not differ.
    """
    known = np.isfinite(serial) & np.isfinite(x)
    t, x, own = serial[known], x[known], np.nan_to_num(sigma[known])
    if len(x) < FEWEST or np.ptp(t) <= 0.0 or np.ptp(x) <= 0.0:
        return None
    middle = float(np.median(t))
    c = np.sqrt(spread.between**2 + own**2)
    usual = spread.scale if spread.scale > 0.0 else float(np.ptp(x))
    c = np.where(c > 1e-6 * usual, c, usual)
    # Numbers and values of order one: the sums keep their digits.
    reach = float(np.abs(t - middle).max())
    X = np.stack([np.ones_like(t), (t - middle) / reach], axis=1) / c[:, None]
    y = (x - spread.median) / c
    theta: FloatArray = np.zeros(2)
    s = _scale(y)
    for _ in range(_STEPS):
        r = y - X @ theta
        s = _scale(r)
        if s <= 0.0:
            break
        w = np.minimum(1.0, _HUBER * s / np.maximum(np.abs(r), 1e-300))
        new: FloatArray = np.asarray(
            np.linalg.lstsq(X * np.sqrt(w)[:, None], y * np.sqrt(w), rcond=None)[0], dtype=np.float64
        )
        moved = float(np.abs((new - theta) * X.mean(axis=0)).max() / s)
        theta = new
        if moved < 1e-9:
            break
    covariance = _covariance(X, y - X @ theta, s)
    if covariance is None:
        return None
    return Drift(
        float(theta[1]) / reach,
        math.sqrt(covariance[1, 1]) / reach,
        float(theta[0]) + spread.median,
        middle,
        len(x),
    )


def _scale(r: FloatArray) -> float:
    """Robust standard deviation of residuals about zero; two of them are spent on the line."""
    ordered = np.sort(np.abs(r))
    return _TO_SIGMA * float(np.median(ordered[2:] if len(ordered) > 4 else ordered))


def _covariance(X: FloatArray, r: FloatArray, s: float) -> FloatArray | None:
    n = len(r)
    information = X.T @ X
    if s <= 0.0 or np.linalg.cond(information) > 1e12:
        return None
    u = r / s
    psi, slope = np.clip(u, -_HUBER, _HUBER), (np.abs(u) <= _HUBER).mean()
    if slope <= 0.0:
        return None
    K = 1.0 + 2.0 / n * (1.0 - slope) / slope
    variance = (s * K) ** 2 * (n / (n - 2) * float((psi**2).mean())) / slope**2
    return np.asarray(variance * np.linalg.inv(information))


def drift_limit(rigs: int, constants: int) -> float:
    """|slope| over its sigma beyond which a constant drifts, by chance in 5 % of all fleets."""
    return _beyond(rigs - 2, constants)


# ----------------------------------------------------------------------
# A fleet in a bounded number of figures: how its rigs ended, how its constants are spread, whom to look at.

_BINS = 36
_REACH = 6.0
"""Robust standard deviations that a histogram shows on each side of the median."""
_MOST_POINTS = 240
_MOST_LOOKS = 200
_MOST_STANDING_OUT = 20
_ORDER = {"broken": 0, "lost": 0, "failed": 1, "poor": 3, "ok": 4}
_MATRIX = re.compile(r"\[\d+\]\[\d+\]$")
# What a lens does in its region is one thing around a plane's workspace and another in the picture's middle.
_SETTINGS = ("image_size_px[", ".views", ".points", ".pictures", "lens.region_", "distance_m")


@dataclass(frozen=True)
class ConstantSummary:
    """One constant over the fleet.

    Attributes
    ----------
    counts : (bins,) of rigs from `low` to `high`; `below`, `above` : rigs outside of that.
    out : the rigs that do, as (name, value, z), the farthest first, no more than twenty.
    standing_out : how many do.
    drift : None where there are no serial numbers. drifts : whether it is more than chance.
    points : (m, 2) serial numbers and values for a picture, thinned.
    """

    name: str
    unit: str
    spread: Spread
    low: float
    high: float
    counts: tuple[int, ...]
    below: int
    above: int
    standing_out: int
    out: tuple[tuple[str, float, float], ...]
    drift: Drift | None
    drifts: bool
    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Look:
    """A rig to look at, and why."""

    name: str
    serial: str
    verdict: str
    why: str
    z: float | None


@dataclass(frozen=True)
class FleetSummary:
    """All that is told of a fleet.

    Attributes
    ----------
    simulated : how many rigs are. verdicts : rigs by verdict. stages : of each stage the rigs by verdict.
    constants : in the order of the file. looks : the rigs to look at, the worst first, no more than 200.
    to_look_at : how many there are.
    numbered : rigs whose serial has a number. limit : |z| beyond which one stands out, NaN for too few rigs.
    """

    rigs: int
    simulated: int
    verdicts: dict[str, int]
    stages: dict[str, dict[str, int]]
    constants: tuple[ConstantSummary, ...]
    looks: tuple[Look, ...]
    to_look_at: int
    numbered: int
    limit: float

    @property
    def remark(self) -> str:
        """A sentence where no rig could be compared with the others, else nothing."""
        few = not math.isfinite(self.limit)
        return f"No rig is compared with the others: fewer than {FEWEST} have a result." * few


def judged_names(names: tuple[str, ...]) -> list[str]:
    """Constants that rigs are compared by: not the elements of matrices, and not what a person has chosen."""
    given = set(names)
    return [
        name
        for name in names
        if f"{name}.sigma" in given
        and not _MATRIX.search(name)
        and not any(part in name for part in _SETTINGS)
    ]


def summarise(table: Any) -> tuple[FleetSummary, FloatArray, list[str | None]]:
    """The summary of a table, with the largest |z| (n,) of each rig and the constant that it is of."""
    names, serials, verdicts = (texts(table, name) for name in ("name", "serial", "verdict"))
    numbers = np.array([serial_number(serial) for serial in serials], dtype=np.float64)
    wanted = judged_names(tuple(table.column_names))
    listed = [name for name in wanted if _varies(column(table, name))]
    rigs = len(names)
    worst, of = np.full(rigs, np.nan), np.full(rigs, -1, dtype=np.int32)
    # A rig without a result, or without this stage, is none that others are compared with.
    most = max((int(np.isfinite(column(table, name)).sum()) for name in listed), default=0)
    limit = limit_of(most, len(listed)) if most >= FEWEST else float("nan")
    constants = []
    for index, name in enumerate(listed):
        x, sigma = column(table, name), column(table, f"{name}.sigma")
        one, z = _constant(name, x, sigma, numbers, names, limit, len(listed))
        constants.append(one)
        size = np.abs(z)
        larger = np.isfinite(size) & ~(size <= worst)
        worst[larger], of[larger] = size[larger], index
    which = [listed[i] if i >= 0 else None for i in of.tolist()]
    stages = {
        name.removeprefix("verdict."): dict(Counter(v for v in texts(table, name) if v))
        for name in table.column_names
        if name.startswith("verdict.")
    }
    looks, to_look_at = _looks(names, serials, verdicts, texts(table, "sentence"), worst, which, limit)
    summary = FleetSummary(
        rigs,
        sum(table["simulated"].to_pylist()),
        dict(sorted(Counter(verdicts).items(), key=lambda pair: _ORDER.get(pair[0], 2))),
        stages,
        tuple(constants),
        looks,
        to_look_at,
        int(np.isfinite(numbers).sum()),
        limit,
    )
    return summary, worst, which


def _varies(values: FloatArray) -> bool:
    known = values[np.isfinite(values)]
    return len(known) > 0 and bool(known.max() > known.min() or len(known) == 1)


def _constant(
    name: str,
    x: FloatArray,
    sigma: FloatArray,
    numbers: FloatArray,
    names: list[str],
    limit: float,
    constants: int,
) -> tuple[ConstantSummary, FloatArray]:
    spread = spread_of(x, sigma)
    judged = spread.count >= FEWEST and limit == limit
    z = robust_z(x, sigma, spread) if judged else np.full(len(x), np.nan)
    size = np.where(np.isfinite(z), np.abs(z), 0.0)
    standing = np.flatnonzero(size > limit) if judged else np.zeros(0, dtype=np.int64)
    first = sorted(standing.tolist(), key=lambda i: -size[i])[:_MOST_STANDING_OUT]
    drift = drift_of(numbers, x, sigma, spread)
    low, high, counts, below, above = _histogram(x, spread)
    summary = ConstantSummary(
        name,
        unit_of(re.sub(r"\[\d+\]$", "", name)),
        spread,
        low,
        high,
        counts,
        below,
        above,
        len(standing),
        tuple((names[i], float(x[i]), float(z[i])) for i in first),
        drift,
        drift is not None and abs(drift.z) > drift_limit(drift.count, constants),
        _points(numbers, x) if drift is not None else (),
    )
    return summary, z


def _histogram(x: FloatArray, spread: Spread) -> tuple[float, float, tuple[int, ...], int, int]:
    """Bins around the median, so that one rig far off does not squeeze all others into one of them."""
    x = x[np.isfinite(x)]
    if len(x) == 0:
        return 0.0, 0.0, (), 0, 0
    least = max(1e-9 * abs(spread.median), 1e-12)
    reach = max(_REACH * spread.scale if spread.scale > 0.0 else spread.high - spread.low, least)
    low, high = max(spread.low, spread.median - reach), min(spread.high, spread.median + reach)
    if not high - low >= least:
        low, high = low - 0.5 * reach, high + 0.5 * reach
    counts, _ = np.histogram(x, bins=_BINS, range=(low, high))
    return low, high, tuple(counts.tolist()), int((x < low).sum()), int((x > high).sum())


def _points(numbers: FloatArray, x: FloatArray) -> tuple[tuple[float, float], ...]:
    """Values over serial numbers; of many, evenly spaced ones in the order of their numbers."""
    known = np.flatnonzero(np.isfinite(numbers) & np.isfinite(x))
    known = known[np.argsort(numbers[known], kind="stable")]
    known = every(known, _MOST_POINTS)
    return tuple((float(numbers[i]), float(x[i])) for i in known)


def _looks(
    names: list[str],
    serials: list[str],
    verdicts: list[str],
    sentences: list[str],
    worst: FloatArray,
    which: list[str | None],
    limit: float,
) -> tuple[tuple[Look, ...], int]:
    ranked = []
    for i, verdict in enumerate(verdicts):
        size = float(np.nan_to_num(worst[i]))
        if verdict != "ok" or size > limit:
            ranked.append((min(_ORDER.get(verdict, 2), 2 if size > limit else 9), -size, i))
    looks = []
    for _, _, i in heapq.nsmallest(_MOST_LOOKS, ranked):
        z = float(worst[i]) if np.isfinite(worst[i]) else None
        why = [sentences[i].removesuffix(".")] if sentences[i] else []
        if z is not None and z > limit:
            why.append(f"{as_words(which[i] or '')} is {z:.1f} standard deviations from the fleet's median")
        looks.append(Look(names[i], serials[i], verdicts[i], "; ".join(why), z))
    return tuple(looks), len(ranked)
