"""IMU, camera, lens, low-pass and the steady elongation (chapter 2, appendices A and B).

A function `imu_gyro_lsb` computes what the claim `imu.gyro_lsb` of thesis.yaml is judged by; `figure_2_4` the
curves of Fig. 2.4 and the values in the sentence under it.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from scipy.integrate import solve_ivp
from scipy.ndimage import median_filter
from source_model import head_from_marker, transform

from calib.core.arrays import FloatArray
from calib.core.plot import Plot
from calib.stages.actuator.kinematics import forward, marker_from_head
from calib.stages.actuator.pump import ElongationForce
from calib.stages.camera.bundle import Calibration, calibrate
from calib.stages.camera.lens import fit_inverse, pixel_grid
from calib.stages.camera.model import View, distort, pack, undistort
from calib.stages.estimator.baseline import undistorting_nothing
from calib.stages.imu.mahony import Mahony, accelerometer_angles, advance, filter_log
from calib.stages.lowpass.filters import Design, dc_delay_s, design_lowpass, filter_signal, frequency_response
from calib.twin.pictures import BOARD, CAMERA, PLANE, shots
from calib.twin.scenarios import elongation_mm
from calib.twin.scene import PrintedBoard, corner_pixels
from calib.twin.simulate import WORKSPACE_M, Run
from thesis.plot import curve
from thesis.runs import Values, angles_rad, figure, once, share_of_way_s, tried

_LOGS = range(5)
_SETTLED_S = 5.0
_ON_S = 8.0
T_OF_TWO = 4.303
"""95 % point of Student's t with two degrees of freedom: three measurements, as in the source."""

# IMU


def imu_onchip_drift() -> Values:
    drifts = [figure("onchip_drift_degps", "static", 60.0, seed=seed) for seed in _LOGS]
    return {"mean_degps": float(np.mean(drifts)), "spread_degps": float(np.std(drifts, ddof=1))}


def _filtered(run: Run, gains: Mahony) -> FloatArray:
    phi_acc = accelerometer_angles(run.sensors.accel_mps2[:, 0], run.sensors.accel_mps2[:, 1])
    return filter_log(gains, run.sensors.imu.taken_s, phi_acc, -run.sensors.gyro_radps[:, 2])[0]


def _motion_error_mrad(Kp: float, Ki: float) -> float:
    """Deviation of the filter's error while the simulated rig moves, its mean taken off."""
    run = tried("prbs", 20.0)
    error = _filtered(run, Mahony(Kp, Ki)) - angles_rad(run, run.sensors.imu.taken_s)
    return float(1e3 * np.std(error[run.sensors.imu.taken_s > _SETTLED_S]))


def imu_mm_gains() -> Values:
    grid = {(Kp, Ki): _motion_error_mrad(Kp, Ki) for Kp in (0.1, 0.3, 1.0, 3.0) for Ki in (0.003, 0.03, 0.3)}
    Kp, Ki = min(grid, key=lambda gains: grid[gains])
    printed = _motion_error_mrad(3.0, 3.0)
    return {"rms_printed_mrad": printed, "rms_best_mrad": grid[Kp, Ki], "best_Kp": Kp, "best_Ki": Ki}


def imu_mm_drift() -> Values:
    slopes = []
    for run in (tried("static", 60.0, seed=seed) for seed in _LOGS):
        late = run.sensors.imu.taken_s > _SETTLED_S
        slopes.append(np.polyfit(run.sensors.imu.taken_s[late], _filtered(run, Mahony())[late], 1)[0])
    degps = np.degrees(slopes)
    return {"mean_degps": float(degps.mean()), "largest_degps": float(np.abs(degps).max())}


def imu_gyro_lsb() -> Values:
    return {"step_degps": 2.0 * 2000.0 / 2**16, "step_of_half_the_range_degps": 2000.0 / 2**16}


def imu_acc_lsb() -> Values:
    return {"step_mps2": 2.0 * 4.0 * 9.81 / 2**12, "step_of_14_bits_mps2": 2.0 * 4.0 * 9.81 / 2**14}


