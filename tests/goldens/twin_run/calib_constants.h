/*
 * calib_constants.h - constants of one rig, written by calib <version>. Do not edit.
 *
 * SHA-256 of the values: <hash>
 * input actuator/ellipse.csv: <hash>
 * input actuator/steps.csv: <hash>
 * input actuator/swing1.csv: <hash>
 * input align/ellipse.csv: <hash>
 * input align/steps.csv: <hash>
 * input align/swing1.csv: <hash>
 * input camera/board.yaml: <hash>
 * input camera/view01.png: <hash>
 * input camera/view02.png: <hash>
 * input camera/view03.png: <hash>
 * input camera/view04.png: <hash>
 * input camera/view05.png: <hash>
 * input camera/view06.png: <hash>
 * input camera/view07.png: <hash>
 * input camera/view08.png: <hash>
 * input camera/view09.png: <hash>
 * input camera/view10.png: <hash>
 * input camera/view11.png: <hash>
 * input camera/view12.png: <hash>
 * input camera/view13.png: <hash>
 * input camera/view14.png: <hash>
 * input camera/view15.png: <hash>
 * input camera/view16.png: <hash>
 * input camera/view17.png: <hash>
 * input imu/static1.csv: <hash>
 * input lowpass/ellipse.csv: <hash>
 * input orientation_filter/ellipse.csv: <hash>
 * input orientation_filter/steps.csv: <hash>
 * input orientation_filter/swing1.csv: <hash>
 * input plane/board.yaml: <hash>
 * input plane/plane01.png: <hash>
 * input pump/ellipse.csv: <hash>
 * input pump/steps.csv: <hash>
 * input pump/swing1.csv: <hash>
 * camera: radial2, verdict ok
 * plane: verdict ok
 * Not in rig.yaml, so the nominal actuator's or a default:
 *   actuator.bellows_radius_m, envelope.least_length_m, envelope.greatest_length_m, envelope.angle_rad,
 *   envelope.rate_mps, envelope.full_power_s, envelope.open_loop_s, envelope.open_loop_pwm, envelope.apart_m
 *
 * Pixels: (0, 0) is the centre of the top-left pixel, u right, v down. World: metres, x right and y
 * down in the picture, z away from the camera. phi > 0 bends the head towards +x. Numbers in brackets are
 * equations of the source, SI units inside, PWM from 0 to 255.
 *
 * Checks that a program may ask for, before it includes this file:
 *   CALIB_EXPECT_SCHEMA            what the names and units below mean
 *   CALIB_EXPECT_TICK_RATE_MHZ     the program's control rate in millihertz
 *   CALIB_EXPECT_PUMP_HIGH         the greatest PWM value that its pumps stand
 * CALIB_PROGMEM, when defined, puts the tables into the flash of an AVR.
 */
#ifndef CALIB_CONSTANTS_H
#define CALIB_CONSTANTS_H

#include <float.h>

#if FLT_RADIX != 2 || FLT_MANT_DIG != 24 || FLT_MAX_EXP != 128 || FLT_MIN_EXP != -125
#error "calib: float has to be IEEE 754 binary32"
#endif

#if defined(CALIB_PROGMEM) && defined(__AVR__)
#include <avr/pgmspace.h>
#define CALIB_IN_FLASH PROGMEM
#define CALIB_TABLE_READ(address) pgm_read_float(address)
#define CALIB_WORD_READ(address) pgm_read_word(address)
#else
#define CALIB_IN_FLASH
#define CALIB_TABLE_READ(address) (*(address))
#define CALIB_WORD_READ(address) (*(address))
#endif

#define CALIB_SCHEMA 8
#if defined(CALIB_EXPECT_SCHEMA)
#if CALIB_EXPECT_SCHEMA != CALIB_SCHEMA
#error "calib: this header has another schema than the code expects"
#endif
#endif

/* First 32 bits of the SHA-256 of the values, to tell calibrations apart in telemetry. */
#define CALIB_ID 0xEBAC290DUL

