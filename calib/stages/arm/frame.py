"""How motion capture of an arm is to be read, and trials on a regular grid in that frame.

The tip's rotation in the frame of the base turns about one axis a where the motion is planar: the direction
of the largest spread of the rotation vectors from a recording's mean pose to its others. The tip's body
may be mounted in any way, q = exp(phi a / 2) m; a turn at the start that no resting arm has is m, taken off.
The angle is the twist about the axis, 2 atan2(q . a, q_w), and grows with bending.
A quaternion that maps the world to the body instead of the body to the world turns against the chord from
base to tip.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.core.arrays import BoolArray, FloatArray
from calib.core.errors import BadInputError
from calib.core.verdict import Finding
from calib.stages.arm.model import STEP_S, Trial
from calib.stages.arm.recording import Recording, span

_MOUNTED_RAD = math.radians(60.0)
"""A turn at the start that is a body's mount: no arm rests so far bent."""
_TILTED_RAD = math.radians(5.0)
_LEAST_TURN_RAD = math.radians(0.5)
_PLANE = 5.0
"""Times its thickness that the path of a tip is wide, where it tells a plane."""
_NO_PLANE_RAD = math.radians(45.0)
_LEANS = (0.1, 1.0)
"""Turn of the chord over the tip's: a half of an arc, more with a stiff end, less with a stiff beginning."""
_UNSEEN_S = 0.3
"""Gaps over which poses are not counted."""
_TURNED_OFF_RAD = math.radians(45.0)
_GROWS_STEP_S, _GROWS_S = 0.1, 1.0
"""The lag: of 3000 simulated arms with lags of .1 to 10 s it gets the fewest signs wrong, of .3 to 4 s."""


@dataclass(frozen=True)
class Frame:
    """How motion capture is to be read.

    Attributes
    ----------
    axis : (3,) of the bending, in the frame of the base; None for poses in the plane.
    grows, zero_rad : sign with which the angles of poses in the plane grow with bending, and from what they
        are counted.
    mount : (3,) rotation vector of the tip's body that is taken off in the frame of the base; 0 of one that
        starts near the base's attitude.
    conjugated : whether quaternions map the world to the body.
    leans : turn of the chord over that of the tip.
    planar_deg : angle between the axis and the normal of the tip's path.
    direction : (3,) from base to tip of the straight arm, in the frame of the base.
    """

    axis: FloatArray | None
    grows: float = 1.0
    zero_rad: float = 0.0
    mount: Sequence[float] = (0.0, 0.0, 0.0)
    conjugated: bool = False
    leans: float = math.nan
    planar_deg: float = math.nan
    direction: FloatArray | None = None


def fit_frame(recordings: Sequence[Recording]) -> Frame:
    """The axis of bending, the quaternions' convention and the straight arm's direction.

    Of the two conventions that one is taken under which tip and chord turn the same way about the same axis.

    Raises `BadInputError` where the tip hardly turns.
    """
    planar = [one for one in recordings if one.planar is not None]
    angles = [one.planar[:, 0] for one in planar if one.planar is not None]
    sign, zero = 1.0, 0.0
    if angles:
        begin = _circular_mean(np.array([_initial_angle(one) for one in angles]))
        zero = begin if abs(begin) > _MOUNTED_RAD else 0.0
        sign = _growth_sign(planar, [_continuous(one, zero) for one in angles])
    if all(one.turned is None for one in recordings):
        return Frame(None, sign, zero)
    frames = [_fit_frame_under(recordings, conjugated) for conjugated in (False, True)]
    # A body that is mounted by half a turn looks the same either way.
    best = max(
        frames, key=lambda one: round(math.copysign(math.cos(math.radians(one.planar_deg)), one.leans), 2)
    )
    return replace(best, grows=sign, zero_rad=zero)


