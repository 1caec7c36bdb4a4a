"""The estimator on rigs that are rendered, calibrated and aligned with the project's own commands.

    python tests/bench/rendered_rigs.py [FIRST_SEED] [COUNT] [--keep FOLDER] [--undrawn] [--off MM]
                                         [--raised] [--wrong KIND]

Of each rig lens, plane, latency (10 to 40 ms), mount, IMU's place, noise, biases, plant and pumps (up to 8 %
off) and the asymmetry of the pumps are drawn by its seed. Its folder is made as `calib simulate rig` does;
`calib intrinsics`, `extrinsics`, `imu static` and `align` write rig.yaml, and five other logs are replayed,
then once more after `calib identify` on the logs that were aligned. Nothing is taken from the truth but the
errors. `--keep` leaves the calibrated folders for another run, which replays only.

The marker sits where its drawing says, or off from there, along the head and across, with the deviation
`--off`, which rig.yaml then states, as one states what a caliper tells. `--raised` moves it nearer to the
camera than the board lay, or farther from it, by a share with the deviation that `align` expects of the
plane's stretch. `--undrawn` says in rig.yaml that the drawing is good to 3 mm, so that the logs have to find
the marker. `--wrong` makes the
rigs in a way that the model does not know (`WRONG`); with `--keep` they take the pictures of the right rig.

Errors are the mean over q1 and q2 in millimetres after two seconds: their mean over rigs and their 95th
percentile, of phi in degrees that percentile, and NEES per degree of freedom, mean and largest. NIS is a mean
per degree of freedom, with the share of rigs whose mean lies in the 95 % band of white innovations. Of what
was calibrated the last table says by how much it is off, in deviations, and how often within two of them.
Mass is not identified: what scales with it is compared as a share of it.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import _here  # noqa: F401
import numpy as np
from _rows import CALIB
from drivenlogs import varied_drive
from estimatorlogs import SCENARIOS, truth_of_sensors
from scipy.spatial.transform import Rotation
from wrong_models import PLAY, RANGE_PWM, played

from calib.core.arrays import FloatArray
from calib.core.rig import Rig
from calib.io.logs import log_text
from calib.stages.actuator.identify import values_of
from calib.stages.actuator.pump import Orifice
from calib.stages.align.section import SENSORS_OF
from calib.stages.estimator.replay import replay_log
from calib.stages.estimator.section import Replayed
from calib.stages.estimator.sensors import QUANTITIES, SENSOR, rest_reading
from calib.twin.folder import LOGS, write_rig_folder
from calib.twin.pictures import CAMERA, PLANE
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import at_rest, make_scenario, run_scenario
from calib.twin.scene import rotation
from calib.twin.sensors import View
from calib.twin.simulate import run_log, simulate

RESTS = ("static1", "static2")
ALIGNED = ("swing1", "swing2", "ellipse", "orientation")
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
    "driven": (0.03, 0.10, 0.04, 0.06, 0.04),
    "smoothed": (0.02, 0.03, 0.03, 0.05, 0.03),
}
"""Of the 95th percentile, for a marker as drawn."""
TARGET_WRONG = (0.10, 0.26, 0.12, 0.15, 0.12)
WRONG = ("orifice", "hysteresis", "no creep", "heavier", "weaker")
"""Air leaves by an orifice; commands have a play of 8 % of the range; no creep; a head 25 % heavier than the
drawn one; pumps 15 % weaker."""
WITH_MASS = ("inertia", "stiffness", "bending", "lambda2", "strength", "falling")


def drawn(seed: int, off_mm: float = 0.0, wrong: str | None = None) -> SimulatedRig:
    """A rig that differs from the nominal one in everything; its marker from the drawing as that allows."""
    rig = varied_drive(seed)
    if wrong == "orifice":
        rig = replace(rig, pump=replace(rig.pump, deflation=Orifice()))
    elif wrong == "no creep":
        rig = replace(rig, plant=replace(rig.plant, creep=None))
    elif wrong == "heavier":
        rig = replace(rig, plant=replace(rig.plant, mass_kg=1.25 * rig.plant.mass_kg))
    elif wrong == "weaker":
        rig = replace(rig, strength=(0.85 * rig.strength[0], 0.85 * rig.strength[1]))
    rng = np.random.default_rng(9000 + seed)
    louder = float(rng.uniform(0.8, 1.25))
    across = float(np.random.default_rng(7000 + seed).uniform(-4e-3, 4e-3))
    imu = replace(
        rig.imu,
        gyro_noise=louder * rig.imu.gyro_noise,
        accel_noise=louder * rig.imu.accel_noise,
        lever_m=(across, float(rng.uniform(4e-3, 8e-3))),
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


def above_board(rig: SimulatedRig, seed: int) -> SimulatedRig:
    """The rig whose marker moves not quite in the plane in which the board lay."""
    share = QUANTITIES["stretch"].unaligned * float(np.random.default_rng(5000 + seed).normal())
    normal = rig.view.R_CW[:, 2]
    nearer = share * float(normal @ rig.view.t_CW_m) * normal
    return replace(rig, view=replace(rig.view, t_CW_m=rig.view.t_CW_m + nearer))


def aside(rig: SimulatedRig, seed: int, off_mm: float) -> SimulatedRig:
    """The rig whose marker sits across the head from its drawing."""
    across = 1e-3 * off_mm * float(np.random.default_rng(6000 + seed).normal())
    return replace(rig, view=replace(rig.view, t_CW_m=rig.view.t_CW_m + across * rig.view.R_CW[:, 0]))


def _log(
    rig: SimulatedRig, kind: str, options: dict[str, str], seed: int, span: float | None, play: bool
) -> str:
    run = run_scenario(make_scenario(kind, options), rig, seed, "sensors", span)
    if play and run.pwm.any():
        told = run.pwm
        run = simulate(rig, at_rest(rig), played(told, PLAY * RANGE_PWM), len(told), seed)
        run = replace(run, pwm=told)
    return log_text(run_log(run))


def make(folder: Path, seed: int, off_mm: float, raised: bool, wrong: str | None, pictures: Path) -> None:
    """A rig's folder as `calib simulate rig` makes it, and the logs that are replayed."""
    rig = drawn(seed, off_mm, wrong)
    if wrong and pictures.exists():
        shutil.copytree(pictures, folder / "images")
        (folder / "logs").mkdir()
    else:
        write_rig_folder(folder, rig, seed)
    if raised:
        rig = above_board(rig, seed)
    rig = aside(rig, seed, off_mm)
    if wrong or raised or off_mm:
        for k, name in enumerate((*RESTS, *ALIGNED)):
            text = _log(rig, *LOGS[name], 1000 * seed + k, None, wrong == "hysteresis")
            (folder / "logs" / f"{name}.csv").write_text(text)
    (folder / "replayed").mkdir()
    for k, (name, (kind, span)) in enumerate(SCENARIOS.items()):
        text = _log(rig, kind, {}, 100_000 + 100 * seed + k, span, wrong == "hysteresis")
        (folder / "replayed" / f"{name}.csv").write_text(text)