/* Whether these constants may drive a rig. The guard compiles for a board only where they may. */
#define CALIB_RIG_OK 0 /* 0: a section that they come from is not ok, or no controller is tuned */
#define CALIB_SIMULATED 1 /* 1: they come from a simulated rig or rendered pictures */

/* Camera (2.5) and lens (B.1), for programs of your own; the pipeline reads SKEW, CX, CY and P1, P2 of them. */
#define CALIB_IMAGE_WIDTH_PX 316 /* columns */
#define CALIB_IMAGE_HEIGHT_PX 208 /* rows */
#define CALIB_CAMERA_OK 1 /* 0: the calibration failed its gate */
#define CALIB_CAMERA_FX_PX 273.425446f /* focal length along u, px; sigma_mu of (2.5) */
#define CALIB_CAMERA_FY_PX 272.617584f /* focal length along v, px; sigma_nu of (2.5) */
#define CALIB_CAMERA_SKEW_PX 0.0f /* skew, px; gamma of (2.5) */
#define CALIB_CAMERA_CX_PX 160.668671f /* principal point, px from the centre of the left column; mu_0 of (2.5) */
#define CALIB_CAMERA_CY_PX 101.862625f /* principal point, px from the centre of the top row; nu_0 of (2.5) */
#define CALIB_CAMERA_K1 -0.220030725f /* lens, dimensionless, OpenCV's order and signs */
#define CALIB_CAMERA_K2 0.549458385f /* lens, dimensionless, OpenCV's order and signs */

/*
 * Inverse lens, normalised coordinates: yd = (v - cy) / fy, xd = (u - cx - skew yd) / fx, then
 * x = xd P, y = yd P with P = 1 + c1 r2 + c2 r2^2 + ..., r2 = xd^2 + yd^2.
 * Error at most 0.0012 px over 100 % of the picture.
 */
#define CALIB_CAMERA_GREATEST_U_PX 315.5f /* greatest u inside the picture, px; the least is -0.5 */
#define CALIB_CAMERA_GREATEST_V_PX 207.5f /* greatest v inside the picture, px; the least is -0.5 */
#define CALIB_CAMERA_HAS_LENS 1 /* 0: no distortion, default of CALIB_UNDISTORT */
#define CALIB_CAMERA_HAS_SKEW 0 /* for #if */
#define CALIB_CAMERA_PER_FX 0.00365730398f /* 1 / fx, 1/px */
#define CALIB_CAMERA_PER_FY 0.00366814202f /* 1 / fy, 1/px */
#define CALIB_LENS_INVERSE_ORDER 5 /* number of coefficients c */
#define CALIB_LENS_DECENTERING_STEPS 0 /* 0: no decentering */
#define CALIB_LENS_INVERSE_C1 0.217699483f /* coefficient of r2^1, dimensionless */
#define CALIB_LENS_INVERSE_C2 -0.333819926f /* coefficient of r2^2, dimensionless */
#define CALIB_LENS_INVERSE_C3 -1.56958032f /* coefficient of r2^3, dimensionless */
#define CALIB_LENS_INVERSE_C4 3.43781137f /* coefficient of r2^4, dimensionless */
#define CALIB_LENS_INVERSE_C5 -2.06487918f /* coefficient of r2^5, dimensionless */
#define CALIB_LENS_INVERSE_P(r2) (1.0f + (r2) * (CALIB_LENS_INVERSE_C1 + (r2) * (CALIB_LENS_INVERSE_C2 + (r2) * (CALIB_LENS_INVERSE_C3 + (r2) * (CALIB_LENS_INVERSE_C4 + (r2) * (CALIB_LENS_INVERSE_C5)))))) /* P by Horner's scheme */

