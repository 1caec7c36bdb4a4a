"""The shape of a stage: `read` touches files, `solve` is the mathematics, all else is derived.

From a `Stage` follow the verb of the command line with its options, the function `calib.NAME`, the words
and the JSON document, and the stage's place in a run. A stage's module is loaded for every verb's help, so
it imports what it works with inside of its functions.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVarTuple

from calib.core.errors import BadInputError, CalibError, CopyError, SomeFailedError, end_of
from calib.core.files import hash_of, shown
from calib.core.options import NoOptions
from calib.core.verdict import Finding, Verdict
from calib.core.words import Block, InWords, described

if TYPE_CHECKING:
    from calib.core.arrays import FloatArray
    from calib.core.plot import Figure
    from calib.core.result import Result
    from calib.core.rig import Rig


class ProgressCall(Protocol):
    """Reports how much is done."""

    def __call__(self, done: int, total: int) -> None: ...


Progress = Callable[[str], AbstractContextManager[ProgressCall]]
"""Opens a bar with a label, which is advanced by what it yields."""


def later(module: str, name: str) -> Callable[..., Any]:
    """A function of a module that is loaded as the function is called."""

    def call(*given: Any) -> Any:
        return getattr(importlib.import_module(module), name)(*given)

    return call


@contextmanager
def _silent(label: str) -> Iterator[ProgressCall]:
    del label
    yield lambda done, total: None


_MANY = 0.2
"""Share of the files from which on leaving them out says that something is wrong with the whole."""


@dataclass
class Files:
    """What a stage may read, and who hears about it.

    Attributes
    ----------
    named : what a person named. paths : the same without what is `left_out`.
    rig_path : the rig's file, for sentences.
    output : where -o leads, None without.
    figures : whether what figures are drawn from is wanted. keep : whether arrays are wanted in memory that a
        verb writes or leaves.
    narrate : takes a sentence for the person who watches. progress : a bar with a label.
    hashes : SHA-256 of what was read, by name, for the provenance.
    remarks : sentences on what was read, which are narrated once all of it is.
    written : names of the files that the outcome was written to beside rig.yaml.
    merged : sections whose earlier values go into the outcome as they are.
    failed : by the path of a file that could not be worked on, the exit code it alone would have, and why.
    left_out : why a file that a person named cannot be used beside others, by its path.
    beginnings : first readings of the logs that were read, by name and column.
    """

    paths: tuple[Path, ...] = ()
    rig_path: Path = Path("rig.yaml")
    output: Path | None = None
    narrate: Callable[[str], None] = lambda sentence: None
    progress: Progress = _silent
    hashes: dict[str, str] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    written: list[str] = field(default_factory=list)
    merged: tuple[str, ...] = ()
    failed: dict[Path, tuple[int, str]] = field(default_factory=dict)
    left_out: dict[Path, BadInputError] = field(default_factory=dict)
    beginnings: dict[str, Mapping[str, FloatArray]] = field(default_factory=dict)
    figures: bool = True
    keep: bool = True
    named: tuple[Path, ...] = field(init=False)

    def __post_init__(self) -> None:
        self.named = self.paths

    @contextmanager
    def one_of_several(self, path: Path) -> Iterator[None]:
        """Work on a file; what goes wrong is narrated, where there are others that can be worked on."""
        try:
            yield
        except CalibError as error:
            self._fails(path, error, str(error), error.exit_code)
        except (ArithmeticError, ValueError) as error:
            code, sentence = end_of(error)
            self._fails(path, error, f"{shown(path)}: {sentence}", code)

    def _fails(self, path: Path, error: Exception, words: str, exit_code: int) -> None:
        if len(self.paths) < 2:
            raise error
        self.narrate(words)
        self.failed[path] = exit_code, words

    def finish(self) -> None:
        """End the work, whose outcome has been told. Raises `SomeFailedError` where files have failed."""
        if self.failed:
            names = ", ".join(shown(path.name) for path in self.failed)
            raise SomeFailedError(
                f"{len(self.failed)} of {len(self.named)} files failed: {names}",
                max(code for code, _ in self.failed.values()),
            )

    def leave_out(self, error: BadInputError) -> bool:
        """Whether the work can begin anew without the one file that a sentence begins with.

        It cannot where that leaves less than half of the files, copies not counted, and for a name that leads
        nowhere, which a person has mistyped.
        """
        starts = (
            tuple(f"{shown(name)}{then}" for name in (path, path.name) for then in (": ", ", line "))
            for path in self.paths
        )
        named = [one for one, start in zip(self.paths, starts, strict=True) if str(error).startswith(start)]
        spoilt, whole = _without_copies([*self.left_out.values(), error], self.named)
        many = 2 * len(spoilt) > whole
        if len(named) != 1 or many or not named[0].exists():
            return False
        self.left_out[named[0]] = error
        self.paths = tuple(path for path in self.paths if path != named[0])
        self.hashes.clear()
        self.beginnings.clear()
        self.remarks.clear()
        return True

    def taken(self, path: Path, beginning: Mapping[str, FloatArray] | None = None) -> str:
        """Note that a file is an input; its name without folders, the same wherever the folder lies.

        Parameters
        ----------
        beginning : of a log the first readings by column, which are the same in every format.

        Raises `CopyError` for a copy of one that is.
        """
        name, digest, read = shown(path.name), hash_of(path), beginning or {}
        same = (other for other, one in self.hashes.items() if one == digest)
        alike = (other for other, one in self.beginnings.items() if _same_readings(one, read))
        if first := next(chain(same, alike), ""):
            raise CopyError(f"{shown(path)}: is the same recording as {first}; leave one out")
        if name in self.hashes:
            name = f"{name} ({len(self.hashes) + 1})"
        self.hashes[name] = digest
        self.beginnings[name] = read
        return name


_FEWEST_ALIKE, _ROUNDING = 100, 1e-6
"""So many readings with a sensor's noise agree by no chance; what nine digits leave of them."""


