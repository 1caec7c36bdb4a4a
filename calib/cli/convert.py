"""`calib convert`: a log of any format as CSV or Parquet."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from calib.cli.common import JsonOption, answer, check_log_name, narrate, progress_bar
from calib.cli.verbs import of_logs
from calib.core.command import note_inputs
from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.core.options import NOTHING_STATED, LogOptions
from calib.core.words import several
from calib.core.writing import check_writable, write_atomically


@of_logs
def convert(
    log: Annotated[Path, typer.Argument(help="Log: .csv, .parquet, .mcap, .bag, .db3 or a ROS 2 folder.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Log to write, .csv or .parquet.")],
    stated: LogOptions = NOTHING_STATED,
    save_columns: Annotated[
        Path | None,
        typer.Option("--save-columns", help="Write what the columns were read as, as a columns.yaml."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a log as CSV or Parquet in SI, block by block; bags by their topics.

    Time is written to the microsecond and values to nine digits in CSV, as they are in Parquet.
    """
    import numpy as np

    from calib.io.columns import COLUMNS_FILE
    from calib.io.logs import LOG, blank_impossible, companion_files, iter_log, refuse_counts
    from calib.io.states import states_writer
    from calib.io.tables import Passed

    check_log_name(output)
    note_inputs([log, *companion_files(log), *stated.files])
    check_writable(output, LOG)
    if save_columns is not None:
        check_writable(save_columns, COLUMNS_FILE)
    stream = iter_log(log, stated, as_it_is=True)
    first = next(stream, None)
    if first is None:
        raise BadInputError(f"{shown(log)}: has a header but no rows")
    if not first.columns:
        raise BadInputError(
            f"{shown(log)}: has no column that is known beside its time, found "
            f"{several(first.unknown) or 'none'}; say in columns.yaml what they are, such as "
            "gz_radps: {column: NAME, unit: deg/s}"
        )
    refuse_counts(first, tuple(first.columns))
    read_as = first.map
    if read_as is not None and read_as.narration:
        narrate(read_as.narration)
    names = tuple(first.columns)
    rows, passed, beyond, before, back, first_back = 0, Passed(), Passed(), -np.inf, 0, ""
    with (
        states_writer(output, ("t_s", *names), LOG) as add,
        progress_bar(f"converting {log.name}") as progress,
    ):
        for block in chain([first], stream):
            add(np.column_stack([block.t_s, *(block.columns[name] for name in names)]))
            rows, passed, beyond = (
                rows + len(block),
                passed + block.passed,
                beyond + blank_impossible(block).passed,
            )
            again = np.flatnonzero(np.diff(block.t_s, prepend=before) < 0.0)
            if len(again) and not back:
                k = again[0]
                first_back = f"line {block.lines[k]}: the time goes back to {block.t_s[k]:g} s"
            # What was cut off may end a log by a block without rows.
            back, before = back + len(again), block.t_s[-1] if len(block) else before
            progress(rows, 0)
    if save_columns is not None and read_as is not None:
        write_atomically(save_columns, read_as.text(), COLUMNS_FILE)
    told = {
        "log": shown(output),
        "rows": rows,
        "columns": list(names),
        "left_out": list(first.unknown),
        "not_finite": passed.not_finite,
        "truncated": passed.truncated,
    }
    sentence = f"{rows} rows written to {shown(output)}: t_s, {', '.join(names)}"
    answer(as_json, "convert", {"convert": told}, sentence)
    if first.unknown and not (read_as and read_as.unknown):
        narrate(f"left out: {', '.join(first.unknown)}")
    for sentence in passed.sentences:
        narrate(sentence)
    if beyond.implausible:
        many = f"{beyond.implausible} cells hold more than any sensor gives ({beyond.first_implausible})"
        narrate(f"{many}; they are written, and other verbs pass them over")
    if back:
        more = f", as in {back - 1} more lines" * (back > 1)
        narrate(f"{first_back}{more}; other verbs refuse that, where it is not of sensors by turns")