/* Plane of the actuator, without the shift and stretch that align has found. */
#define CALIB_HAS_PLANE 1 /* for #if */
#define CALIB_PLANE_OK 1 /* 0: the plane failed its gate */
#define CALIB_PLANE_INVERSE_11 0.00365899922f /* row 1, A^-1, undistorted px to m; (2.11), for programs of your own */
#define CALIB_PLANE_INVERSE_12 -8.85197514e-05f /* row 1, A^-1, undistorted px to m; (2.11), for programs of your own */
#define CALIB_PLANE_INVERSE_13 -0.599090099f /* row 1, A^-1, undistorted px to m; (2.11), for programs of your own */
#define CALIB_PLANE_INVERSE_21 7.93372237e-05f /* row 2, A^-1, undistorted px to m; (2.11), for programs of your own */
#define CALIB_PLANE_INVERSE_22 0.00362189324f /* row 2, A^-1, undistorted px to m; (2.11), for programs of your own */
#define CALIB_PLANE_INVERSE_23 -0.160745054f /* row 2, A^-1, undistorted px to m; (2.11), for programs of your own */
#define CALIB_PLANE_INVERSE_31 -0.000316923106f /* row 3, A^-1, undistorted px to m; (2.11), for programs of your own */
#define CALIB_PLANE_INVERSE_32 -0.000871971366f /* row 3, A^-1, undistorted px to m; (2.11), for programs of your own */
#define CALIB_PLANE_INVERSE_33 3.76387095f /* row 3, A^-1, undistorted px to m; (2.11), for programs of your own */

/*
 * The same from normalised undistorted coordinates, for CALIB_UNDISTORT 1. Row 3 gives 1/s of (2.12) in 1/m, the
 * reciprocal depth.
 */
#define CALIB_PLANE_NORMALISED_11 1.00046349f /* row 1, A^-1 K, dimensionless to m */
#define CALIB_PLANE_NORMALISED_12 -0.0241320413f /* row 1, A^-1 K, dimensionless to m */
#define CALIB_PLANE_NORMALISED_13 -0.0202203915f /* row 1, A^-1 K, dimensionless to m */
#define CALIB_PLANE_NORMALISED_21 0.0216928162f /* row 2, A^-1 K, dimensionless to m */
#define CALIB_PLANE_NORMALISED_22 0.98739177f /* row 2, A^-1 K, dimensionless to m */
#define CALIB_PLANE_NORMALISED_23 0.220937535f /* row 2, A^-1 K, dimensionless to m */
#define CALIB_PLANE_NORMALISED_31 -0.0866548419f /* row 3, A^-1 K, dimensionless to m */
#define CALIB_PLANE_NORMALISED_32 -0.237714723f /* row 3, A^-1 K, dimensionless to m */
#define CALIB_PLANE_NORMALISED_33 3.62413001f /* row 3, A^-1 K, dimensionless to m */
#define CALIB_PLANE_LEAST_PER_M 0.356356561f /* 1/s below this: behind the horizon, 1/m */

/*
 * The same from pixels as the camera reports them, fitted over the workspace, for
 * CALIB_UNDISTORT 0. Neglecting the lens costs up to 0.331 mm there.
 */
#define CALIB_HAS_RAW_PLANE 1 /* 0: the workspace is not in sight */
#define CALIB_PLANE_RAW_11 0.0036909862f /* row 1, distorted px to m */
#define CALIB_PLANE_RAW_12 -8.82955937e-05f /* row 1, distorted px to m */
#define CALIB_PLANE_RAW_13 -0.6043576f /* row 1, distorted px to m */
#define CALIB_PLANE_RAW_21 7.22166224e-05f /* row 2, distorted px to m */
#define CALIB_PLANE_RAW_22 0.0036320691f /* row 2, distorted px to m */
#define CALIB_PLANE_RAW_23 -0.160445794f /* row 2, distorted px to m */
#define CALIB_PLANE_RAW_31 -0.000437254144f /* row 3, distorted px to m */
#define CALIB_PLANE_RAW_32 -0.00111405493f /* row 3, distorted px to m */
#define CALIB_PLANE_RAW_33 3.81176996f /* row 3, distorted px to m */
#define CALIB_PLANE_RAW_LEAST_PER_M 0.354941338f /* 1/s below this: behind the horizon, 1/m */