def _without_copies(errors: Iterable[BadInputError], named: Sized) -> tuple[list[BadInputError], int]:
    """Those of the errors that lose a log, and how many logs there are without copies."""
    errors = [*errors]
    spoilt = [error for error in errors if not isinstance(error, CopyError)]
    return spoilt, len(named) - (len(errors) - len(spoilt))


def _same_readings(one: Mapping[str, FloatArray], other: Mapping[str, FloatArray]) -> bool:
    """Whether two logs, or one and the beginning of the other, hold the same readings of the same columns."""
    import numpy as np

    pairs = [(a, other[name]) for name, a in one.items() if name in other]
    pairs = [(a[: len(b)], b[: len(a)]) for a, b in pairs]
    return (
        one.keys() == other.keys()
        and any(len(a) >= _FEWEST_ALIKE and np.ptp(a) > 0.0 for a, _ in pairs)
        and all(np.allclose(a, b, _ROUNDING, _ROUNDING) for a, b in pairs)
    )


@dataclass(frozen=True)
class Output:
    """A file or folder that a verb writes beside rig.yaml.

    Attributes
    ----------
    words : help. flags, metavar : on the command line. default : written even where it is not asked for.
    write : writes an outcome to `Files.output`; the files written. None where the stage itself writes, as one
        does that answers for more than fits into memory.
    folder : whether it is a folder, whose files --json names.
    kind : module and name of the kind of the file.
    """

    words: str
    write: Callable[[Files, Any], Sequence[Path]] | None
    flags: tuple[str, ...] = ("-o", "--output")
    metavar: str = ""
    default: Path | None = None
    folder: bool = False
    kind: tuple[str, str] | None = None


def _parts(outcome: Any) -> tuple[Result | None, ...]:
    return outcome if isinstance(outcome, tuple) else (outcome,)


Inputs = TypeVarTuple("Inputs")


