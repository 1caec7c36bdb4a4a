"""A fleet of simulated rigs: a worker killed half-way, one process against two, memory of the client.

    python tests/bench/fleet.py [--rigs 200] [kill] [speed] [memory] [whole]

`kill` runs the fleet on two workers, kills one with SIGKILL when half of the rigs are done, and compares
every result byte for byte with that of a single run of the same verbs. `speed` prints the seconds of one
worker over twice those of two; it means something on an idle machine only, so that the load is printed.
`memory` prints the resident memory of the client after 50, 100, 200 and 2,000 tasks that answer at once.
`whole` compares a rig with logs, all stages in one process, with `calib run` on the same folder.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import _here
from _rows import CALIB, run
from fleet_processes import done, workers
from fleet_rigs import write_fleet, write_manifest

from calib.core.files import sha256
from calib.core.workers import Task, run_tasks
from calib.io.logs import log_text
from calib.runner.fleet import FleetOptions, RigSpec, calibrate_rig
from calib.runner.outcomes import Answer, Outcome, opened_store
from calib.runner.processes import local
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import run_log

PARTS = ("kill", "speed", "memory", "whole")


def _load() -> str:
    return f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors"


def _single(folder: Path, place: Path) -> bytes:
    """What the verbs leave that a person would type for this folder."""
    rig = place / f"{folder.name}.yaml"
    for words in (("intrinsics", str(folder / "images"), "--model", "radial2"), ("distortion",)):
        ended = run([*CALIB, *words, "--rig", str(rig)])
        assert ended.code in (0, 1), words
    return rig.read_bytes()


def kill(folders: list[Path], manifest: Path, place: Path) -> None:
    """Kill a worker half-way and compare all results with single runs."""
    out = place / "killed"
    began = time.monotonic()
    process = subprocess.Popen(
        [*CALIB, "fleet", str(manifest), "-o", str(out), "--workers", "2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    victim = 0
    while process.poll() is None and not victim:
        time.sleep(0.05)
        if done(out) >= len(folders) // 2:
            victim = workers(process.pid)[0]
            os.kill(victim, signal.SIGKILL)
            at = done(out)
    code = process.wait()
    seconds = time.monotonic() - began
    print(
        f"{len(folders)} rigs, 2 workers, one killed (SIGKILL) after {at}: exit code {code}, {seconds:.0f} s"
    )
    names = {path.parent.name for path in (out / "rigs").glob("*/rig.yaml")}
    print(f"  results there: {len(names)} of {len(folders)}; outcomes: {done(out)}")
    singles = place / "singles"
    singles.mkdir()
    same = sum(
        (out / "rigs" / folder.name / "rig.yaml").read_bytes() == _single(folder, singles)
        for folder in folders
    )
    print(f"  byte for byte those of single runs: {same} of {len(folders)}", flush=True)


def speed(folders: list[Path], manifest: Path, place: Path) -> None:
    """Seconds with one worker and with two, twice each and in turn."""
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for turn in range(2):
        for count in (1, 2):
            out = place / f"speed-{count}-{turn}"
            before = _load()
            ended = run([*CALIB, "fleet", str(manifest), "-o", str(out), "--workers", str(count)])
            seconds[count].append(ended.seconds)
            print(f"{len(folders)} rigs, {count} worker(s): {ended.seconds:7.1f} s ({before})", flush=True)
    one, two = min(seconds[1]), min(seconds[2])
    print(
        f"efficiency {one / (2.0 * two):.3f} (seconds of one worker over twice those of two, start included)"
    )


def trivial(number: int) -> Answer:
    """An answer as large as that of a rig."""
    text = f"rig: {number}\n" + "x" * 6000
    values = {f"camera.value{k}": (float(number + k), 0.1) for k in range(85)}
    digest = sha256(text.encode())
    outcome = Outcome(name=f"rig{number}", key="k", values=values, files={"rig.yaml": digest})
    return Answer(outcome, {"rig.yaml": text.encode()})


def _resident_MB() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return 1.024e-3 * int(line.split()[1])
    return float("nan")


def memory(place: Path) -> None:
    """Resident memory of this process, which hands out the tasks and keeps what comes of them."""
    with opened_store(place / "memory", "calib fleet", ()) as (store, _), local(2) as pool:
        first = 0
        for total in (50, 100, 200, 2000):
            tasks = (Task(f"rig{k}", trivial, (k,)) for k in range(first, total))
            began = time.monotonic()
            for _, answer in run_tasks(pool, tasks):
                store.keep(answer)
            rate = (total - first) / (time.monotonic() - began)
            first = total
            print(f"{total:5d} tasks: {_resident_MB():7.1f} MB resident, {rate:5.0f} tasks/s", flush=True)


def whole(place: Path) -> None:
    """A folder with logs: what a fleet brings back against what `calib run` leaves."""
    root, out = place / "whole", place / "run"
    shutil.copytree(_here.ROOT / "images", root / "images")
    (root / "logs").mkdir()
    for seed, (name, scenario, seconds) in enumerate((("static1", "static", 12.0), ("swing", "swing", 5.0))):
        moved = run_scenario(make_scenario(scenario), SimulatedRig(), seed, "truth", seconds)
        (root / "logs" / f"{name}.csv").write_text(log_text(run_log(moved)))
    answer = calibrate_rig(RigSpec("whole", str(root)), FleetOptions(pages=True))
    run([*CALIB, "run", str(root), "-o", str(out)])
    told = answer.outcome
    same = [name for name, data in answer.files.items() if (out / name).read_bytes() == data]
    print(f"a rig with logs: {told.status}, {told.seconds:.0f} s, {told.peak_MB} MB")
    print(
        f"  byte for byte those of calib run: {len(same)} of {len(answer.files)}, {', '.join(same)}",
        flush=True,
    )


def main() -> None:
    """Run the parts that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rigs", type=int, default=200)
    parser.add_argument("parts", nargs="*", default=[], help=", ".join(PARTS))
    asked = parser.parse_args()
    parts = asked.parts or PARTS
    with tempfile.TemporaryDirectory(prefix="fleet-") as name:
        place = Path(name)
        if "memory" in parts:
            memory(place)
        if "whole" in parts:
            whole(place)
        if "kill" in parts or "speed" in parts:
            folders = write_fleet(place / "rigs", asked.rigs)
            manifest = write_manifest(place / "manifest.csv", folders, "radial2")
            if "kill" in parts:
                kill(folders, manifest, place)
            if "speed" in parts:
                speed(folders, manifest, place)


if __name__ == "__main__":
    main()