def calibrate(folder: Path, undrawn: bool, off_mm: float) -> str:
    """The commands, and the exit codes of those that were not content."""
    rig, said = folder / "rig.yaml", []
    rests, motions = ([str(folder / "logs" / f"{name}.csv") for name in names] for names in (RESTS, ALIGNED))
    if undrawn:
        rig.write_text("geometry: {marker_offset_sigma_m: 0.003}\n")
    elif off_mm:
        rig.write_text(f"geometry: {{marker_offset_m: 0.015, marker_offset_sigma_m: {1e-3 * off_mm:f}}}\n")
    for words in (
        ["intrinsics", str(folder / "images")],
        ["extrinsics", str(folder / "images" / "plane")],
        ["imu", "static", *rests],
        ["align", *motions],
        ["identify", *motions],
    ):
        if words[0] == "identify":
            rig = Path(shutil.copy(rig, folder / "identified.yaml"))
        done = subprocess.run(
            [*CALIB, *words, "--rig", str(rig)], capture_output=True, text=True, check=False
        )
        (folder / f"{words[0]}.txt").write_text(done.stdout + done.stderr)
        if done.returncode > 1:
            raise SystemExit(f"{' '.join(words)}: {done.stderr}")
        if done.returncode:
            said.append(f"{words[0]} exits {done.returncode}")
    return ", ".join(said) or "all content"


