"""Functions that numba compiles: how, where the result is kept, and what is told meanwhile."""

from __future__ import annotations

import contextlib
import os
import re
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

from numba import njit
from numba.core import config, event
from numba.core.caching import FunctionCache
from numba.core.targetconfig import TargetConfig
from numba.core.types import unliteral

from calib.core.writing import lock_within

_Parameters = ParamSpec("_Parameters")
_Returned = TypeVar("_Returned")

# A large function takes 10 s on a fast machine, several times that on a small one.
_LONGEST_WAIT_S = 300.0


_PACKAGE = Path(__file__).parents[1]
_IMPORTS = re.compile(r"^from calib\.([\w.]+) import (\([^)]*\)|.*)$", re.MULTILINE)


@cache
def _sources(path: Path) -> frozenset[Path]:
    """A file and the modules of calib that it is made from, which it imports, and they, and so on."""
    found, new = {path}, [path]
    while new:
        modules = set()
        for package, names in _IMPORTS.findall(new.pop().read_text(encoding="utf-8")):
            folder = _PACKAGE.joinpath(*package.split("."))
            modules |= {
                folder.with_suffix(".py"),
                *(folder / f"{name}.py" for name in re.findall(r"\w+", names)),
            }
        new += [module for module in modules - found if module.is_file()]
        found |= modules
    return frozenset(one for one in found if one.is_file())


class _CompiledOnce:
    """Numba's cache of one function on disk; of processes that miss it at one time the first compiles.

    Without it a run with an empty cache compiled a third of its functions twice, 20 s of 66. Numba holds the
    lock of its compiler around both calls, so threads cannot wait for one another here.
    """

    def __init__(self, function: object) -> None:
        # Numba tells no types of it.
        make: Any = FunctionCache
        self._kept = make(function)
        # What is compiled holds the functions that it calls and the constants of other files. Numba looks at
        # its own file alone: after one of the others had changed, an old caller wrote beyond an array.
        with contextlib.suppress(OSError):
            own = Path(self._kept._py_func.__code__.co_filename)
            stats = [one.stat() for one in sorted(_sources(own))]
            self._kept._cache_file._source_stamp = tuple((one.st_mtime, one.st_size) for one in stats)
        self._path = Path(self._kept.cache_path) / f"{self._kept._impl.filename_base}.lock"
        self._lock: int | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kept, name)

    def load_overload(self, signature: object, target: object) -> object:
        """What is kept for a signature, waiting for a process that compiles it; None to be compiled here."""
        kept = self._kept.load_overload(signature, target)
        if kept is None:
            self._wait()
            kept = self._kept.load_overload(signature, target)
            if kept is not None:
                self._release()
        return kept

    def save_overload(self, signature: object, compiled: object) -> None:
        """Keep what was compiled and let the others go on."""
        try:
            self._kept.save_overload(signature, compiled)
        finally:
            self._release()

    def _wait(self) -> None:
        self._release()
        with contextlib.suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self._path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o600)
            lock_within(self._lock, _LONGEST_WAIT_S)

    def _release(self) -> None:
        if self._lock is None:
            return
        # Who has opened the file before it went compiles as well: time is lost, nothing else.
        with contextlib.suppress(OSError):
            self._path.unlink()
        os.close(self._lock)
        self._lock = None


def _choose_folder() -> None:
    """Keep what is compiled in a temporary folder of the user's own, where numba would find no place.

    Numba looks beside the functions and in the home folder by itself, and fails without either. It runs what
    it finds, so the folder must be nobody else's.
    """
    places = Path(__file__).parent, Path("~").expanduser()
    # Numba tells no types of it.
    settings: Any = config
    if settings.CACHE_DIR or any(os.access(place, os.W_OK) for place in places):
        return
    folder = Path(tempfile.gettempdir()) / f"calib-compiled-{os.getuid() if hasattr(os, 'getuid') else 'own'}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        settings.CACHE_DIR = str(folder if _own(folder) else tempfile.mkdtemp(prefix="calib-compiled-"))
    except OSError:
        # Nothing at all can be written; numba will say so.
        return


def _own(folder: Path) -> bool:
    found = folder.lstat()
    private = not hasattr(os, "getuid") or (found.st_uid == os.getuid() and not found.st_mode & 0o077)
    return stat.S_ISDIR(found.st_mode) and private


_choose_folder()


def _compare_quickly() -> None:
    """Let numba compare sets of options by those that are set, and look them up by their class.

    For each call that it types numba makes dictionaries of all options, to hash a set and to compare it with
    itself: a tenth of the time.
    """
    # Numba tells no types of it.
    options: Any = TargetConfig
    thorough = options.__eq__

    def same(one: Any, other: object) -> Any:
        alike = type(one) is type(other) and getattr(one, "_values", 0) == getattr(other, "_values", 1)
        return one is other or alike or thorough(one, other)

    options.__eq__, options.__hash__ = same, lambda one: hash(type(one))


_compare_quickly()


def kernel(
    *, arrays: bool = True, inlined: bool = False, reordered: bool = False
) -> Callable[[Callable[_Parameters, _Returned]], Callable[_Parameters, _Returned]]:
    """Have numba compile a function, keep it on disk and run it without Python's lock; n / 0 is infinite.

    A product and a sum stay two roundings: where they may be one, the last digits depend on the order in
    which functions happen to be compiled.

    Parameters
    ----------
    arrays : whether it makes arrays. Without, references to those that it gets are not counted, which took a
        third of a filter's time; numba keeps that option for itself, and works without it, only slower.
    inlined : whether it becomes part of its caller. A call passes seven numbers for each array.
    reordered : whether sums may be taken in any order, and products and sums with one rounding.
    """
    # A wrapper for callers in C, which there are none of, takes a twentieth of the time to compile.
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    if not arrays:
        options["_nrt"] = False
    if inlined:
        options["forceinline"] = True
    if reordered:
        options["fastmath"] = {"reassoc", "nsz", "contract"}

    def compiled(function: Callable[_Parameters, _Returned]) -> Callable[_Parameters, _Returned]:
        made = njit(**options)(function)
        template = made.get_call_template
        # A constant in a call is a value like any other: numba would compile the function anew for each.
        plain: Callable[[Any], Any] = unliteral
        made.get_call_template = lambda types, named: template([plain(one) for one in types], named)
        # What `cache=True` does, with our own cache; there is none where no folder can be written.
        with contextlib.suppress(RuntimeError):
            made._cache = _CompiledOnce(function)
        return cast("Callable[_Parameters, _Returned]", made)

    return compiled


class _Once(event.Listener):
    """Calls a function when the first compilation begins."""

    def __init__(self, call: Callable[[], None]) -> None:
        self._call, self._called = call, False

    def on_start(self, _: object) -> None:
        """A compilation begins."""
        if not self._called:
            self._called = True
            self._call()

    def on_end(self, _: object) -> None:
        """It has ended."""


@contextmanager
def on_compiling(call: Callable[[], None]) -> Iterator[None]:
    """Call a function once if anything is compiled in this block, when it begins; not for what is cached."""
    # Numba tells no types of these.
    events: Any = event
    listener = _Once(call)
    events.register("numba:compile", listener)
    try:
        yield
    finally:
        events.unregister("numba:compile", listener)