def _largest_difference(dt_s: float) -> float:
    """Largest distance [rad] of (2.3) from the solution of (2.2) over 4 s of a sine with a gyro bias."""
    gains = Mahony()

    def motion(t: float) -> tuple[float, float]:
        return 0.5 * math.sin(2.0 * t) + 0.1, math.cos(2.0 * t) + 0.05

    def rates(t: float, y: FloatArray) -> list[float]:
        phi_acc, w = motion(t)
        return [gains.Kp * (phi_acc - y[0]) + y[1] + w, gains.Ki * (phi_acc - y[0])]

    times = dt_s * np.arange(1, round(4.0 / dt_s) + 1)
    exact = solve_ivp(rates, (0.0, 4.0 + dt_s), [0.0, 0.0], t_eval=times, rtol=1e-10, atol=1e-12).y[0]
    found, integral, worst = 0.0, 0.0, 0.0
    for t, phi in zip(times.tolist(), exact.tolist(), strict=True):
        found, integral = advance(found, integral, *motion(t), dt_s, gains.Kp, gains.Ki)
        worst = max(worst, abs(found - phi))
    return worst


def imu_backward_difference() -> Values:
    coarse, fine = _largest_difference(0.01), _largest_difference(0.005)
    return {"error_100hz_mrad": 1e3 * coarse, "ratio": coarse / fine}


def figure_2_4() -> tuple[Plot, Values]:
    curves = []
    for seed in _LOGS:
        run = tried("static", 60.0, seed=seed)
        t, phi = run.sensors.imu.taken_s[::20], np.degrees(run.sensors.onchip_rad[::20])
        curves.append(curve(f"log {seed + 1}", t, phi - phi[0], colour=seed))
    slopes = [figure("onchip_drift_degps", "static", 60.0, seed=seed) for seed in _LOGS]
    values: Values = {
        "mean_degps": float(np.mean(slopes)), "least_degps": min(slopes), "greatest_degps": max(slopes)
    }  # fmt: skip
    return Plot("time (s)", "change of the angle (deg)", tuple(curves)), values


def figure_2_6() -> tuple[Plot, Values]:
    run = tried("prbs", 20.0)
    t, gyro = run.sensors.imu.taken_s, -run.sensors.gyro_radps[:, 2]
    acc = accelerometer_angles(run.sensors.accel_mps2[:, 0], run.sensors.accel_mps2[:, 1])
    turned = acc[0] + np.concatenate([[0.0], np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(t))])
    kept, truth = _filtered(run, Mahony()), angles_rad(run, t)
    curves = (
        curve("accelerometer", t, acc, colour=5),
        curve("gyroscope, integrated", t, turned, colour=1),
        curve("filter", t, kept, colour=0),
        curve("truth", t, truth, "dashed", -1),
    )
    return Plot("time (s)", "angle (rad)", curves), {
        "accelerometer_mrad": float(1e3 * np.std(acc - truth)),
        "filter_mrad": float(1e3 * np.std(kept - truth)),
        "gyroscope_at_the_end_mrad": float(1e3 * (turned[-1] - truth[-1])),
    }


# Camera and lens


def cam_points() -> Values:
    inner = (6 - 1) * (8 - 1)
    return {"corners": inner, "corners_of_our_board": len(BOARD.points_m()), "points": 17 * inner}


@cache
def _corners() -> tuple[FloatArray, ...]:
    """Pixels of the corners in each of the 17 views of the stand-in camera, without noise."""
    return tuple(corner_pixels(CAMERA, PrintedBoard(BOARD), shot.pose) for shot in shots())


def _calibrated(noise_px: float, seed: int, model: str) -> Calibration:
    rng = np.random.default_rng(seed)
    views = [
        View(f"view{k}", BOARD.points_m(), pixels + noise_px * rng.standard_normal(pixels.shape))
        for k, pixels in enumerate(_corners())
    ]
    return calibrate(pack(views), CAMERA.image_size_px, model)


def cam_mean_error() -> Values:
    residuals = _calibrated(0.0, 0, "pinhole").residuals_px
    return {"mean_error_px": float(np.nanmean(np.linalg.norm(residuals, axis=2)))}