def _line(found: list[Replayed]) -> str:
    errors = [one.rmse for one in found]
    mm, degrees = (np.array([e[key] for e in errors]) for key in ("mean_q_mm", "phi_deg"))
    line = f"{mm.mean():.3f} {np.percentile(mm, 95):.3f} {np.percentile(degrees, 95):.3f}"
    if "nees" not in errors[0]:
        return f"{line}            "
    nees = 0.5 * np.array([e["nees"] for e in errors])
    return f"{line} {nees.mean():4.1f} {nees.max():5.1f}"


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
    turned = found.rest_angle_rad - rest_reading(truth_of_sensors(rig))[0][0]
    return 1e3 * abs(late), float(np.degrees(abs(turned)))


def _off(rig: Rig, true: SimulatedRig, wrong: str | None) -> dict[str, dict[str, tuple[float, float]]]:
    """By section and key the error of what was calibrated and its deviation."""
    camera, plane, align, actuator, pump = rig.camera, rig.plane, rig.align, rig.actuator, rig.pump
    assert camera and plane and align and actuator and pump
    eye, lens = true.view.camera, camera.optics
    pairs = {name: (getattr(lens, name), getattr(eye, name)) for name in ("fx_px", "fy_px", "cx_px", "cy_px")}
    pairs |= {f"k{k + 1}": (lens.distortion[k], eye.distortion[k]) for k in range(2)}
    out = {"camera": {k: (a - b, camera.sigma[k]) for k, (a, b) in pairs.items() if camera.sigma.get(k)}}
    turned = Rotation.from_matrix(np.array(plane.R_CW) @ true.view.R_CW.T).as_rotvec()
    moved = np.array(plane.t_CW_m) - true.view.t_CW_m
    out["plane"] = dict(
        zip(plane.sigma, zip([*turned, *moved], plane.sigma.values(), strict=True), strict=True)
    )
    sensors = dict(zip(SENSOR, truth_of_sensors(true).tolist(), strict=True))
    out["align"] = {}
    for key, names in SENSORS_OF.items():
        value, sigma = (np.atleast_1d(x) for x in (getattr(align, key), align.sigma.get(key, np.nan)))
        for name, v, one in zip(names, value, sigma, strict=True):
            # Plane and board are as calibrated: their errors are those of the plane.
            if name not in ("shift_x_m", "shift_y_m", "stretch"):
                out["align"][name] = (float(v) - sensors[name], float(one))
    # What the model takes for the mass, over what it is.
    share = (actuator.mass_kg or rig.machine.plant.mass_kg) / true.plant.mass_kg
    truths: dict[str, Any] = values_of(true)
    truths["play_pwm"] = PLAY * RANGE_PWM if wrong == "hysteresis" else 0.0
    truths["strength"] = [truths["strength1"], truths["strength2"]]
    for name, section in (("actuator", actuator), ("pump", pump)):
        out[name] = {}
        for key, sigma in section.sigma.items():
            if key not in truths or sigma is None or getattr(section, key) is None:
                continue
            right = np.atleast_1d(truths[key]) * (share if key.startswith(WITH_MASS) else 1.0)
            errors = np.atleast_1d(getattr(section, key)) - right
            for k, (error, one) in enumerate(zip(errors, np.atleast_1d(sigma), strict=True)):
                out[name][f"{key}{k + 1}" if len(errors) > 1 else key] = (float(error), float(one))
    return out