/* The tick: one picture, one sample of the IMU, one command. */
#define CALIB_TICK_RATE_HZ 60.0f /* ticks per second, Hz */
#define CALIB_TICK_RATE_MHZ 60000 /* the same in millihertz, for #if */
#define CALIB_HOLD_TICKS 60 /* a sensor that is silent for longer, a second, stops the pumps */
#define CALIB_TIME_OFFSET_TICKS 2 /* ceil(D), for D ticks by which a picture is later than the IMU */
#define CALIB_TIME_OFFSET_PART 0.486951441f /* ceil(D) - D, share of a tick */

/*
 * IMU on the head, x from the head to the base at rest; phi = atan2(RATIO ay, ax) - mount (2.1),
 * dphi/dt = -gz. The signs of the axes are geometry.imu_sign of rig.yaml.
 */
#define CALIB_IMU_SIGN_AX 1 /* 1 or -1, of ax as the sensor gives it */
#define CALIB_IMU_SIGN_AY 1 /* 1 or -1, of ay */
#define CALIB_IMU_SIGN_GZ 1 /* 1 or -1, of gz */
#define CALIB_IMU_ACCEL_BIAS_X_MPS2 0.0821365044f /* subtracted from ax, m/s^2 */
#define CALIB_IMU_ACCEL_BIAS_Y_MPS2 -0.0316917934f /* subtracted from ay, m/s^2 */
#define CALIB_IMU_ACCEL_RATIO 1.00137293f /* of ay less its bias: (1 + scale of x) / (1 + scale of y) */
#define CALIB_IMU_GYRO_BIAS_RADPS 0.00599094806f /* gz at rest, rad/s; sign as read; for programs of your own */
#define CALIB_IMU_MOUNT_ANGLE_RAD 0.0185177512f /* atan2(RATIO ay, ax) at rest at phi = 0, subtracted, rad, -pi to pi */
#define CALIB_IMU_ACCEL_LIMIT_MPS2 157.0f /* readings beyond are lost, m/s^2 */
#define CALIB_IMU_RATE_LIMIT_RADPS 35.0f /* readings beyond are lost, rad/s */
#define CALIB_IMU_ACCEL_WEAK_MPS2 1.0f /* |ax| and |ay| below say nothing of phi, m/s^2 */

/* Angle filter: (2.3). */
#define CALIB_LEVELLING 0 /* 1: the levelling filter, for #if */

/*
 * Angle filter (2.3), dt folded in. The integral is kept as an angle per tick, J = I dt:
 * J += KI_DT2 e, phi += KP_DT e + J - DT gz; J begins at GYRO_BIAS_DT.
 */
#define CALIB_MM_KP_DT 0.0500000007f /* Kp dt, dimensionless; Kp = 3 1/s */
#define CALIB_MM_KI_DT2 0.000833333354f /* Ki dt^2, dimensionless; Ki = 3 1/s^2 */
#define CALIB_MM_DT_S 0.0165459942f /* dt of the rate over the gyroscope's scale, s; phi falls for gz > 0 */
#define CALIB_MM_GYRO_BIAS_DT_RAD 9.91261913e-05f /* bias times the same, rad */
#define CALIB_MM_INTEGRAL_LIMIT_RAD 0.0166666675f /* |J| stays below, rad; 1 rad/s */
#define CALIB_PHI_LIMIT_RAD 1.58000004f /* |phi| stays below; range of the sine in the pipeline, rad */

/* Marker to head (A.1): x = X - d sin(phi), y = Y - d cos(phi). */
#define CALIB_MARKER_OFFSET_M 0.014998178f /* d, m; positive beyond the head */

/*
 * Low-pass of x and y. y_k = b0 x_k + b1 x_(k-1) + b2 x_(k-2) - a1 y_(k-1) - a2 y_(k-2): SciPy's
 * sign of a1, a2; CMSIS-DSP wants -a1, -a2. The pipeline runs forms exact at rest: SINGLE, PAIR. The sections
 * themselves are for programs of your own, and for the self-test to be held against.
 */
