"""The estimator on rigs that are rendered, calibrated and aligned with the project's own commands.

    python tests/bench/rendered_rigs.py [FIRST_SEED] [COUNT] [--keep FOLDER] [--undrawn] [--off MM]

Of each rig lens, plane, latency (10 to 40 ms), mount, IMU's place, noise, biases, plant and pumps (up to 8 %
off) and the asymmetry of the pumps are drawn by its seed. Its folder is made as `calib simulate rig` does;
`calib intrinsics`, `extrinsics`, `imu static` and `align` write rig.yaml, and five other logs are replayed,
then once more after `calib identify` on the logs that were aligned. Nothing is taken from the truth but the
errors. `--keep` leaves the calibrated folders for another run, which replays only.

The marker sits where its drawing says, or off from there with the deviation `--off`. `--undrawn` says in
rig.yaml that the drawing is good to 3 mm only, so that the logs have to find the marker.

Errors are the mean over q1 and q2 in millimetres after two seconds, averaged over rigs. `told` is the
deviation that is told over the error that is made, both as roots of means of squares; NIS is a mean per
degree of freedom, with the share of rigs whose mean lies in the 95 % band of white innovations.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from drivenlogs import varied_drive
from estimatorlogs import truth_of_sensors

from calib.core.rig import Rig
from calib.io.logs import log_text
from calib.stages.align.solve import rest_angle
from calib.stages.estimator.replay import replay_log
from calib.stages.estimator.section import Replayed
from calib.twin.folder import write_rig_folder
from calib.twin.pictures import CAMERA, PLANE
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.scene import rotation
from calib.twin.sensors import View
from calib.twin.simulate import log_of

RESTS = ("static1", "static2")
ALIGNED = ("swing1", "swing2", "ellipse", "orientation")
REPLAYED = {
    "static": ("static", 15.0),
    "swing": ("swing", None),
    "ellipse": ("ellipse", None),
    "step": ("orientation", None),
    "elongation": ("elongation", None),
}
WAYS: dict[str, tuple[str, dict[str, Any]]] = {
    "thesis": ("rig.yaml", {"estimator": "baseline"}),
    "kinematic": ("rig.yaml", {"model": "kinematic"}),
    "driven": ("rig.yaml", {}),
    "smoothed": ("rig.yaml", {"smoothed": True}),
    "driven, identified": ("identified.yaml", {}),
    "smoothed, identified": ("identified.yaml", {"smoothed": True}),
}
"""The rig's file, and how a log is replayed."""
TARGET = {
    "thesis": (0.36, 0.51, 0.58, 0.75, 0.69),
    "kinematic": (0.08, 0.22, 0.15, 0.20, 0.14),
    "driven": (0.03, 0.11, 0.04, 0.06, 0.07),
    "smoothed": (0.02, 0.05, 0.025, 0.035, 0.03),
}


def drawn(seed: int, off_mm: float = 0.0) -> SimulatedRig:
    """A rig that differs from the nominal one in everything; its marker from the drawing as that allows."""
    rig = varied_drive(seed)
    rng = np.random.default_rng(9000 + seed)
    louder = float(rng.uniform(0.8, 1.25))
    imu = replace(
        rig.imu,
        gyro_noise=louder * rig.imu.gyro_noise,
        accel_noise=louder * rig.imu.accel_noise,
        lever_m=(0.0, float(rng.uniform(0.004, 0.008))),
    )
    tracker = replace(
        rig.tracker,
        marker_offset_m=0.015 + 1e-3 * off_mm * float(rng.normal()),
        jitter_px=float(rng.uniform(0.2, 0.45)),
    )
    f = float(rng.uniform(0.97, 1.05))
    bend = float(rng.uniform(0.6, 1.1))
    camera = replace(
        CAMERA,
        fx_px=CAMERA.fx_px * f,
        fy_px=CAMERA.fy_px * f * float(rng.uniform(0.997, 1.003)),
        cx_px=CAMERA.cx_px + float(rng.uniform(-4.0, 4.0)),
        cy_px=CAMERA.cy_px + float(rng.uniform(-4.0, 4.0)),
        distortion=CAMERA.distortion * bend,
    )
    tilt = rotation(*np.radians(rng.uniform(-2.0, 2.0, 3)).tolist())
    t = PLANE.t_m + rng.uniform(-2e-3, 2e-3, 3)
    return replace(rig, imu=imu, tracker=tracker, view=View(camera, tilt @ PLANE.R_CW, t))


def make(folder: Path, seed: int, off_mm: float) -> None:
    """A rig's folder as `calib simulate rig` makes it, and the logs that are replayed."""
    rig = drawn(seed, off_mm)
    write_rig_folder(folder, rig, seed)
    (folder / "replayed").mkdir()
    for k, (name, (kind, span)) in enumerate(REPLAYED.items()):
        run = run_scenario(make_scenario(kind), rig, 100_000 + 100 * seed + k, "sensors", span)
        (folder / "replayed" / f"{name}.csv").write_text(log_text(log_of(run)))


