"""One stage carried out: read, solved, written into the rig's file, drawn; for a verb, and for a run.

In a run a process calls `perform`; what comes of it lies in a folder: rig.yaml with the sections, the stage's
document and words, its messages, the charts of its figures and what it wrote beside them.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import traceback
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from calib.core.command import one_command
from calib.core.errors import EXIT_DONE, EXIT_INTERNAL, EXIT_POOR, NoSectionError, SomeFailedError, end_of
from calib.core.files import one_line, shown
from calib.core.options import options_of
from calib.core.rig import SECTIONS, Rig
from calib.core.stage import AnyStage, Files
from calib.core.writing import check_figures, check_folder, check_writable, one_at_a_time, write_atomically
from calib.runner.cache import BLOCKS
from calib.stages import stage

DOCUMENT, WORDS, MESSAGES = "document.json", "words.json", "messages.txt"
RIG, FIGURES = "rig.yaml", "figures"
"""What a stage leaves in its folder."""


def carry_out(
    made: AnyStage, files: Files, options: Any, rig_path: Path, figures: Path | None = None
) -> tuple[Any, Rig]:
    """Run a stage and write its sections, its output and its figures; its outcome, and the rig after it.

    Nothing is read before it is known that all can be written. Raises `BadInputError`.
    """
    values = (getattr(options, one.name) for one in fields(options))
    with one_command([*files.paths, *(value for value in values if isinstance(value, Path))]):
        return _carried_out(made, files, options, rig_path, figures)


def _carried_out(
    made: AnyStage, files: Files, options: Any, rig_path: Path, figures: Path | None
) -> tuple[Any, Rig]:
    if made.writes_rig(options):
        check_writable(rig_path, SECTIONS)
    output = made.output if files.output is not None else None
    if output is not None and output.write is not None and files.output is not None:
        if output.folder:
            check_folder(files.output)
        else:
            module, kind = output.kind or ("", "")
            check_writable(files.output, getattr(importlib.import_module(module), kind) if kind else None)
    if figures is not None:
        check_figures(figures)
    # A name that a person has mistyped is no empty rig for a stage that lives on its sections.
    of_data = made.writes_rig(options) and bool(made.sources) and not made.needs
    may_begin = of_data or (rig_path.name == RIG and rig_path.parent.is_dir())
    before = stamp(rig_path)
    rig = Rig.load(rig_path, missing_ok=may_begin)
    try:
        outcome = made.run(files, rig, options)
    except NoSectionError:
        if rig_path.name != RIG:
            # A name that was mistyped says which one is meant.
            Rig.load(rig_path)
        raise
    sections = made.sections(outcome)
    if sections:
        with one_at_a_time(rig_path):
            if stamp(rig_path) not in (before, None):
                # What a person or another command has written meanwhile stays.
                rig = Rig.load(rig_path)
            rig = rig.with_sections(sections)
            rig.save(rig_path)
    if output is not None and output.write is not None and files.output is not None:
        files.written = [path.name for path in output.write(files, outcome)]
        if files.written and output.folder:
            files.narrate(f"{', '.join(files.written)} written to {shown(files.output)}")
        elif files.written:
            files.narrate(f"{shown(files.output)} written")
    if figures is not None and made.plots is not None:
        from calib.show.draw import write_figures

        write_figures(figures, made.plots(outcome))
    return outcome, rig


def stamp(path: Path) -> tuple[int, int, int] | None:
    """What changes with a file; None for none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns, status.st_ino


def perform(
    verb: str,
    root: Path,
    folder: Path,
    paths: tuple[Path, ...],
    options: Mapping[str, Any],
    figures: bool,
    output: str,
) -> int:
    """Carry out a stage in this process; its exit code, as that of the verb would be.

    Parameters
    ----------
    verb : words of the stage. paths : what it reads, below `root`.
    folder : with the rig.yaml that the stage may see; takes what comes of it.
    options : values by the names of the stage's options.
    figures : whether it draws. output : name of what it writes beside rig.yaml, "" for nothing.
    """
    messages: list[str] = []
    target = folder / output if output else None
    files = Files(paths, output=target, narrate=messages.append, figures=figures, keep=False)
    made = stage(verb)
    try:
        outcome, _ = carry_out(made, files, options_of(made.options, options), folder / RIG)
        if figures and made.plots is not None:
            from calib.show.charts import write_charts

            write_charts(folder / FIGURES, made.plots(outcome))
        told = made.as_json(outcome, files.written)
        # Nothing in a result differs from run to run.
        told.pop("seconds", None)
        write_atomically(folder / DOCUMENT, json.dumps(told, indent=1) + "\n")
        write_atomically(folder / WORDS, BLOCKS.dump_json(made.blocks(outcome)))
        code = EXIT_DONE if made.verdict(outcome).ok else EXIT_POOR
        files.finish()
    except SomeFailedError as error:
        code = EXIT_POOR
        why = next(words for _, words in files.failed.values())
        messages.append(f"{error}: {why}" if len(files.failed) == 1 else str(error))
    except Exception as error:
        code, sentence = end_of(error)
        if code == EXIT_INTERNAL and os.environ.get("CALIB_DEBUG") == "1":
            traceback.print_exc()
        messages.append(f"calib: {sentence}")
    places = (f"{root}{os.sep}", f"{folder}{os.sep}")
    with contextlib.suppress(OSError):
        # Where it is that a run writes is nobody's concern.
        kept = [one for one in messages if str(folder) not in one or one.startswith("calib: ")]
        write_atomically(folder / MESSAGES, "".join(f"{_nowhere(line, places)}\n" for line in kept))
    return code


def _nowhere(line: str, places: tuple[str, ...]) -> str:
    for place in places:
        line = line.replace(place, "")
    return one_line(" ".join(line.split()))