#define CALIB_LOWPASS_PAIRS 0 /* sections of order two */
#define CALIB_LOWPASS_SINGLES 1 /* sections of order one */
#define CALIB_LOWPASS_ZEROS 0 /* 1: sections with zeros elsewhere than at z = -1, for #if */
#define CALIB_LOWPASS_1_B0 0.049797982f /* b0, dimensionless */
#define CALIB_LOWPASS_1_B1 0.049797982f /* b1, dimensionless */
#define CALIB_LOWPASS_1_B2 0.0f /* b2, dimensionless */
#define CALIB_LOWPASS_1_A1 -0.900404036f /* a1, dimensionless, SciPy's sign */
#define CALIB_LOWPASS_1_A2 0.0f /* a2, dimensionless, SciPy's sign */
#define CALIB_LOWPASS_SINGLE_G 0.049797982f /* v = G (x - s), y = s + v, s' = y + v */

/*
 * Inverse kinematics (3.12) with the series (3.14): q1,2 = |(x, y)| f(phi) / 2 +- r_B phi,
 * f = F0 + F1 phi^2 + F2 phi^4 + F3 phi^6; bellows 1 is the longer one for phi > 0.
 */
#define CALIB_BELLOWS_RADIUS_M 0.0126f /* r_B, m */
#define CALIB_REST_LENGTH_M 0.0649775639f /* l0, m; length until the first picture */
#define CALIB_INVERSE_F0_PER_RAD0 2.0f /* coefficient of phi^0 (3.14), 1/rad^0 */
#define CALIB_INVERSE_F1_PER_RAD2 0.0833333358f /* coefficient of phi^2 (3.14), 1/rad^2 */
#define CALIB_INVERSE_F2_PER_RAD4 0.00243055564f /* coefficient of phi^4 (3.14), 1/rad^4 */
#define CALIB_INVERSE_F3_PER_RAD6 6.40707658e-05f /* coefficient of phi^6 (3.14), 1/rad^6 */

/*
 * Fused estimator with constant gains, for CALIB_FUSED 1. A tick carries (phi, b), (l, v) on by
 * phi += dt / 2 (w + w') + b, l += v. With the marker across and along the chord of D ticks ago
 * phi += c = K_c across / lever + K_a e_a, b += K_b c; e = along - S (l - D v), s += K_s (e - s);
 * moving (|s| > s_0 or |v| > v_0): l += K_m e, v += K_v e; at rest: l += K_r e, v *= K_d.
 * Gains for the noise in align.
 */