def _fit_frame_under(recordings: Sequence[Recording], conjugated: bool) -> Frame:
    """The frame under one convention, with a negative `leans` where the tip turns against its chord."""
    posed = [one for one in recordings if one.turned is not None and one.chord is not None]
    turned = [one.turned[int(conjugated)] for one in posed if one.turned is not None]
    chords = [one.chord[int(conjugated)] for one in posed if one.chord is not None]
    seen = [
        np.isfinite(q).all(axis=1) & np.isfinite(c).all(axis=1) for q, c in zip(turned, chords, strict=True)
    ]
    rotations = [q[rows] for q, rows in zip(turned, seen, strict=True)]
    chords = [c[rows] for c, rows in zip(chords, seen, strict=True)]
    axis, rms_rad = _bending_axis(rotations)
    if rms_rad < _LEAST_TURN_RAD:
        raise BadInputError(
            f"{recordings[0].source}: the tip turns by {math.degrees(rms_rad):.2g} deg (RMS), expected the "
            f"arm to bend by {math.degrees(_LEAST_TURN_RAD):g} deg at least"
        )
    mount, normal = _mount(rotations), _path_normal(chords, axis)
    planar = math.degrees(math.acos(min(abs(float(axis @ normal)), 1.0)))
    # Turn of the chord about the path's normal, against the tip's.
    chord = np.concatenate(chords)
    first = np.median(chord[: max(len(chord) // 100, 1)], axis=0)
    first = first - normal * (first @ normal)
    normal = normal if normal @ axis > 0.0 else -normal
    side = np.cross(normal, first)
    heading = np.arctan2(chord @ side, chord @ first)
    leans, offset = np.polyfit(np.concatenate([_twist(q, axis, mount) for q in rotations]), heading, 1)
    straight = first * math.cos(offset) + side * math.sin(offset)
    # The angle grows with bending, whatever way that is.
    sign = _growth_sign(posed, [_twist(q, axis, mount) for q in turned])
    return Frame(
        sign * axis,
        mount=mount.tolist(),
        conjugated=conjugated,
        leans=float(leans),
        planar_deg=planar,
        direction=straight / np.linalg.norm(straight),
    )


def _bending_axis(rotations: Sequence[FloatArray]) -> tuple[FloatArray, float]:
    """Axis (3,) about which the rotations (n, 4) of each recording turn most, and their RMS about it."""
    from scipy.spatial.transform import Rotation

    vectors = []
    for one in map(Rotation.from_quat, rotations):
        away = (one * one.mean().inv()).as_rotvec()
        vectors.append(away - away.mean(axis=0))
    values, axes = np.linalg.eigh(np.cov(np.concatenate(vectors).T))
    return axes[:, -1], math.sqrt(values[-1])


def _mount(rotations: Sequence[FloatArray]) -> FloatArray:
    """Rotation vector (3,) of the mount of the tip's body: the mean turn at the starts, 0 of a small one."""
    from scipy.spatial.transform import Rotation

    starts = [Rotation.from_quat(one[: max(len(one) // 100, 1)]).mean() for one in rotations]
    begin = np.asarray(Rotation.concatenate(starts).mean().as_rotvec())
    return begin if np.linalg.norm(begin) > _MOUNTED_RAD else np.zeros(3)


def _path_normal(chords: Sequence[FloatArray], axis: FloatArray) -> FloatArray:
    """Normal (3,) of the plane in which the tip's path lies; that nearest to the axis of a straight path."""
    # About each recording's own middle, as the base's marker may be moved between days.
    wide, paths = np.linalg.eigh(np.cov(np.concatenate([one - one.mean(axis=0) for one in chords]).T))
    if wide[1] >= _PLANE**2 * wide[0]:
        return np.asarray(paths[:, 0])
    normal = axis - paths[:, 2] * (paths[:, 2] @ axis)
    return np.asarray(normal / np.linalg.norm(normal))


def _twist(turned: FloatArray, axis: FloatArray, mount: FloatArray | Sequence[float]) -> FloatArray:
    """Angle (n,) [rad] about an axis (3,) of rotations (n, 4) from a mount (3,), NaN where they are."""
    from scipy.spatial.transform import Rotation

    seen = np.isfinite(turned).all(axis=1)
    q = (Rotation.from_quat(turned[seen]) * Rotation.from_rotvec(mount).inv()).as_quat()
    out = np.full(len(turned), np.nan)
    out[seen] = 2.0 * np.arctan2(q[:, :3] @ axis, q[:, 3])
    return _continuous(out)


def _circular_mean(angles_rad: FloatArray) -> float:
    return float(np.angle(np.nanmean(np.exp(1j * angles_rad))))


def _continuous(angles_rad: FloatArray, zero_rad: float = 0.0) -> FloatArray:
    """Angles (n,) from a zero, on one turn that is cut where most of it is empty, the first ones near 0."""
    on_turn = np.remainder(angles_rad[np.isfinite(angles_rad)], math.tau)
    if not len(on_turn):
        return angles_rad
    around = np.sort(on_turn)
    empty = np.diff(around, append=around[0] + math.tau)
    cut = float(around[np.argmax(empty)] + 0.5 * empty.max())
    out = cut - zero_rad + np.remainder(angles_rad - cut, math.tau)
    return np.asarray(out - math.tau * round(_initial_angle(out) / math.tau))


def _initial_angle(angles_rad: FloatArray) -> float:
    """Median of the first hundredth of the angles (n,) that are there."""
    seen = angles_rad[np.isfinite(angles_rad)]
    return float(np.median(seen[: max(len(seen) // 100, 1)])) if len(seen) else 0.0


def _growth_sign(recordings: Sequence[Recording], angles_rad: Sequence[FloatArray]) -> float:
    """The sign with which the angles (n,) of each recording grow with a lag of what drives the arm."""
    from scipy.signal import lfilter

    alike, decay = 0.0, math.exp(-_GROWS_STEP_S / _GROWS_S)
    for one, angles in zip(recordings, angles_rad, strict=True):
        grid = np.arange(one.t_s[0], one.t_s[-1], _GROWS_STEP_S)
        drive = one.command if one.pressure is None else one.pressure
        if drive is not None and np.isfinite(drive).any() and np.isfinite(angles).any():
            cause, effect = (_interpolated(grid, one.t_s, x - np.nanmean(x)) for x in (drive, angles))
            alike += float(lfilter([1.0 - decay], [1.0, -decay], cause) @ effect)
    return -1.0 if alike < 0.0 else 1.0


def check_frame(recordings: Sequence[Recording], frame: Frame) -> None:
    """Raise `BadInputError` for poses that turn about another axis than that of an identified arm."""
    for one in recordings:
        if frame.axis is None or one.turned is None:
            continue
        angles = _twist(one.turned[int(frame.conjugated)], frame.axis, frame.mount)
        if span(angles) < 4.0 * _LEAST_TURN_RAD:
            continue
        axis = _fit_frame_under([one], frame.conjugated).axis
        off = 0.0 if axis is None else math.acos(min(max(float(axis @ frame.axis), -1.0), 1.0))
        if off > _TURNED_OFF_RAD:
            raise BadInputError(
                f"{one.source}: its tip turns about an axis {math.degrees(off):.0f} deg from that of the arm "
                "in the rig's file, expected the same arm and motion capture: look at the quaternions' order "
                "and convention"
            )


def frame_findings(frame: Frame) -> Iterator[Finding]:
    """What the poses show of the arm and of the motion capture, in sentences."""
    if frame.grows < 0.0:
        yield Finding(
            "remark", "tip_phi_rad falls as the arm bends; the angle is counted as it grows with bending"
        )
    mounted = max(abs(frame.zero_rad), float(np.linalg.norm(frame.mount)))
    if mounted > 0.0:
        yield Finding(
            "remark",
            f"the tip starts turned by {math.degrees(mounted):.0f} deg against the base, as it is mounted: "
            "the angle counts from there",
        )
    if frame.axis is None or frame.direction is None:
        return
    x, y, z = frame.axis
    u, v, w = frame.direction
    yield Finding(
        "remark",
        f"bends about ({x:z.2f}, {y:z.2f}, {z:z.2f}) of the base, straight it points along "
        f"({u:z.2f}, {v:z.2f}, {w:z.2f}); the chord turns by {abs(frame.leans):.2f} of the tip's angle",
    )
    stands = f"the axis of bending stands {frame.planar_deg:.0f} deg off the normal of the tip's path"
    if not _LEANS[0] < abs(frame.leans) < _LEANS[1]:
        yield Finding(
            "poor",
            f"the chord turns by {abs(frame.leans):.2f} of the tip's angle, expected about half of it",
            "look whether base and tip are swapped, and whether their quaternions are of one convention",
        )
    if math.radians(frame.planar_deg) > _NO_PLANE_RAD:
        advice = "look at the order of the quaternions, w first, and at the axes of base and tip"
        yield Finding("inconsistent", stands, advice)
    elif math.radians(frame.planar_deg) > _TILTED_RAD:
        yield Finding(
            "remark",
            f"{stands}: the tip's marker twists or base and world are tilted; the angle is the part about "
            "the axis",
        )
    if frame.conjugated:
        yield Finding(
            "remark",
            "the tip turns against its chord: quaternions look conjugated (world to body); the angle is "
            "counted as it grows with bending",
        )


def resample_trial(recording: Recording, frame: Frame, day: str, load_kg: float) -> Trial:
    """The recording on the grid: commands as means over the steps, readings between their neighbours.

    Raises `BadInputError` where nothing but a command was logged.
    """
    t = recording.t_s
    grid = np.arange(t[0], t[-1] - STEP_S, STEP_S)
    none = np.zeros(0)
    pressure = none if recording.pressure is None else _interpolated(grid, t, recording.pressure)
    angle = chord = none
    unseen = None
    if recording.turned is not None and recording.chord is not None and frame.axis is not None:
        turned = recording.turned[int(frame.conjugated)]
        angle = _interpolated(grid, t, _twist(turned, frame.axis, frame.mount))
        chord = _interpolated(grid, t, np.linalg.norm(recording.chord[0], axis=1))
        unseen = _between_far_poses(grid, t, turned)
    elif recording.planar is not None:
        angles, chords = recording.planar.T
        angle = frame.grows * _interpolated(grid, t, _continuous(angles, frame.zero_rad))
        chord = _interpolated(grid, t, chords)
        unseen = _between_far_poses(grid, t, recording.planar)
    command = none if recording.command is None else _means(grid, t, recording.command)
    if not len(pressure) and not len(angle):
        raise BadInputError(f"{recording.source}: has neither pressure nor pose, expected one of them")
    rest = (grid - grid[0], command, pressure, angle, chord, recording.pwm, unseen)
    return Trial(recording.name, day, load_kg, *rest)


def _between_far_poses(grid: FloatArray, t: FloatArray, poses: FloatArray) -> BoolArray | None:
    """Places of the grid (n,) between poses (m, k) that are far apart; None without any."""
    at = t[np.isfinite(poses).all(axis=1)]
    if len(at) < 2:
        return None
    after = np.clip(np.searchsorted(at, grid), 1, len(at) - 1)
    far = (at[after] - at[after - 1] > _UNSEEN_S) | (grid < at[0]) | (grid > at[-1])
    return far if far.any() else None


def _interpolated(grid: FloatArray, t: FloatArray, values: FloatArray) -> FloatArray:
    seen = np.isfinite(values)
    return np.interp(grid, t[seen], values[seen]) if seen.any() else np.zeros(0)


def _means(grid: FloatArray, t: FloatArray, values: FloatArray) -> FloatArray:
    """Means over the grid's steps of a signal that is held from sample to sample."""
    seen = np.isfinite(values)
    if not seen.any():
        return np.zeros(0)
    t, values = t[seen], values[seen]
    integral = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(t))])
    edges = np.append(grid, grid[-1] + STEP_S)
    return np.asarray(np.diff(np.interp(edges, t, integral)) / STEP_S)
