"""A day-long log through `calib replay`: rows a second by stage, wall time, peak memory.

    python tests/bench/day.py [--rows 8640000] [--format csv] [--states csv] [--model kinematic] [--folder F]

The log is ten minutes of the simulated rig's ellipse, IMU at 100 Hz and camera at 60 Hz, again and again
with its time going on. `--imu` leaves the camera out, so that 8.64 million rows are a day; `--truth` keeps
what only the simulated rig knows, which is scored and compared with the baseline. First each stage by
itself on the first rows, in processor time; then the command as a person runs it, on the first tenth of the
rows and on all, so that what grows with the rows can be seen.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import _here
import numpy as np
import yaml
from _rows import CALIB, run
from estimatorlogs import ALIGNED

from calib.core.arrays import FloatArray
from calib.core.rig import Rig
from calib.io.columns import COLUMNS, STATES, TRUE
from calib.io.logs import Log, iter_log
from calib.io.states import states_writer
from calib.io.tables import GENERAL, TIME, table_bytes
from calib.stages.estimator.consistency import Tally
from calib.stages.estimator.kinematic import OUT
from calib.stages.estimator.read import rows_of, truth_of
from calib.stages.estimator.replay import drive_for, estimator_for, opened
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import run_log

BLOCK_S = 600.0
FIRST_BLOCKS = 40


def make_rig(path: Path) -> None:
    """rig.yaml from the shipped pictures, with an alignment."""
    images = _here.ROOT / "images"
    for verb, folder in (("intrinsics", images), ("extrinsics", images / "plane")):
        done = run([*CALIB, verb, str(folder), "--rig", str(path)])
        if done.code not in (0, 1):
            raise SystemExit(f"{verb}: exit code {done.code}")
    document = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump(document | {"align": ALIGNED}))


def _ten_minutes(imu_only: bool, truth: bool) -> Log:
    log = run_log(run_scenario(make_scenario("ellipse"), SimulatedRig(), 0, "sensors", BLOCK_S))
    if not truth:
        log = replace(log, columns={k: v for k, v in log.columns.items() if k not in TRUE})
    if not imu_only:
        return log
    rows = log.sampled("gz_radps")
    columns = {k: v[rows] for k, v in log.columns.items() if k[0] in "ag"}
    return replace(log, t_s=log.t_s[rows], columns=columns, lines=log.lines[rows])


def _parts(log: Log, names: list[str], rows: int) -> Iterator[FloatArray]:
    """Time and columns, ten minutes at a time, time going on."""
    block = np.column_stack([log.t_s, *(log.columns[name] for name in names)])
    done = 0
    while done < rows:
        part = block[: rows - done].copy()
        part[:, 0] += BLOCK_S * (done // len(block))
        yield part
        done += len(part)


def make_log(path: Path, rows: int, imu_only: bool, truth: bool) -> None:
    """The log in CSV, Parquet or JSON messages in MCAP."""
    log = _ten_minutes(imu_only, truth)
    names = [name for name in COLUMNS if name in log.columns]
    if path.suffix == ".parquet":
        import pyarrow as arrow
        from pyarrow import parquet

        schema = arrow.schema([(name, arrow.float64()) for name in ("t_s", *names)])
        with parquet.ParquetWriter(path, schema) as writer:
            for part in _parts(log, names, rows):
                arrays = [arrow.array(column, from_pandas=True) for column in part.T.copy()]
                writer.write_table(arrow.Table.from_arrays(arrays, schema=schema))
        return
    kinds = [TIME] + [GENERAL] * len(names)
    with path.open("wb") as stream:
        stream.write((",".join(["t_s", *names]) + "\n").encode())
        for part in _parts(log, names, rows):
            stream.write(table_bytes(part, kinds))


Show = Callable[[str, int, Callable[[], Any]], Any]


def _quietly(name: str, count: int, call: Callable[[], Any]) -> Any:
    return call()


def _shown(name: str, count: int, call: Callable[[], Any]) -> Any:
    began = time.process_time()
    out = call()
    took = time.process_time() - began
    print(
        f"  {name:24s} {count / took / 1e6:8.2f} million rows/s {1e6 * took / count:8.3f} us/row", flush=True
    )
    return out


def _stages(
    path: Path, rig_path: Path, ending: str, model: str, folder: Path, count: int, show: Show
) -> None:
    rig = Rig.load(rig_path)
    log = opened(path, rig, rig_path)
    setup, found = log.setup, log.periods
    estimate = estimator_for(setup, drive_for(log, rig, model), model)
    blocks = list(islice(iter_log(path), count))
    n = sum(len(block) for block in blocks)
    show(f"read {path.suffix}", n, lambda: list(islice(iter_log(path), count)))
    rows = show("rows for the filter", n, lambda: [rows_of(block, found) for block in blocks])
    outs = show("filter", n, lambda: [estimate.run(one) for one in rows])
    tally = Tally(setup.bellows_radius_m)
    truths = [truth_of(block, setup) for block in blocks]
    show("consistency", n, lambda: [tally.add(o, t) for o, t in zip(outs, truths, strict=True)])
    columns = [OUT.index(name) for name in STATES]

    def write() -> None:
        with states_writer(folder / f"part{ending}") as add:
            for out in outs:
                add(out[:, columns])

    show(f"write {ending}", n, write)


def stages(path: Path, rig: Path, ending: str, model: str, folder: Path) -> None:
    """Each stage by itself, after a first time in which numba may compile."""
    print(f"by stage, processor time, the first {FIRST_BLOCKS} blocks:")
    _stages(path, rig, ending, model, folder, 2, _quietly)
    _stages(path, rig, ending, model, folder, FIRST_BLOCKS, _shown)


def command(path: Path, rows: int, rig: Path, ending: str, model: str, folder: Path) -> None:
    """The command on a log of that many rows: wall and processor time, peak memory."""
    states = folder / f"states{ending}"
    words = ["replay", str(path), "--rig", str(rig), "-o", str(states), "--model", model]
    done = run([*CALIB, *words])
    if done.code not in (0, 1):
        raise SystemExit(f"replay: exit code {done.code}")
    into, out = path.stat().st_size / 1e6, states.stat().st_size / 1e6
    print(
        f"  {rows:>9} rows, {into:6.0f} MB in, {out:6.0f} MB out: {done.seconds:6.1f} s wall, "
        f"{done.cpu_s:6.1f} s of processor time, {rows / done.seconds / 1e3:6.0f} thousand rows/s, "
        f"peak {done.mib:5.0f} MiB",
        flush=True,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rows", type=int, default=8_640_000)
    parser.add_argument("--format", choices=("csv", "parquet"), default="csv")
    parser.add_argument("--states", choices=("csv", "parquet", "mcap"), default="csv")
    parser.add_argument("--model", choices=("auto", "kinematic", "driven"), default="auto")
    parser.add_argument("--imu", action="store_true")
    parser.add_argument("--truth", action="store_true")
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = given.folder or Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        rig = folder / "rig.yaml"
        if not rig.exists():
            make_rig(rig)
        kind = ("imu" if given.imu else "both") + ("_truth" if given.truth else "")
        logs = {n: folder / f"{kind}_{n}.{given.format}" for n in (given.rows // 10, given.rows)}
        for rows, path in logs.items():
            if not path.exists():
                make_log(path, rows, given.imu, given.truth)
        stages(logs[given.rows], rig, f".{given.states}", given.model, folder)
        print("calib replay:")
        for rows, path in logs.items():
            command(path, rows, rig, f".{given.states}", given.model, folder)


if __name__ == "__main__":
    main()
