"""Coverage-guided fuzzing of one reader: `python tests/fuzz log_csv --seconds 600`.

A target is a module of this folder with `check(data, folder)`, which gives the bytes to a reader and may
end in no other way than by returning or with a `BadInputError` of one line, with `WORDS`, which the mutator
puts in place of words of the input, and perhaps a `mutate` of its own. Needs atheris (extra `fuzz`); the
replay of the corpus does not.

    --seconds N       how long; 60 by default
    --work FOLDER     where the growing corpus and the findings go; a temporary folder by default
    --minimise        put the smallest inputs that reach the same lines into corpus/<target> afterwards
    --coverage        run nothing but the corpus, and say which lines of which modules it reaches
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import importlib
import importlib.util
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from hashlib import sha256
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

import calib
from calib.core.errors import BadInputError

__all__ = ["CORPUS", "LONGEST_SENTENCE", "TARGETS", "corpus", "main", "only_inside", "run"]

HERE = Path(__file__).resolve().parent
CORPUS = HERE / "corpus"
TARGETS = (
    "rig_yaml", "board_yaml", "log_csv", "table_csv", "vnl", "filestorage", "serial_frames", "bag_ros1",
    "bag_ros2", "bag_mcap", "manifest", "sweep_yaml",
)  # fmt: skip
LONGEST_SENTENCE = 2000
_CALIB = Path(calib.__file__).resolve().parent
_MEMORY_BYTES = 1 << 30
_SLOWEST_S = 10
"""Of processor time for one input; a machine that stands still for a while is no finding."""

Check = Callable[[bytes, Path], None]


class Forbidden(AssertionError):
    """Something was written, removed or started where nothing may be."""


class TooSlow(Exception):
    """One input has taken more than its time."""


def corpus(target: str) -> list[Path]:
    """Inputs that are kept for a target, in the order of their names."""
    return sorted((CORPUS / target).iterdir())


def run(check: Check, data: bytes, folder: Path) -> str:
    """Give one input to a target; "" or the sentence of its refusal. Any other end is a finding."""
    with warnings.catch_warnings():
        # The command line does not show what libraries warn of.
        warnings.simplefilter("ignore")
        try:
            check(data, folder)
        except BadInputError as error:
            # A reader that refuses whatever its library raises must not hide these.
            if isinstance(error.__cause__, MemoryError | TooSlow | Forbidden):
                raise error.__cause__ from None
            sentence = str(error)
            assert sentence and "\n" not in sentence and len(sentence) < LONGEST_SENTENCE, repr(sentence)
            assert sentence.isprintable(), repr(sentence)
            return sentence
    return ""


_INSIDE: list[Path] = []
_HOOKED: list[bool] = []


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if not _INSIDE:
        return
    paths: list[Any] = []
    opens = event == "open" and isinstance(arguments[2], int)
    if opens and not arguments[2] & (os.O_WRONLY | os.O_RDWR):
        return
    if opens or event in ("os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod", "os.chown"):
        paths = [arguments[0]]
        if event in ("os.remove", "os.rmdir") and arguments[1] >= 0:
            paths = [Path(f"/proc/self/fd/{arguments[1]}", os.fsdecode(arguments[0]))]
    elif event in ("os.rename", "os.link", "os.symlink"):
        paths = [arguments[0], arguments[1]]
    elif event in ("subprocess.Popen", "os.system", "os.exec", "socket.connect"):
        raise Forbidden(f"reached {event}")
    for path in paths:
        if isinstance(path, str | bytes | os.PathLike):
            real = Path(os.path.realpath(os.fsdecode(path)))
            ours = real.is_relative_to(_INSIDE[0]) or real == Path(os.devnull) or "__pycache__" in real.parts
            if not ours:
                raise Forbidden(f"wrote outside: {event} {real}")


@contextlib.contextmanager
def only_inside(folder: Path) -> Iterator[None]:
    """`Forbidden` where anything is written, removed or started outside of a folder."""
    if not _HOOKED:
        sys.addaudithook(_hook)
        _HOOKED.append(True)
    _INSIDE.append(Path(os.path.realpath(folder)))
    try:
        yield
    finally:
        _INSIDE.pop()


_WORD = re.compile(rb"[^\s,:\[\]{}<>\"'#]+")
_COMMON = (
    b"0", b"-1", b"1e308", b"-1e-320", b"nan", b".nan", b"inf", b"-.inf", b"null", b"~", b"true", b"1_0",
    b"0x10", b"1e400", b"9" * 30, b"9" * 400, b"", b"\xff", b"\x00", b"\xef\xbb\xbf", b"\xe2\x80\xae",
    b"\xed\xa0\x80", b"\r", b"\n", b"\x1b[2J", b"..", b"../../x", b"\"", b"'", b"!!python/none ", b"&a ",
    b"*a", b"<<: *a", b"<script>", b"2020-01-01", b"0.5", b"2", b"1e-30", b"=1+1", b"[]", b"{}", b"- ",
)  # fmt: skip


def mutate(data: bytes, words: Sequence[bytes], dice: random.Random) -> bytes:
    """A neighbour of a text: a word, a line or a part replaced, doubled, moved or removed."""
    spots = [match.span() for match in _WORD.finditer(data)] or [(0, len(data))]
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        a, b = dice.choice(spots)
        if b > len(data):
            break
        c, d = dice.choice(spots)
        what = dice.randrange(8)
        if what < 3:
            data = data[:a] + dice.choice((*words, *_COMMON)) + data[b:]
        elif what == 3:
            data = data[:a] + data[c:d] + data[b:]
        elif what == 4:
            data = data[:a] + str(dice.choice((1, -1, 1e-6, 1e6)) * dice.uniform(0, 10)).encode() + data[b:]
        else:
            lines = data.split(b"\n")
            i, j = dice.randrange(len(lines)), dice.randrange(len(lines))
            if what == 5:
                del lines[min(i, j) : min(max(i, j), min(i, j) + dice.randrange(1, 4))]
            elif what == 6:
                lines.insert(i, lines[j])
            else:
                lines[i], lines[j] = lines[j], lines[i]
            data = b"\n".join(lines)
    return data


def _compiled() -> list[str]:
    """Modules that numba compiles: it does not know the fuzzer's counters."""
    found = [path for path in _CALIB.rglob("*.py") if "from numba" in path.read_text()]
    return [".".join(("calib", *path.relative_to(_CALIB).with_suffix("").parts)) for path in found]