def _pinhole_pixels(A: FloatArray, plane_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (M, 2) and depths (M,) of points of the plane by s (mu, nu, 1) = A (x, y, 1)."""
    mapped = np.column_stack([plane_m, np.ones(len(plane_m))]) @ A.T
    return mapped[:, :2] / mapped[:, 2:], mapped[:, 2]


_WORKSPACE = np.stack(
    np.meshgrid(np.linspace(-0.04, 0.04, 9), np.linspace(0.06, 0.10, 5)), axis=-1
).reshape(-1, 2)  # fmt: skip
_EXTRINSIC = np.column_stack([PLANE.R_CW[:, :2], PLANE.t_m])


def cam_homography() -> Values:
    in_camera = _WORKSPACE @ PLANE.R_CW[:, :2].T + PLANE.t_m
    pixels = (in_camera / in_camera[:, 2:]) @ CAMERA.K[:2].T
    printed, right = (_pinhole_pixels(A, _WORKSPACE)[0] for A in (_EXTRINSIC, CAMERA.K @ _EXTRINSIC))
    return {
        "printed_error_px": float(np.abs(printed - pixels).max()),
        "with_K_error_px": float(np.abs(right - pixels).max()),
    }


def cam_scale() -> Values:
    A = CAMERA.K @ _EXTRINSIC
    pixels, depth = _pinhole_pixels(A, _WORKSPACE)
    back = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(A).T
    s = 1.0 / back[:, 2]
    places = np.abs(s[:, None] * back[:, :2] - _WORKSPACE)
    return {"error": max(float(np.abs(s / depth - 1.0).max()), float(places.max()))}


def cam_distortion() -> Values:
    noise_px = 0.31 / math.sqrt(0.5 * math.pi)  # the mean of Rayleigh's distribution is the printed one
    fits = np.array([_calibrated(noise_px, seed, "radial2").camera.distortion[:2] for seed in range(8)])
    (k1, k2), (sigma_k1, sigma_k2) = fits.mean(axis=0).tolist(), fits.std(axis=0, ddof=1).tolist()
    off = [abs(k1 + 0.2201) / sigma_k1, abs(k2 - 0.5494) / sigma_k2]
    return {"k1": k1, "k2": k2, "sigma_k1": sigma_k1, "sigma_k2": sigma_k2, "off_sigma": max(off)}


def cam_mustache() -> Values:
    k1, k2 = CAMERA.distortion[:2].tolist()
    corner = float(np.linalg.norm(undistort(CAMERA, np.zeros((1, 2)))))
    r = np.linspace(0.0, corner, 400)
    slopes = np.diff(distort(r, np.zeros_like(r), CAMERA.distortion)[0] - r)
    return {
        "turns_at": math.sqrt(-3.0 * k1 / (5.0 * k2)),
        "corner": corner,
        "least_slope": float(slopes.min()),
        "greatest_slope": float(slopes.max()),
    }


def _bow(k1: float) -> float:
    """How much further out a straight line's image is at its ends than at its middle."""
    x, y = np.full(3, 0.4), np.array([-0.3, 0.0, 0.3])
    xd, _ = distort(x, y, np.array([k1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    return float(xd[0] - xd[1])


def cam_naming() -> Values:
    return {"bow_positive": _bow(0.2), "bow_negative": _bow(-0.2)}


def cam_negligible() -> Values:
    width, height = CAMERA.image_size_px

    def moved(region: tuple[float, float, float, float]) -> FloatArray:
        pixels = pixel_grid(CAMERA.image_size_px, region).reshape(-1, 2)
        ideal = undistort(CAMERA, pixels) @ CAMERA.K[:2, :2].T + CAMERA.K[:2, 2]
        return np.asarray(np.linalg.norm(ideal - pixels, axis=1))

    u, v = 0.5 * (width - 1), 0.5 * (height - 1)
    middle = moved((u - 80.0, v - 60.0, u + 80.0, v + 60.0))
    anywhere = moved((0.0, 0.0, width - 1.0, height - 1.0))
    return {
        "largest_px": float(middle.max()),
        "mean_px": float(middle.mean()),
        "anywhere_px": float(anywhere.max()),
    }


def cam_no_closed_form() -> Values:
    inverse = fit_inverse(CAMERA)
    return {"coefficients": len(inverse.radial), "max_error_px": inverse.max_error_px}


def cam_offset() -> Values:
    phi, length, d = np.linspace(-1.5, 1.5, 13), np.full(13, 0.08), 0.015
    H = transform(phi, length)
    head, marker = H[:, :2, 2], (H @ np.array([0.0, d, 1.0]))[:, :2]
    there, back = marker_from_head(head, phi, d) - marker, head_from_marker(marker, phi, d) - head
    return {"error_m": float(max(np.abs(there).max(), np.abs(back).max()))}


# Low-pass, and lengths by the camera


def lp_cutoff() -> Values:
    one, two = (design_lowpass(Design(1.0, 60.0, order)).exact for order in (1, 2))
    run = tried("orientation")
    x = forward(run.states[:, :2], run.plant.bellows_radius_m)[:, 0]
    smooth = filter_signal(one, x)
    return {
        "delay_order1_s": dc_delay_s(one, 60.0),
        "delay_order2_s": dc_delay_s(two, 60.0),
        "kept_percent": float(100.0 * np.ptp(smooth) / np.ptp(x)),
        "kept_of_4hz_percent": float(100.0 * np.abs(frequency_response(one, np.array([4.0]), 60.0)[0])),
        "late_mm": float(1e3 * np.abs(smooth - x).max()),
    }


def _marker_m(run: Run) -> FloatArray:
    """Marker (n, 2) [m] in the plane as the firmware maps its pixels, held where none was found."""
    view = run.rig.view
    H = undistorting_nothing(view.camera, view.R_CW, view.t_CW_m, WORKSPACE_M)
    rows = np.column_stack([run.sensors.pixels, np.ones(len(run.sensors.pixels))]) @ H.T
    plane = rows[:, :2] / rows[:, 2:]
    at = np.maximum.accumulate(np.where(np.isfinite(plane[:, 0]), np.arange(len(plane)), 0))
    return np.asarray(plane[at])


def seen_elongation_mm(run: Run) -> FloatArray:
    """Elongation (n,) [mm] of a straight actuator as the camera shows it, wrong pictures replaced."""
    y = _marker_m(run)[:, 1] - run.rig.tracker.marker_offset_m - run.plant.rest_length_m
    # A wrong picture stands 3 mm and more away from those on both sides of it.
    near = median_filter(y, 9, mode="nearest")
    return np.asarray(1e3 * np.where(np.abs(y - near) > 3e-3, near, y))


def figure_2_10() -> tuple[Plot, Values]:
    run = tried("orientation", 8.0)
    x = _marker_m(run)[:, 0]
    low = design_lowpass(Design(1.0, 60.0, 1)).exact
    smooth = filter_signal(low, x)
    held = (run.t_s >= 3.0) & (run.t_s < 5.0)
    rough, fine = (float(1e3 * np.std(np.diff(v[held]))) for v in (x, smooth))
    curves = (
        curve("from the camera", run.t_s, 1e3 * x, colour=0),
        curve("after the low-pass", run.t_s, 1e3 * smooth, colour=1),
    )
    values: Values = {"rough_mm": rough, "fine_mm": fine, "delay_ms": 1e3 * dc_delay_s(low, 60.0)}
    return Plot("time (s)", "x of the marker (mm)", curves), values


def _step(volt: float, seed: int) -> Run:
    """Both motors at a voltage for 8 s."""
    return tried("deflate", _ON_S, seed=seed, volt=str(volt), off_at_s="100")


@once
def steady_elongations_mm() -> tuple[FloatArray, FloatArray]:
    """Voltages (n,) and elongations (n, 3) [mm] by the camera after 7.5 s, three runs each."""
    volts = np.arange(4.0, 13.0)
    late = round(7.5 * 60)
    return volts, np.array(
        [[np.nanmean(seen_elongation_mm(_step(v, seed))[late:]) for seed in range(3)] for v in volts.tolist()]
    )


def figure_2_11() -> tuple[Plot, Values]:
    volts, lengths = steady_elongations_mm()
    mean, spread = lengths.mean(axis=1), T_OF_TWO * lengths.std(axis=1, ddof=1) / math.sqrt(3)
    active, fine = volts >= 4.7, np.linspace(4.7, 12.0, 120)
    cubic = np.polyfit(volts[active], mean[active], 3)
    text = np.asarray(np.polyval(ElongationForce().elongation_mm, fine))
    curves = (
        curve("mean of three runs, 95 %", volts, mean, "points", -1, spread),
        curve("cubic through them", fine, np.asarray(np.polyval(cubic, fine)), colour=0),
        curve("(2.13) with 3.756 for 3.376", fine, text, "dashed", 1),
    )
    values: Values = {"at_12V_mm": float(mean[-1]), "at_4V_mm": float(mean[0]), "cubic_u3": float(cubic[0])}
    return Plot("motor input (V)", "elongation (mm)", curves), values


def figure_2_12() -> tuple[Plot, Values]:
    curves, values = [], {}
    for k, volt in enumerate((6.0, 8.0, 10.0, 12.0)):
        run = _step(volt, k)
        curves.append(curve(f"{volt:g} V", run.t_s, seen_elongation_mm(run), colour=k))
        values[f"to_63_percent_{volt:g}V_s"] = share_of_way_s(run, elongation_mm(run), 1.0 - math.exp(-1.0))
    return Plot("time (s)", "elongation (mm)", tuple(curves)), values