#define CALIB_HAS_FUSED 1 /* for #if */
#define CALIB_FUSED_DELAY_TICKS 1.51304853f /* D, ticks from the exposure of a picture to its tick */
#define CALIB_FUSED_ACCEL_11 0.000259515946f /* row 1, of ax, K_a / g times mount and scale, rad per m/s^2 */
#define CALIB_FUSED_ACCEL_12 4.81279949e-06f /* row 1, of ay, rad per m/s^2 */
#define CALIB_FUSED_ACCEL_1 2.1163205e-05f /* row 1, of the biases, subtracted, rad */
#define CALIB_FUSED_ACCEL_21 -4.8062011e-06f /* row 2, of ax, K_a / g times mount and scale, rad per m/s^2 */
#define CALIB_FUSED_ACCEL_22 0.000259872235f /* row 2, of ay, rad per m/s^2 */
#define CALIB_FUSED_ACCEL_2 -8.63058176e-06f /* row 2, of the biases, subtracted, rad */
#define CALIB_FUSED_ACCEL_GAIN 0.00254563009f /* K_a, share of the accelerometer's residual */
#define CALIB_FUSED_ACCEL_WEAK 0.000259493361f /* |A| and |B| below say nothing of phi, rad; 1 m/s^2 */
#define CALIB_FUSED_HALF_DT_S 0.0082729971f /* dt / 2 over the gyroscope's scale, s */
#define CALIB_FUSED_HALF_BIAS_RAD 4.95630957e-05f /* bias times the same, rad */
#define CALIB_FUSED_PHI_PER_M 0.369811684f /* K_c / lever, rad/m */
#define CALIB_FUSED_ALONE_PHI_PER_M 5.26460314f /* the same without the IMU, rad/m */
#define CALIB_FUSED_BOOST_PHI_PER_M 10.5292063f /* the same after a start, rad/m */
#define CALIB_FUSED_BIAS 0.00252201944f /* K_b, share of the correction */
#define CALIB_FUSED_MOVING_LENGTH 0.186627284f /* K_m, dimensionless */
#define CALIB_FUSED_MOVING_RATE 0.00680090999f /* K_v, per tick */
#define CALIB_FUSED_REST_LENGTH 0.00895201694f /* K_r, dimensionless */
#define CALIB_FUSED_RATE_DECAY 0.935506999f /* K_d, per tick, at rest and without a picture */
#define CALIB_FUSED_SLOW 0.0989248976f /* K_s, dimensionless */
#define CALIB_FUSED_MOVING_M 0.000373343733f /* s_0, mean residual of a length that moves, m */
#define CALIB_FUSED_STILL_M 7.33333354e-06f /* v_0, m per tick */
#define CALIB_FUSED_GATE_M 0.00499999989f /* residuals beyond are left out, m */
#define CALIB_FUSED_BOOST 0.5f /* share of the length's residual after a start */
#define CALIB_FUSED_BOOST_TICKS 8 /* pictures after a start that this holds for */
#define CALIB_FUSED_MOVING_TICKS 6 /* pictures for which a motion is remembered */
#define CALIB_FUSED_PATIENCE 6 /* pictures left out in a row before a new start */

/* Pumps. */
#define CALIB_PUMP_LOW_PWM 0.0f /* least command and limit of the clamping, PWM */
#define CALIB_PUMP_HIGH_PWM 255.0f /* greatest command and limit of the clamping, PWM */
#define CALIB_PUMP_HIGH 255 /* the same, for #if */

/*
 * Control of the angle, PID (4.1), (4.4).
 * falling_share is left out: the lower limit is CALIB_PUMP_LOW_PWM.
 * Kp = 390, Ki = 870, Kd = 0, error in rad. The pipeline sums (4.4) up:
 * u = KPDI e_k + (P - KD_PER_DT e_(k-1)), P += 2 KI_HALF_DT e_k.
 */
#define CALIB_ORIENTATION_KPDI_PWM_PER_RAD 397.25f /* Kp + Kd / dt + Ki dt / 2, PWM/rad */
#define CALIB_ORIENTATION_KD_PER_DT_PWM_PER_RAD 0.0f /* Kd / dt, PWM/rad */
#define CALIB_ORIENTATION_KI_HALF_DT_PWM_PER_RAD 7.25f /* Ki dt / 2, PWM/rad */
#define CALIB_ORIENTATION_HAS_KI 1 /* for #if */
#define CALIB_ORIENTATION_CLAMPING 0 /* 1: no integration beyond the limits (4.1.1) */
#define CALIB_ORIENTATION_HAS_BACK 1 /* 1: back-calculation, P += BACK (limited - u) */
#define CALIB_ORIENTATION_BACK 0.0333333351f /* dt / time constant of the back-calculation, dimensionless */

/* Which bellows a positive error of the angle drives (4.1). */
#define CALIB_ORIENTATION_SIGN 1 /* 1: bellows 1; -1: the hoses are crossed */

/*
 * Control of both lengths, PD (4.5), (4.8).
 * Kp = 12000, Ki = 0, Kd = 0, error in m. The pipeline sums (4.4) up:
 * u = KPDI e_k + (P - KD_PER_DT e_(k-1)), P += 2 KI_HALF_DT e_k.
 */
