"""Rigs of a fleet: their rows of the manifest, their files fetched, their runs, their outcomes."""

from __future__ import annotations

import contextlib
import csv
import io
import ipaddress
import re
import socket
import tempfile
import time
import urllib.parse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict

from calib.core.constants import constants
from calib.core.errors import (
    EXIT_DONE,
    EXIT_INTERNAL,
    EXIT_POOR,
    BadInputError,
    CalibError,
    end_of,
)
from calib.core.files import PICTURES, one_line, read_text, read_yaml_mapping, sha256, shown
from calib.core.options import name_of_flag, options_of
from calib.core.result import Section
from calib.core.rig import Rig
from calib.core.schema import validated
from calib.core.writing import make_folder
from calib.runner.cache import key_of, program
from calib.runner.folder import Folder, folder_digests, read_folder
from calib.runner.graph import STEPS, Runner, opened_run
from calib.runner.outcomes import SAME, Answer, Outcome
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
_MOST_BYTES = 200_000_000
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
    """

    name: str
    source: str
    serial: str = ""
    options: tuple[tuple[str, str], ...] = ()


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
    text = read_text(path, _MOST_BYTES)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        head = [name.strip() for name in next(reader, [])]
    except csv.Error as error:
        raise BadInputError(f"{shown(path)}, line 1: is not CSV: {error}") from error
    if not any(head):
        raise BadInputError(f"{shown(path)}: is empty, expected a header with name and path")
    for name in ("name", "path"):
        if name not in head:
            found = one_line(", ".join(head))[:80]
            raise BadInputError(f"{shown(path)}, line 1: has no column {name}, found {found}")
    twice = next((name for name in head if name and head.count(name) > 1), None)
    if twice is not None:
        raise BadInputError(f"{shown(path)}, line 1: has the column {one_line(twice)!r} twice")

    def rows() -> Iterator[tuple[str, Mapping[str, Any]]]:
        try:
            for cells in reader:
                if not any(cell.strip() for cell in cells):
                    continue
                where = f"line {reader.line_num}"
                if len(cells) != len(head):
                    raise BadInputError(
                        f"{shown(path)}, {where}: has {len(cells)} cells, the header {len(head)}"
                    )
                yield where, dict(zip(head, cells, strict=True))
        except csv.Error as error:
            raise BadInputError(f"{shown(path)}, line {reader.line_num}: is not CSV: {error}") from error

    return rows(), tuple(one_line(name) for name in head if name and _strange(name))


def _from_yaml(path: Path) -> tuple[Iterator[tuple[str, Mapping[str, Any]]], tuple[str, ...]]:
    whole = validated(_Listed, read_yaml_mapping(path), path)
    common = whole.options.model_dump(exclude_unset=True)
    rows = ((f"rig {number}", {**common, **entry}) for number, entry in enumerate(whole.rigs, start=1))
    return rows, tuple(dict.fromkeys(one_line(key) for entry in whole.rigs for key in entry if _strange(key)))


def _strange(column: str) -> bool:
    return column not in _Row.model_fields


def _rig(where: str, row: Mapping[str, Any], root: Path) -> RigSpec:
    told = validated(_Row, {key: value for key, value in row.items() if value is not None}, where)
    options = tuple((key, value) for key in OPTIONS if (value := getattr(told, key)))
    try:
        options_of(stage("intrinsics").options, camera_options(options))
    except CalibError as error:
        raise BadInputError(f"{where}: {told.name}: {error}") from error
    source = told.path if is_url(told.path) else str(root / told.path)
    return RigSpec(told.name, source, told.serial, options)


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
MOST_BYTES = 4_000_000_000
_MOST_FILES = 20_000
_PIECE = 1 << 20
_SUFFIXES = (*PICTURES, ".csv", ".parquet", ".yaml")
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


def local_folder(
    source: str,
    scratch: Path,
    attempts: int,
    most_bytes: int = MOST_BYTES,
    allowed: Allowed = Allowed(),
) -> Path:
    """The rig's folder: the path itself, or `scratch` with what was fetched.

    Raises `BadInputError` for a folder that is not there, cannot be had, or is not to be fetched.
    """
    if not is_url(source):
        root = Path(source)
        if not root.is_dir():
            what = "is a file" if root.exists() else "is not there"
            raise BadInputError(f"{shown(root)}: {what}, expected the rig's folder")
        return root
    check_url(source, allowed)
    return _fetched(source, scratch, attempts, most_bytes)


def _fetched(url: str, scratch: Path, attempts: int, most_bytes: int) -> Path:
    try:
        # Where a server sends one on to was not looked at.
        words = {"allow_redirects": False} if url.lower().startswith("http") else {}
        system, root = needed("fsspec.core").url_to_fs(url, **words)
    except ImportError as error:
        raise BadInputError(
            f"{without_secrets(url)}: needs a package that is not here: {_words(error)}"
        ) from error
    except (ValueError, OSError) as error:
        raise BadInputError(f"{without_secrets(url)}: is no URL that can be read: {_words(error)}") from error
    told = without_secrets(url)
    listed = _again(partial(_listed, system, str(root), told), attempts, told)
    if not listed:
        raise BadInputError(f"{told}: holds no pictures and no logs")
    total = 0
    for name, remote in listed.items():
        left = most_bytes - total
        target = scratch / name
        make_folder(target.parent)
        total += _again(partial(_copied, system, remote, target, left, told), attempts, told)
    return scratch


def _again(work: Callable[[], Any], attempts: int, told: str) -> Any:
    """What `work` returns; a fault that may pass is given time to."""
    for attempt in range(max(1, attempts)):
        try:
            return work()
        except BadInputError:
            raise
        except _FINAL as error:
            raise BadInputError(f"{told}: cannot be read: {_words(error)}") from error
        except Exception as error:  # each file system has errors of its own
            if attempt + 1 >= max(1, attempts):
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
                raise BadInputError(f"{told}: is larger than {1e-9 * MOST_BYTES:g} GB, or than was allowed")
            sink.write(piece)
    return size


# ----------------------------------------------------------------------
# One rig in this process: the stages of `calib run`, or those of a camera, one verb after the other.
#
# The verbs are those that a person types, with the same words, so that the results are the same bytes.
# Figures are drawn only for a page; they change no number.

CAMERA_STAGES = ("intrinsics", "extrinsics", "distortion")


def rig_folder(root: Path) -> Folder:
    """What a rig's folder holds; pictures may lie in it directly where there is neither images/ nor logs/.

    Raises `BadInputError` for a folder with nothing to work on.
    """
    if (root / "images").is_dir() or (root / "logs").is_dir():
        return read_folder(root)
    root = root.absolute()
    try:
        found = sorted(path for path in root.iterdir() if path.suffix.lower() in PICTURES and path.is_file())
    except OSError as error:
        raise BadInputError(f"{shown(root)}: cannot be listed: {error.strerror or error}") from error
    pictures = tuple(path for path in found if not path.is_symlink() and not path.name.startswith("."))
    if not pictures:
        raise BadInputError(f"{shown(root)}: holds no images/, no logs/ and no pictures")
    board, rig = root / "board.yaml", root / "rig.yaml"
    return Folder(
        root, pictures, board if board.is_file() else None, (), None, (), rig if rig.is_file() else None, ()
    )


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
    return EXIT_POOR if "poor" in statuses or "ok" not in statuses else EXIT_DONE


# ----------------------------------------------------------------------
# The work on one rig, as it goes to a process: a function of the rig and the options alone.
#
# Nothing is kept between rigs and nothing is written but scratch, so that a rig that is tried again,
# elsewhere or later, gives the same bytes.

_MOST_KEPT_BYTES = 30_000_000
_TELLING = ("poor", "failed", "blocked")
_STATUS = {EXIT_DONE: "ok", EXIT_POOR: "poor", EXIT_INTERNAL: "broken"}


@dataclass(frozen=True)
class FleetOptions:
    """What holds for all rigs.

    Attributes
    ----------
    pages : whether each rig's page is made and brought back.
    attempts : to fetch a file. most_bytes : of a folder that is fetched. allowed : what may be fetched.
    """

    pages: bool = False
    attempts: int = 3
    most_bytes: int = MOST_BYTES
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
    began = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory(prefix="rig-") as place:
            answer = _calibrated(spec, options, known, Path(place))
    except Exception as error:
        code, sentence = end_of(error)
        answer = Answer(
            Outcome(name=spec.name, status=_STATUS.get(code, "failed"), code=code, sentence=sentence)
        )
    spent = {"seconds": round(time.perf_counter() - began, 3), "peak_MB": peak_memory_MB()}
    return replace(answer, outcome=answer.outcome.model_copy(update=spent))


def _calibrated(spec: RigSpec, options: FleetOptions, known: str, place: Path) -> Answer:
    root = local_folder(spec.source, place / "fetched", options.attempts, options.most_bytes, options.allowed)
    folder = rig_folder(root)
    kind = kind_of(folder)
    inputs = {folder.name_of(path): digest for path, digest in folder_digests(folder).items()}
    chosen = [word for pair in spec.options for word in pair]
    command = ("fleet", kind, str(options.pages), program(), *chosen)
    key = key_of(command, inputs, "")
    if known == key:
        return Answer(Outcome(name=spec.name, status=SAME, key=key))
    import cv2

    from calib.core.workers import at_most

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with at_most(1):
            done = run_stages(folder, kind, spec.options, place / "out", options.pages)
    finally:
        cv2.setNumThreads(threads)
    files, code = _kept(done.out, done.files, options.pages), _code(done, kind)
    reasons = tuple(f"{job.step.title}: {job.reason}" for job in done.ended if job.status in _TELLING)
    outcome = Outcome(
        name=spec.name,
        status=_STATUS.get(code, "failed"),
        code=code,
        sentence=reasons[0] if reasons else "",
        key=key,
        kind=kind,
        reasons=reasons,
        stages={job.name: job.status for job in done.ended},
        values=_values(done.out / "rig.yaml"),
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
    return {f"{one.section}.{one.name}": (one.value, one.sigma) for one in constants(Rig.load(rig).values())}


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