def coverage(rigs: list[dict[str, dict[str, tuple[float, float]]]]) -> None:
    """By section and by key: RMSE, mean deviation, and how often the error is within two deviations."""
    print(f"\n{'section':10s}{'key':32s}{'RMSE':>11s}{'sigma':>11s}{'RMS e/s':>9s}{'in 2 s':>8s}")
    for section in ("camera", "plane", "align", "actuator", "pump"):
        every: list[FloatArray] = []
        for key in rigs[0][section]:
            pairs = np.array([one[section][key] for one in rigs if key in one[section]])
            e, s = pairs.T
            every.append(e / s)
            print(
                f"{section:10s}{key:32s}{np.sqrt((e**2).mean()):11.2e}{s.mean():11.2e}"
                f"{np.sqrt(((e / s) ** 2).mean()):9.2f}{(np.abs(e) < 2.0 * s).mean():8.0%}"
            )
        z = np.concatenate(every)
        print(f"{section:10s}{'all':32s}{'':22s}{np.sqrt((z**2).mean()):9.2f}{(np.abs(z) < 2.0).mean():8.0%}")


def table(results: dict[str, dict[str, list[Replayed]]], count: int, wrong: str | None) -> None:
    """Errors by way and log, then NIS."""
    print(f"\n{f'{count} rigs':21s}" + "".join(f"{name:>32s}" for name in SCENARIOS))
    print(f"{'':21s}" + f"{'mm    95 %   deg   NEES/n max':>32s}" * len(SCENARIOS))
    for way, by_log in results.items():
        print(f"{way:21s}" + "".join(f"{_line(found):>32s}" for found in by_log.values()))
        target = TARGET_WRONG if wrong else TARGET[way.partition(",")[0]]
        print(f"{'  target':21s}" + "".join(f"{value:16.3f}{'':16s}" for value in target))
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
    parser.add_argument("--raised", action="store_true")
    parser.add_argument("--wrong", choices=WRONG)
    given = parser.parse_args()
    results: dict[str, dict[str, list[Replayed]]] = {way: {name: [] for name in SCENARIOS} for way in WAYS}
    off: list[tuple[float, float]] = []
    rigs: list[dict[str, dict[str, tuple[float, float]]]] = []
    with tempfile.TemporaryDirectory() as place:
        root = given.keep or Path(place)
        for done, seed in enumerate(range(given.first, given.first + given.count), start=1):
            right, began = root / f"rig{seed}", time.monotonic()
            folder = root / f"rig{seed}_{given.wrong.replace(' ', '_')}" if given.wrong else right
            said = "kept"
            if not (folder / "replayed").exists():
                make(folder, seed, given.off, given.raised, given.wrong, right / "images")
            if not (folder / "identified.yaml").exists():
                said = calibrate(folder, given.undrawn, given.off)
            true = drawn(seed, given.off, given.wrong)
            off.append(misaligned(folder, true))
            rigs.append(_off(Rig.load(folder / "identified.yaml"), true, given.wrong))
            for way, (file, how) in WAYS.items():
                path = folder / file
                rig = Rig.load(path)
                for name in SCENARIOS:
                    found = replay_log(folder / "replayed" / f"{name}.csv", rig, path, **how)
                    results[way][name].append(found)
            each = [results["driven, identified"][name][-1].rmse for name in SCENARIOS]
            errors = " ".join(f"{e['mean_q_mm']:.3f} ({0.5 * e['nees']:.1f})" for e in each)
            spent = time.monotonic() - began
            print(f"rig {seed} ({done}/{given.count}): {said}; driven {errors}; {spent:.0f} s", flush=True)
            if done % 4 == 0 or done == given.count:
                table(results, done, given.wrong)
                coverage(rigs)
                late, turned = np.max(off, axis=0)
                print(f"alignment: delay off by at most {late:.2f} ms, angle at rest by {turned:.3f} degrees")


if __name__ == "__main__":
    main()