#define CALIB_POSITION_KPDI_PWM_PER_M 12000.0f /* Kp + Kd / dt + Ki dt / 2, PWM/m */
#define CALIB_POSITION_KD_PER_DT_PWM_PER_M 0.0f /* Kd / dt, PWM/m */
#define CALIB_POSITION_KI_HALF_DT_PWM_PER_M 0.0f /* Ki dt / 2, PWM/m */
#define CALIB_POSITION_HAS_KI 0 /* for #if */
#define CALIB_POSITION_CLAMPING 0 /* 1: no integration beyond the limits (4.1.1) */
#define CALIB_POSITION_HAS_BACK 0 /* 1: back-calculation, P += BACK (limited - u) */
#define CALIB_POSITION_BACK 0.0f /* dt / time constant of the back-calculation, dimensionless */

/*
 * Feed-forward: the line (4.6), 0 below FROM, else min(LIMIT, SLOPE q_ref - MINUS), or
 * the table of steady lengths: linear between entries, the last one beyond, 0 before the first.
 * The table: controller.feedforward at phi = 0, without bending; the line: (4.6).
 */
#define CALIB_FF_USE_TABLE 1 /* 0: the line, 1: the table */
#define CALIB_FF_FROM_M 0.0670000017f /* shortest bellows that needs pressure, m; 110 PWM there */
#define CALIB_FF_SLOPE_PWM_PER_M 5498.1001f /* PWM/m */
#define CALIB_FF_MINUS_PWM 258.372711f /* SLOPE FROM less the value there, PWM */
#define CALIB_FF_LIMIT_PWM 255.0f /* largest value, PWM */
#define CALIB_FF_TABLE_FROM_M 0.0649775639f /* length of the first entry, m */
#define CALIB_FF_TABLE_PER_STEP 500.0f /* entries per metre, 1/m */
#define CALIB_FF_TABLE_SIZE 15 /* entries */
/* PWM that holds a bellows at FROM + 0.002 m times the index */
static const float calib_ff_table_pwm[15] CALIB_IN_FLASH = {
    99.75f, 128.230881f, 139.722702f, 149.154648f, 157.587662f, 165.49794f,
    173.136826f, 180.664764f, 188.245468f, 196.046371f, 204.278656f, 213.307709f,
    223.947144f, 241.12381f, 253.5f,
};

/* Envelope, see calib_guard.h: the pumps stop where the actuator leaves it. */
#define CALIB_ENVELOPE_LEAST_M 0.0449775644f /* shortest length of a bellows, m */
#define CALIB_ENVELOPE_GREATEST_M 0.114977568f /* longest length of a bellows, m */
#define CALIB_ENVELOPE_ANGLE_RAD 1.5f /* greatest bending to each side, rad */
#define CALIB_ENVELOPE_STEP_M 0.00833333377f /* greatest change of a length in a tick, m; 0.5 m/s */
#define CALIB_ENVELOPE_FULL_TICKS 180 /* ticks that a pump may stay at its greatest command */
#define CALIB_ENVELOPE_OPEN_TICKS 3600 /* ticks that a pump may be on in open loop */
#define CALIB_ENVELOPE_OPEN_HIGH_PWM 255.0f /* greatest command in open loop: what holds the longest length by the pump's map, PWM */
#define CALIB_ENVELOPE_OPEN_HIGH 255 /* the same as a whole number */
#define CALIB_ENVELOPE_APART_M 0.0120000001f /* marker from where the angle puts it at most, m */

#if defined(CALIB_EXPECT_TICK_RATE_MHZ)
#if CALIB_EXPECT_TICK_RATE_MHZ != CALIB_TICK_RATE_MHZ
#error "calib: the program's tick rate is not the one that these gains were made for"
#endif
#endif

#if defined(CALIB_EXPECT_PUMP_HIGH)
#if CALIB_PUMP_HIGH > CALIB_EXPECT_PUMP_HIGH
#error "calib: these limits are beyond what the program allows its pumps"
#endif
#endif

#endif /* CALIB_CONSTANTS_H */
