"""Filters on BROAD's recordings, as a script: `python tests/bench/broad.py [--no-slow]`.

First the inclination's RMSE in motion of filters by others beside what was published, which shows that
the evaluation is right; then the angle in the plane, in windows where the sensor's plane is near gravity;
then VQF and the levelling filter on the recordings as others might have made them, after 5 s and with the
truth's clock shifted by what suits each best, and begun in motion with a bias of 5 deg/s. Last the
recording of the folder imufusion, which has no truth: the largest angle to the mean force as the sensor
comes to rest, once after circles.
Recordings lie in the folder broad of CALIB_SHARED_DATA.
"""

from __future__ import annotations

import argparse

import _here  # noqa: F401
import numpy as np
from broad_trials import (
    FILES,
    PUBLISHED_DEG,
    Trial,
    filter_rmse_deg,
    late_deg,
    read_trial,
    rmse_deg,
    varied,
    windows,
)
from outside import RECORDINGS

from calib.stages.imu.levelling import Levelling, level_three
from calib.stages.imu.tracks import missing, planar_rate, run_peer


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--no-slow", action="store_true", help="leave out the peers that take seconds")
    slow = not parser.parse_known_args()[0].no_slow
    folder = RECORDINGS / "broad"
    if not folder.is_dir():
        print(f"no recordings at {folder}; set CALIB_SHARED_DATA")
        return
    for name, file in FILES.items():
        one = read_trial(folder / file)
        print(f"trial {name}, {len(one.gyro)} samples: inclination's RMSE in motion, deg")
        ups = {}
        for peer, published in PUBLISHED_DEG.items():
            if missing(peer) or (peer in ("Mahony", "Madgwick") and not slow):
                continue
            ups[peer] = run_peer(peer, one.gyro, one.force, one.period_s)
            print(f"  {peer:12} {one.inclination_deg(ups[peer]):.4f}  published {published[name]:.3f}")
        up = level_three(Levelling(), one.period_s * np.arange(len(one.gyro)), one.force, one.gyro)
        print(f"  levelling    {one.inclination_deg(up):.4f}")
        for least in (0.25, 0.5, 0.75):
            where = windows(one, up, least)
            length = sum(w.stop - w.start for w in where) * one.period_s
            tilt = np.degrees(np.arccos(np.sqrt(least)))
            print(f"  plane within {tilt:.0f} deg, {len(where)} windows, {length:.1f} s: angle's RMSE, deg")
            print(f"    MM 3/3, -gz             {filter_rmse_deg(one, -one.gyro[:, 2], where):.3f}")
            tilted = planar_rate(one.gyro, up)
            print(f"    MM 3/3, with up vector  {filter_rmse_deg(one, tilted, where):.3f}")
            phi_acc = np.arctan2(one.force[:, 1], one.force[:, 0])
            print(f"    accelerometer alone     {rmse_deg(one, phi_acc, where):.3f}")
            for peer, u in ups.items():
                print(f"    {peer:23} {rmse_deg(one, np.arctan2(u[:, 1], u[:, 0]), where):.3f}")
        if missing("VQF"):
            continue
        print("  as others might have made it                VQF levelling")
        for words, other in varied(one):
            peer_up = run_peer("VQF", other.gyro, other.force, other.period_s)
            t = other.period_s * np.arange(len(other.gyro))
            own = level_three(Levelling(), t, other.force, other.gyro)
            print(f"    {words:38} {late_deg(other, peer_up):7.3f} {late_deg(other, own):7.3f}")
        for (begin, end), (peer_deg, own_deg) in zip(SPANS_S, begun_deg(one).tolist(), strict=True):
            print(f"    begun in motion, {begin:2} to {end:2} s            {peer_deg:7.2f} {own_deg:7.2f}")
    table = np.genfromtxt(folder.parent / "imufusion" / "sensor_data.csv", delimiter=",", skip_header=1)
    t = np.arange(table[0, 0], table[-1, 0], 0.01)
    gx, gy, gz, *accel = (np.interp(t, table[:, 0], column) for column in table.T[1:7])
    gyro, force = np.radians(np.stack([gx, gy, gz], axis=1)), 9.80665 * np.stack(accel, axis=1)
    found = {"levelling": level_three(Levelling(), t, force, gyro)}
    found |= {peer: run_peer(peer, gyro, force, 0.01) for peer in ("VQF", "imufusion") if not missing(peer)}
    for name, up in found.items():
        print(
            f"imufusion's recording, as it comes to rest: {name:12} {settling_deg(force, gyro, up):.2f} deg"
        )


SPANS_S = ((1, 5), (5, 10), (10, 20), (40, 60))


def begun_deg(one: Trial) -> np.ndarray:
    """Medians (spans, 2) of the inclination's RMSE of VQF and levelling over starts in motion."""
    n, moving, rng = round(60.0 / one.period_s), np.flatnonzero(one.moving), np.random.default_rng(1)
    t, found = one.period_s * np.arange(n), []
    for begin in np.linspace(moving[0], moving[-1] - n, 20).astype(int).tolist():
        if not one.moving[begin]:
            continue
        part, bias = slice(begin, begin + n), rng.normal(size=3)
        gyro, force = one.gyro[part] + np.radians(5.0) * bias / np.linalg.norm(bias), one.force[part]
        ups = run_peer("VQF", gyro, force, one.period_s), level_three(Levelling(), t, force, gyro)
        spans = [(t >= a) & (t < b) for a, b in SPANS_S]
        found.append(
            [
                [Trial(gyro, force, one.truth[part], span, one.period_s).inclination_deg(up) for up in ups]
                for span in spans
            ]
        )
    return np.asarray(np.median(found, axis=0))


def settling_deg(force: np.ndarray, gyro: np.ndarray, up: np.ndarray) -> float:
    """Largest angle [deg] of up to the mean force in half seconds at rest that follow motion, at 100 Hz."""
    n, size = len(up) // 50, 50
    f, w = (x[: n * size].reshape(n, size, 3) for x in (force, gyro))
    still = (w.std(axis=1).max(axis=1) < 0.01) & (f.std(axis=1).max(axis=1) < 0.1)
    still &= np.abs(w.mean(axis=1)).max(axis=1) < 0.02
    first = np.flatnonzero(still[1:] & ~still[:-1]) + 1
    mean, u = f[first].mean(axis=1), up[first * size + 5]
    across = np.linalg.norm(np.cross(mean, u), axis=1)
    return float(np.degrees(np.arctan2(across, (mean * u).sum(axis=1))).max())


if __name__ == "__main__":
    main()