@dataclass(frozen=True)
class Stage(Generic[*Inputs]):
    """One step of a calibration.

    Attributes
    ----------
    name : words of its verb. title : its heading.
    summary : help of the verb and docstring of the function.
    read : (files, rig, options) -> the arguments of `solve`. Raises `BadInputError`.
    solve : mathematics; a `Result`, a tuple of them in the order of `writes`, or a list of others.
    options : a dataclass of `option` fields.
    sources : help for the paths on the command line, "" for a stage without. several : whether there may
        be many. leaves_out : whether one that cannot be used is left out, where others can.
        optional : whether there may be none.
    writes : sections of rig.yaml. parts : those of an outcome that is a list.
    on_request : option without which nothing is written into rig.yaml.
    needs : sections without which it cannot run. uses : those that it reads where they are.
    output : what the verb writes beside rig.yaml.
    document : what --json prints beside the sections. words : blocks in front of the sections' own; an
        outcome that is `InWords` has its own.
    plots : figures by the names of their files, without drawing them.
    remarks : sentences about the rig as it is after the stage.
    """

    name: str
    title: str
    summary: str
    read: Callable[[Files, Rig, Any], tuple[*Inputs]]
    solve: Callable[[*Inputs], Any]
    options: type[Any] = NoOptions
    sources: str = ""
    several: bool = True
    leaves_out: bool = False
    optional: bool = False
    metavar: str = ""
    writes: tuple[str, ...] = ()
    parts: Callable[[Any], tuple[Result | None, ...]] = _parts
    on_request: str = ""
    needs: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    output: Output | None = None
    document: Callable[[Any], dict[str, Any]] = lambda outcome: {}
    words: Callable[[Any], Sequence[Block]] = lambda outcome: ()
    plots: Callable[[Any], dict[str, Figure]] | None = None
    remarks: Callable[[Rig], Sequence[str]] | None = None

    def run(self, files: Files, rig: Rig, options: Any) -> Any:
        """Read and solve; every result knows the hashes of its inputs, and is no better than they are.

        Raises `BadInputError` where a section is missing, or where the answer is none that rig.yaml holds.
        """
        for name in self.needs:
            rig.needed(name, files.rig_path)
        told: set[str] = set()
        while True:
            try:
                outcome = self._once(files, rig, options, told)
                break
            except BadInputError as error:
                if self.leaves_out and files.leave_out(error):
                    continue
                if files.left_out:
                    raise next(iter(files.left_out.values())) from error
                raise
        results, doubts = self.results(outcome), [*rig.doubts(files.hashes), *rig.retyped(files.merged)]
        for result in results:
            result.made_by(self.name, files.hashes).doubt(doubts)
        self._tell_left_out(files, outcome)
        for section in self.sections(outcome).values():
            section.sealed()
        for sentence in () if results else doubts:
            files.narrate(sentence)
        return outcome

    def _once(self, files: Files, rig: Rig, options: Any, told: set[str]) -> Any:
        from pydantic import ValidationError

        inputs = self.read(files, rig, options)
        for sentence in files.remarks:
            if sentence not in told:
                files.narrate(sentence)
        told.update(files.remarks)
        try:
            return self.solve(*inputs)
        except ValueError as error:
            # A fit to nonsense can end anywhere: with values that no section holds, or in a singular matrix.
            from numpy.linalg import LinAlgError

            if not isinstance(error, ValidationError | LinAlgError):
                raise
            what = ""
            if isinstance(error, ValidationError):
                first = error.errors()[0]
                key, value = ".".join(str(part) for part in first["loc"]), first["input"]
                what = f", {key} came out as {value:.6g}" if isinstance(value, int | float) else ""
            names = ", ".join(shown(path) for path in files.paths)
            which = "; one of them may be of another rig or spoilt: leave them out in turn"
            raise BadInputError(
                f"{names}: no useful answer follows{what}{which if len(files.paths) > 1 else ''}"
            ) from error

    def _tell_left_out(self, files: Files, outcome: Any) -> None:
        """Say in the result which files were left out, else narrate it and let `finish` fail."""
        from calib.core.result import Result

        if not files.left_out:
            return
        # What a section holds does not depend on the folder.
        said = [str(error).replace(f"{path.parent}/", "") for path, error in files.left_out.items()]
        one = len(said) == 1
        text = (
            f"{len(said)} of {len(files.named)} logs cannot be used and {'is' if one else 'are'} left out: "
        )
        spoilt, whole = _without_copies(files.left_out.values(), files.named)
        many = len(spoilt) > _MANY * whole
        finding = Finding(
            "poor" if many else "remark",
            text + "; ".join(said),
            f"mend {'that log' if one else 'those logs'}, or record again" if many else "",
        )
        judged = [result for result in self.results(outcome) or [outcome] if isinstance(result, Result)]
        for result in judged:
            result.find(finding)
        if not judged:
            for path, error in files.left_out.items():
                files.narrate(str(error))
                if error in spoilt:
                    files.failed[path] = error.exit_code, str(error)

    def sections(self, outcome: Any) -> dict[str, Result]:
        """The sections of rig.yaml that an outcome holds, by name."""
        if not self.writes:
            return {}
        parts = zip(self.writes, self.parts(outcome), strict=True)
        return {name: part for name, part in parts if part is not None}

    def results(self, outcome: Any) -> list[Result]:
        """All results of an outcome, sections of rig.yaml last."""
        others = outcome if isinstance(outcome, list) else []
        return [*others, *self.sections(outcome).values()]

    def verdict(self, outcome: Any) -> Verdict:
        """All findings on an outcome."""
        judged = self.results(outcome) or [outcome]
        return Verdict.of(finding for one in judged for finding in one.verdict.findings)

    def as_json(self, outcome: Any, written: Sequence[str] = ()) -> dict[str, Any]:
        """The JSON document of an outcome; what is not finite becomes null.

        Parameters
        ----------
        written : names of the files that it was written to, which the document of a folder lists.
        """
        from calib.core.result import section_json

        whole: dict[str, Any] = {"schema": 1, "verb": self.name}
        whole |= {name: section_json(one) for name, one in self.sections(outcome).items()}
        if written and self.output is not None and self.output.folder:
            whole["files"] = list(written)
        return {name: finite(value) for name, value in (whole | self.document(outcome)).items()}

    def blocks(self, outcome: Any) -> list[Block]:
        """An outcome in words, for the terminal and the page."""
        words = outcome.blocks() if isinstance(outcome, InWords) else self.words(outcome)
        return [*words, *(block for one in self.results(outcome) for block in described(one))]

    def writes_rig(self, options: Any) -> bool:
        """Whether sections of rig.yaml are written with these options."""
        return bool(self.writes) and (not self.on_request or bool(getattr(options, self.on_request)))


AnyStage = Stage[*tuple[Any, ...]]
"""A stage of which no more is known than that `solve` takes what `read` returns."""


def finite(value: Any) -> Any:
    """Plain values for JSON: what is not finite becomes null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    return [finite(item) for item in value] if isinstance(value, list | tuple) else value