def _rooms() -> Path:
    """A folder for the files of one input; in memory where the system has such a place."""
    memory = Path("/dev/shm")
    made = tempfile.mkdtemp(prefix="calib-fuzz-", dir=memory if os.access(memory, os.W_OK) else None)
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return Path(made)


def _place(error: BaseException) -> str:
    """Kind of an exception and the line of this package that it came from, to tell findings apart."""
    where = ""
    for frame in traceback.extract_tb(error.__traceback__):
        if "calib" in frame.filename or "fuzz" in frame.filename:
            where = f"{Path(frame.filename).name}:{frame.lineno}"
    return f"{type(error).__name__} {where}"


def _fuzz(name: str, target: ModuleType, seconds: int, work: Path, folder: Path) -> int:
    """Fuzz in this process; returns the number of different findings."""
    import atheris

    check, words, most = target.check, target.WORDS, getattr(target, "MOST_BYTES", 20_000)
    findings: dict[str, int] = {}
    signal.signal(signal.SIGVTALRM, _too_slow)
    with atheris.instrument_imports(include=["calib"], exclude=_compiled()):
        for path in corpus(name):
            _guarded(check, path.read_bytes(), folder, findings, work)
    # What is imported late is imported now; from here on memory has a bound.
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY_BYTES, resource.RLIM_INFINITY))

    def one(data: bytes) -> None:
        _guarded(check, data, folder, findings, work)

    def mutator(data: bytes, longest: int, seed: int) -> bytes:
        dice = random.Random(seed)
        way = dice.random()
        if way < 0.4:
            return bytes(atheris.Mutate(data, longest))
        if way < 0.7 and hasattr(target, "mutate"):
            return bytes(target.mutate(data, dice)[:longest])
        return mutate(data, words, dice)[:longest]

    grown = work / "corpus"
    grown.mkdir(parents=True, exist_ok=True)
    argv = [
        sys.argv[0], str(grown), str(CORPUS / name), f"-max_total_time={seconds}", "-timeout=600",
        f"-max_len={most}", "-len_control=0", "-print_final_stats=1", f"-artifact_prefix={work}/",
        "-rss_limit_mb=3000", "-reload=0", "-report_slow_units=100000",
    ]  # fmt: skip
    atheris.Setup(argv, one, custom_mutator=mutator)
    atheris.Fuzz()
    return len(findings)


def _too_slow(*_: object) -> None:
    raise TooSlow(f"more than {_SLOWEST_S} s of processor time")


def _guarded(check: Check, data: bytes, folder: Path, findings: dict[str, int], work: Path) -> None:
    """Run one input; a finding is kept and the search goes on."""
    signal.setitimer(signal.ITIMER_VIRTUAL, _SLOWEST_S)
    try:
        with only_inside(folder):
            run(check, data, folder)
    except Exception as error:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        place = _place(error)
        if place not in findings:
            findings[place] = 0
            stem = work / f"finding-{sha256(place.encode()).hexdigest()[:8]}"
            stem.with_suffix(".input").write_bytes(data)
            stem.with_suffix(".txt").write_text("".join(traceback.format_exception(error)))
            sys.stderr.write(f"FINDING {place}: {str(error)[:200]!r} in {stem}.input\n")
        findings[place] += 1