def calibrate(folder: Path, undrawn: bool) -> str:
    """The commands, and the exit codes of those that were not content."""
    rig, said = folder / "rig.yaml", []
    rests, motions = ([str(folder / "logs" / f"{name}.csv") for name in names] for names in (RESTS, ALIGNED))
    if undrawn:
        rig.write_text("geometry: {marker_offset_sigma_m: 0.003}\n")
    for words in (
        ["intrinsics", str(folder / "images")],
        ["extrinsics", str(folder / "images" / "plane")],
        ["imu", "static", *rests],
        ["align", *motions],
        ["identify", *motions],
    ):
        if words[0] == "identify":
            rig = Path(shutil.copy(rig, folder / "identified.yaml"))
        command = [sys.executable, "-c", "from calib.cli.main import main; main()", *words, "--rig", str(rig)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        (folder / f"{words[0]}.txt").write_text(done.stdout + done.stderr)
        if done.returncode > 1:
            raise SystemExit(f"{' '.join(words)}: {done.stderr}")
        if done.returncode:
            said.append(f"{words[0]} exits {done.returncode}")
    return ", ".join(said) or "all content"


def _line(found: list[Replayed]) -> str:
    errors = [one.rmse for one in found]
    mm, degrees = (np.mean([e[key] for e in errors]) for key in ("mean_q_mm", "phi_deg"))
    if "nees" not in errors[0]:
        return f"{mm:.3f} {degrees:.3f}            "
    told = np.mean([e["sigma_q1_mm"] ** 2 + e["sigma_q2_mm"] ** 2 for e in errors])
    made = np.mean([e["q1_mm"] ** 2 + e["q2_mm"] ** 2 for e in errors])
    nees = np.mean([e["nees"] for e in errors])
    return f"{mm:.3f} {degrees:.3f} {nees:5.2f} {np.sqrt(told / made):5.2f}"


def _nis(found: list[Replayed]) -> str:
    cells = []
    for name in ("camera", "accel", "gyro"):
        checks = [one.sensors[name] for one in found if name in one.sensors]
        inside = np.mean([c.low <= c.nis <= c.high for c in checks])
        cells.append(f"{np.mean([c.nis / c.degrees for c in checks]):.2f} {100.0 * inside:3.0f}%")
    return "  ".join(cells)


def misaligned(folder: Path, rig: SimulatedRig) -> tuple[float, float]:
    """How far the alignment is off: the delay [ms], and the angle that a straight head reads [deg]."""
    found = Rig.load(folder / "rig.yaml").align
    assert found is not None
    late = found.time_offset_s - rig.tracker.latency_s
    turned = found.rest_angle_rad - rest_angle(truth_of_sensors(rig))[0]
    return 1e3 * abs(late), float(np.degrees(abs(turned)))


def table(results: dict[str, dict[str, list[Replayed]]], count: int) -> None:
    """Errors by way and log, then NIS."""
    print(f"\n{f'{count} rigs':21s}" + "".join(f"{name:>28s}" for name in REPLAYED))
    print(f"{'':21s}" + f"{'mm   deg  NEES  told':>28s}" * len(REPLAYED))
    for way, by_log in results.items():
        print(f"{way:21s}" + "".join(f"{_line(found):>28s}" for found in by_log.values()))
        target = TARGET[way.partition(",")[0]]
        print(f"{'  target':21s}" + "".join(f"{value:10.3f}{'':18s}" for value in target))
    print(f"\n{'NIS / n, inside':24s}{'camera      accel      gyro':>32s}")
    for way in ("kinematic", "driven", "driven, identified"):
        for name, found in results[way].items():
            print(f"{way:18s} {name:12s}{_nis(found):>32s}", flush=True)


def main() -> None:
    """Make, calibrate, replay; print the table so far after each rig."""
    parser = argparse.ArgumentParser()
    parser.add_argument("first", nargs="?", type=int, default=1)
    parser.add_argument("count", nargs="?", type=int, default=8)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--undrawn", action="store_true")
    parser.add_argument("--off", type=float, default=0.0)
    given = parser.parse_args()
    results: dict[str, dict[str, list[Replayed]]] = {way: {name: [] for name in REPLAYED} for way in WAYS}
    off: list[tuple[float, float]] = []
    with tempfile.TemporaryDirectory() as place:
        root = given.keep or Path(place)
        for done, seed in enumerate(range(given.first, given.first + given.count), start=1):
            folder, began = root / f"rig{seed}", time.monotonic()
            said = "kept"
            if not (folder / "replayed").exists():
                make(folder, seed, given.off)
            if not (folder / "identified.yaml").exists():
                said = calibrate(folder, given.undrawn)
            off.append(misaligned(folder, drawn(seed, given.off)))
            for way, (file, how) in WAYS.items():
                path = folder / file
                rig = Rig.load(path)
                for name in REPLAYED:
                    found = replay_log(folder / "replayed" / f"{name}.csv", rig, path, **how)
                    results[way][name].append(found)
            errors = [f"{results['driven'][name][-1].rmse['mean_q_mm']:.3f}" for name in REPLAYED]
            spent = time.monotonic() - began
            print(
                f"rig {seed} ({done}/{given.count}): {said}; driven {' '.join(errors)}; {spent:.0f} s",
                flush=True,
            )
            if done % 4 == 0 or done == given.count:
                table(results, done)
                late, turned = np.max(off, axis=0)
                print(f"alignment: delay off by at most {late:.2f} ms, angle at rest by {turned:.3f} degrees")


if __name__ == "__main__":
    main()