class _Lines:
    """Collects the arcs between lines of this package that are run."""

    def __init__(self) -> None:
        self.arcs: set[tuple[str, int, int]] = set()

    def __call__(self, frame: FrameType, event: str, _: object) -> Any:
        if event == "call" and not frame.f_code.co_filename.startswith(str(_CALIB)):
            return None
        last = [frame.f_code.co_firstlineno]

        def lines(inner: FrameType, event: str, _: object) -> Any:
            if event == "line":
                self.arcs.add((inner.f_code.co_filename, last[0], inner.f_lineno))
                last[0] = inner.f_lineno
            return lines

        return lines


def _arcs(check: Check, data: bytes, folder: Path) -> set[tuple[str, int, int]]:
    seen = _Lines()
    sys.settrace(seen)
    try:
        with contextlib.suppress(Exception):
            run(check, data, folder)
    finally:
        sys.settrace(None)
    return seen.arcs


def _minimise(name: str, check: Check, work: Path, most: int = 60) -> None:
    """Keep the smallest inputs that together reach all arcs."""
    folder, target = _rooms(), CORPUS / name
    candidates = {path.read_bytes() for path in (*(work / "corpus").iterdir(), *target.iterdir())}
    reached: set[tuple[str, int, int]] = set()
    kept: list[bytes] = []
    for data in sorted(candidates, key=lambda one: (len(one), one)):
        new = _arcs(check, data, folder) - reached
        if new and len(data) <= 12_000:
            reached |= new
            kept.append(data)
    # From the largest down: one whose arcs the others reach as well is not needed.
    arcs = {data: _arcs(check, data, folder) for data in kept}
    for data in sorted(kept, key=len, reverse=True):
        others = set().union(*(arcs[other] for other in kept if other is not data))
        if arcs[data] <= others:
            kept.remove(data)
    kept = sorted(kept, key=lambda one: -len(arcs[one]))[:most]
    for path in target.iterdir():
        if not path.name.startswith("seed"):
            path.unlink()
    there = {path.read_bytes() for path in target.iterdir()}
    for data in kept:
        if data not in there:
            (target / sha256(data).hexdigest()[:12]).write_bytes(data)
    print(f"{name}: {len(candidates)} inputs, {len(list(target.iterdir()))} kept, {len(reached)} arcs")


def _code_lines(code: CodeType) -> set[int]:
    inner = [c for c in code.co_consts if isinstance(c, CodeType)]
    own = {line for _, _, line in code.co_lines() if line is not None and line != code.co_firstlineno}
    return own.union(*(_code_lines(c) for c in inner))


def _tell_coverage(name: str, check: Check, modules: Sequence[str]) -> None:
    folder, reached = _rooms(), set[tuple[str, int]]()
    for path in corpus(name):
        reached |= {(file, line) for file, _, line in _arcs(check, path.read_bytes(), folder)}
    for module in modules:
        spec = importlib.util.find_spec(module)
        assert spec is not None and spec.origin is not None
        code = compile(Path(spec.origin).read_text(), spec.origin, "exec")
        # Statements of the module itself have run when it was imported.
        lines = set().union(*(_code_lines(c) for c in code.co_consts if isinstance(c, CodeType)))
        hit = {line for file, line in reached if file == spec.origin} & lines
        print(f"{name}: {module}: {len(hit)} of {len(lines)} lines in functions, {len(hit) / len(lines):.0%}")


def main() -> None:
    """The command line."""
    words = argparse.ArgumentParser(
        prog="fuzz", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    words.add_argument("target", choices=TARGETS)
    words.add_argument("input", nargs="?", type=Path)
    words.add_argument("--seconds", type=int, default=60)
    words.add_argument("--work", type=Path)
    words.add_argument("--minimise", action="store_true")
    words.add_argument("--coverage", action="store_true")
    words.add_argument("--inner", type=Path, help=argparse.SUPPRESS)
    told = words.parse_args()
    name, target = told.target, importlib.import_module(f"fuzz.{told.target}")
    if told.input is not None:
        print(repr(run(target.check, told.input.read_bytes(), _rooms())))
        return
    if told.coverage:
        _tell_coverage(name, target.check, target.MODULES)
        return
    work = told.work or Path(tempfile.mkdtemp(prefix=f"calib-fuzz-{name}-"))
    work.mkdir(parents=True, exist_ok=True)
    if told.inner is not None:
        _fuzz(name, target, told.seconds, work, told.inner)
        return
    # A process that libFuzzer ends removes nothing.
    room = _rooms()
    ends = time.monotonic() + told.seconds
    # A process that a fault in a library has ended is followed by another.
    while (left := int(ends - time.monotonic())) > 0:
        inner = ["--inner", str(room), "--seconds", str(left), "--work", str(work)]
        code = subprocess.run([sys.executable, str(HERE), name, *inner], check=False).returncode
        if code == 0:
            break
        print(f"{name}: ended with {code}, see {work}")
    if told.minimise:
        _minimise(name, target.check, work)
    found = sorted(path for path in work.iterdir() if path.is_file() and path.suffix != ".txt")
    print(f"{name}: {len(found)} findings in {work}")
    sys.exit(1 if found else 0)
