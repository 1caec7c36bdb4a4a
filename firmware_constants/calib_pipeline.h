/*
 * calib_pipeline.h - from marker and IMU to the pumps, one call per tick, in binary32.
 *
 * C99 and C++11, everything static inline, no allocation, no library but sqrtf.
 *
 *   calib_state state;                    calib_start(&state) once
 *   calib_tick(&state, &inputs, &outputs) CALIB_TICK_RATE_HZ times a second
 *
 * IMU -> angle (2.3); marker -> plane (2.11), (2.12) -> head (A.1) -> low-pass -> lengths (3.12), (3.14);
 * then the controller that inputs.mode asks for: angle (4.1), (4.4) or lengths with feed-forward (4.5), (4.6).
 *
 * With CALIB_FUSED 1 one estimator with constant gains stands for angle filter and low-pass: the gyroscope
 * carries the angle, pictures and accelerometer pull it, the length follows the pictures with one of two gains,
 * and the age of a picture, in parts of a tick, is allowed for. It needs align in rig.yaml.
 *
 * What goes wrong, and what happens then (flags say it for the tick, counters for good):
 *   no marker, NaN, outside the picture   the last marker is held            CALIB_MARKER_HELD
 *   behind or near the horizon            the last marker is held            and CALIB_HORIZON
 *   no IMU sample, NaN, absurd readings   the angle is held                  CALIB_IMU_HELD
 *   hardly any specific force             the gyroscope alone                CALIB_ACCEL_WEAK
 *   angle beyond CALIB_PHI_LIMIT_RAD      held at the limit                  CALIB_ANGLE_LIMIT
 *   a needed sensor silent for more than
 *   CALIB_HOLD_TICKS, or never heard      pumps off, controllers cleared     CALIB_STALE
 *   reference NaN or absurd               pumps off, controllers cleared     CALIB_BAD_REFERENCE
 *   command beyond the limits             saturated, anti-windup             CALIB_SATURATED_1, _2
 * With constants that have no plane no marker is ever seen.
 * A marker that comes back after CALIB_HOLD_TICKS starts the low-pass afresh, an IMU after half of them the levelling
 * filter, which keeps the bias. No output is ever NaN or infinite.
 * With CALIB_FUSED 1 moreover
 *   no marker                             angle by the IMU, the length's rate decays
 *   marker far from the expected place    left out, after CALIB_FUSED_PATIENCE
 *                                         of them in a row a new start       CALIB_MARKER_REJECTED
 *   no IMU sample                         the angle by the pictures alone    CALIB_IMU_HELD
 *
 * Before including: CALIB_UNDISTORT 0 or 1 (default: 1 where the camera has a lens), CALIB_FUSED 0 or 1 (default 0),
 * CALIB_RATE_IS_MEAN 1 where gz_radps is the mean since the last tick instead of a reading at the tick (CALIB_FUSED
 * alone; for a program that reads the gyroscope more often than it ticks), CALIB_PROGMEM for tables in flash,
 * CALIB_STAGE(n) to measure stages 1 to 6, CALIB_SQRTF(x) for another square root.
 */
#ifndef CALIB_PIPELINE_H
#define CALIB_PIPELINE_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef CALIB_EXPECT_SCHEMA
#define CALIB_EXPECT_SCHEMA 8
#endif
#include "calib_constants.h"

#ifndef CALIB_UNDISTORT
#define CALIB_UNDISTORT (CALIB_HAS_PLANE && CALIB_CAMERA_HAS_LENS)
#endif
#if CALIB_HAS_PLANE && !CALIB_UNDISTORT && !CALIB_HAS_RAW_PLANE
#error "calib: no plane without undistortion, the camera does not see the workspace"
#endif

#ifndef CALIB_FUSED
#define CALIB_FUSED 0
#endif
#if CALIB_FUSED && !CALIB_HAS_FUSED
#error "calib: rig.yaml lacks what CALIB_FUSED needs, calib_constants.h says what (calib align)"
#endif

#ifndef CALIB_RATE_IS_MEAN
#define CALIB_RATE_IS_MEAN 0
#endif

#ifndef CALIB_STAGE
#define CALIB_STAGE(n)
#endif

#ifndef CALIB_SQRTF
#define CALIB_SQRTF(x) sqrtf(x)
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define CALIB_PI_F 3.14159274f

/* References beyond are refused: rad, or m. */
#define CALIB_REFERENCE_LIMIT 6.3f

/* Modes of inputs.mode. */
#define CALIB_MODE_OFF 0         /* pumps off, estimates only */
#define CALIB_MODE_ORIENTATION 1 /* reference[0] is the angle, rad */
#define CALIB_MODE_POSITION 2    /* reference[] are the bellows' lengths, m */

/* Bits of outputs.flags. */
#define CALIB_MARKER_HELD 0x0001u
#define CALIB_HORIZON 0x0002u
#define CALIB_IMU_HELD 0x0004u
#define CALIB_ACCEL_WEAK 0x0008u
#define CALIB_ANGLE_LIMIT 0x0010u
#define CALIB_STALE 0x0020u
#define CALIB_BAD_REFERENCE 0x0040u
#define CALIB_CLAMPED_1 0x0080u
#define CALIB_CLAMPED_2 0x0100u
#define CALIB_SATURATED_1 0x0200u
#define CALIB_SATURATED_2 0x0400u
#define CALIB_MARKER_REJECTED 0x0800u
#define CALIB_LENGTH_MOVES 0x1000u /* of the fused estimator: the length does not rest */
#define CALIB_BY_MEAN_RATE 0x4000u /* in every tick: CALIB_RATE_IS_MEAN was 1 */
#define CALIB_BY_FUSED 0x8000u     /* in every tick: CALIB_FUSED was 1 */

/* Counters of state.count; they stop at 65535. */
#define CALIB_COUNT_MARKER 0    /* ticks without a marker */
#define CALIB_COUNT_HORIZON 1   /* markers near or behind the horizon */
#define CALIB_COUNT_IMU 2       /* ticks without a sample */
#define CALIB_COUNT_STALE 3     /* ticks that a lost sensor stopped */
#define CALIB_COUNT_REFERENCE 4 /* ticks that a bad reference stopped */
#define CALIB_COUNT_SATURATED 5 /* ticks with a saturated command */
#define CALIB_COUNT_REJECTED 6  /* markers that the fused estimator left out */
#define CALIB_COUNTERS 7

#define CALIB_LOWPASS_STATES (2 * CALIB_LOWPASS_PAIRS + CALIB_LOWPASS_SINGLES)
#define CALIB_PAST_TICKS (CALIB_TIME_OFFSET_TICKS + 1) /* that are remembered */

/* Floats at the beginning of what goes in and what comes out. */
#define CALIB_INPUT_FLOATS 8
#define CALIB_OUTPUT_FLOATS 9

typedef struct {
    float u_px, v_px;                     /* marker as the camera reports it */
    float ax_mps2, ay_mps2, gz_radps;     /* readings of the IMU */
    float reference[2];                   /* see the modes */
    float late_ticks;                     /* ticks since the picture had its time in the logs, 0 to 1 */
    uint8_t marker_seen, imu_read;        /* 0: nothing came in this tick */
    uint8_t mode;
} calib_inputs;

typedef struct {
    float phi_rad;
    float marker_m[2];                    /* marker in the plane, held where none was seen */
    float head_m[2];                      /* head after the low-pass; fused: when the picture was exposed */
    float q_m[2];                         /* lengths of the bellows */
    float pwm[2];                         /* commands, within the pumps' limits */
    uint16_t flags;
    uint8_t duty[2];                      /* the commands as whole numbers for a timer's register */
} calib_outputs;

/* A controller's memory: P and e_(k-1), reference and feed-forward of the tick before. */
typedef struct {
    float sum, error, fed_m, fed_pwm;
} calib_channel;

typedef struct {
    float phi_rad;
    float marker_m[2];
#if CALIB_FUSED
    float bias_rad, half_rad;             /* what the gyroscope turns too little in a tick; T / 2 times its rate */
    float length_m, rate_m, slow_m;       /* length, its change in a tick, mean residual */
    float turned_rad[CALIB_PAST_TICKS];   /* what the gyroscope turned in the last ticks, the oldest first */
    float pull_rad;                       /* the accelerometer's pull in this tick, for the guard */
    uint8_t boost, moving, rejected;
#else
    float integral_rad;                   /* J of (2.3), from the gyroscope's known bias on */
#if CALIB_LEVELLING
    float sum_rad, before_radps;          /* S, and gz of the tick before */
    float rest_rad[2];                    /* what rounding left of phi and J, see calib_carried */
    uint16_t ticks;                       /* taken so far, up to the last change of the gains */
    uint8_t step;                         /* entry of the tables of gains */
#endif
    float lowpass[2][CALIB_LOWPASS_STATES];
    float past_rad[CALIB_PAST_TICKS];     /* angles of the last ticks, the oldest first */
#endif
    calib_channel channel[2];
    uint16_t marker_age, imu_age;         /* ticks since the last good one, from CALIB_NEVER */
    uint16_t count[CALIB_COUNTERS];
    uint8_t mode;
} calib_state;

#define CALIB_NEVER 0xFFFFu

static inline void calib_count(calib_state *state, uint8_t which) {
    if (state->count[which] != 0xFFFFu) {
        state->count[which] = (uint16_t)(state->count[which] + 1u);
    }
}

/* Older by a tick; what was never heard stays so. */
static inline uint16_t calib_older(uint16_t age) {
    return age >= CALIB_NEVER - 1u ? age : (uint16_t)(age + 1u);
}

/*
 * The bits of a float. Floats of one sign compare as their bits do, NaN and infinity above all others; on an AVR
 * that takes 10 cycles instead of 60. A sign in front counts as more than any magnitude.
 */
static inline uint32_t calib_bits(float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

static inline uint8_t calib_negative(float value) {
    return (uint8_t)(calib_bits(value) >> 31);
}

/* |value| <= limit for a positive limit; false for NaN. */
static inline uint8_t calib_within(float value, float limit) {
    return (uint8_t)((calib_bits(value) & 0x7FFFFFFFUL) <= calib_bits(limit));
}

/* value > limit for a limit that is not negative; true for a positive NaN. */
static inline uint8_t calib_above(float value, float limit) {
    return (uint8_t)(!calib_negative(value) && calib_bits(value) > calib_bits(limit));
}

/* A value within +-limit: itself, or the limit on its side. Not for NaN. */
static inline float calib_clip(float value, float limit) {
    if (calib_within(value, limit)) {
        return value;
    }
    return calib_negative(value) ? -limit : limit;
}

static inline float calib_abs(float value) {
    return calib_negative(value) ? -value : value;
}

/*
 * atan2(y, x) to 2e-7 rad, of which not both may be zero; NaN for infinite ones. The octant is turned by pi/8,
 * t = (b - k a) / (a + k b), which leaves |t| <= tan(pi/8) = k for an odd polynomial of degree 7.
 */
static inline float calib_atan2(float y, float x) {
    float a = calib_abs(x), b = calib_abs(y), t, w, base = 0.392699093f;
    uint8_t minus = 0;
    if (calib_bits(b) > calib_bits(a)) {
        t = a;
        a = b;
        b = t;
        minus = 1;
        base = 1.17809725f;
    }
    t = (b - 0.414213568f * a) / (a + 0.414213568f * b);
    w = t * t;
    t = t + t * w * (-0.333228916f + w * (0.196702421f + w * -0.110536873f));
    if (calib_negative(x)) {
        base = minus ? 1.96349537f : 2.74889350f;
        minus = (uint8_t)!minus;
    }
    t = minus ? base - t : base + t;
    return calib_negative(y) ? -t : t;
}

#if CALIB_FUSED
/* sin(h) / h to 3e-9 and cos(h) to 4e-8 for |h| <= CALIB_PHI_LIMIT_RAD / 2; w is h squared. */
static inline float calib_sinc_half(float w) {
    return 1.0f + w * (-0.1666665f + w * (0.00833195f + w * -0.00019492f));
}

static inline float calib_cos_half(float w) {
    return 1.0f + w * (-0.49999891f + w * (0.04165605f + w * -0.00135944f));
}
#else
/*
 * d sin(phi) and d cos(phi) for |phi| <= CALIB_PHI_LIMIT_RAD, to 1e-6 d and 7e-6 d; w is phi squared. The compiler
 * multiplies the coefficients by d.
 */
static inline float calib_sin(float d, float phi, float w) {
    return phi * (d + w * (d * -0.166655675f + w * (d * 0.00831080042f + w * (d * -0.000184432589f))));
}

static inline float calib_cos(float d, float w) {
    return d * 0.999992967f +
           w * (d * -0.499909371f + w * (d * 0.0414836332f + w * (d * -0.00126988115f)));
}

/* Half of f of (3.14): length of the backbone by that of the chord. */
static inline float calib_half_f(float w) {
    return 0.5f * CALIB_INVERSE_F0_PER_RAD0 +
           w * (0.5f * CALIB_INVERSE_F1_PER_RAD2 +
                w * (0.5f * CALIB_INVERSE_F2_PER_RAD4 + w * (0.5f * CALIB_INVERSE_F3_PER_RAD6)));
}

/*
 * Lengths of the bellows by (3.12) of the head (x, y) and the angle, |phi| <= CALIB_PHI_LIMIT_RAD; w is the square
 * of the angle that belongs to the head.
 */
static inline void calib_bellows(float x, float y, float phi, float w, float *q) {
    float length = (float)CALIB_SQRTF(x * x + y * y) * calib_half_f(w);
    float turned = CALIB_BELLOWS_RADIUS_M * phi;
    q[0] = length + turned;
    q[1] = length - turned;
}
#endif

/*
 * Lengths that bring the head to (x, y), exact to 4e-7: under constant curvature the angle is twice that of the
 * chord (4.9c), and with t = x / y the length is y (1 + t^2) atan(t) / t, which needs neither root nor series.
 * A point farther to the side than ahead, and NaN, gives lengths that the tick refuses.
 */
static inline void calib_reference_point(float x, float y, float *q) {
    float t, w, A, length, turned;
    q[0] = 2.0f * CALIB_REFERENCE_LIMIT;
    q[1] = 2.0f * CALIB_REFERENCE_LIMIT;
    if (!calib_within(y, CALIB_REFERENCE_LIMIT) || y < FLT_MIN || !calib_within(x, y)) {
        return;
    }
    t = x / y;
    w = t * t;
    A = 1.0f + w * (-0.33325395f +
                    w * (0.198618561f +
                         w * (-0.133988008f + w * (0.0821677893f + w * (-0.0355199054f + w * 0.00737401377f)))));
    length = y * (A + w * A);
    turned = 2.0f * CALIB_BELLOWS_RADIUS_M * (t * A);
    q[0] = length + turned;
    q[1] = length - turned;
}

static inline uint16_t calib_imu_lost(calib_state *state) {
    state->imu_age = calib_older(state->imu_age);
    calib_count(state, CALIB_COUNT_IMU);
    return CALIB_IMU_HELD;
}

/* Whether the IMU's sample can be used. */
static inline uint8_t calib_sampled(const calib_inputs *in) {
    return (uint8_t)(in->imu_read && calib_within(in->ax_mps2, CALIB_IMU_ACCEL_LIMIT_MPS2) &&
                     calib_within(in->ay_mps2, CALIB_IMU_ACCEL_LIMIT_MPS2) &&
                     calib_within(in->gz_radps, CALIB_IMU_RATE_LIMIT_RADPS));
}

#if CALIB_IMU_SIGN_AX < 0
#define CALIB_AX(in) (-(in)->ax_mps2)
#else
#define CALIB_AX(in) ((in)->ax_mps2)
#endif
#if CALIB_IMU_SIGN_AY < 0
#define CALIB_AY(in) (-(in)->ay_mps2)
#else
#define CALIB_AY(in) ((in)->ay_mps2)
#endif
#if CALIB_IMU_SIGN_GZ < 0
#define CALIB_GZ(in) (-(in)->gz_radps)
#else
#define CALIB_GZ(in) ((in)->gz_radps)
#endif

/* How late the picture comes beyond the logs' delay, in ticks: within 0 to 1, whatever the program says. */
static inline float calib_late(const calib_inputs *in) {
    return calib_bits(in->late_ticks) <= calib_bits(1.0f) ? in->late_ticks : 1.0f;
}

/* The angle at the time of the picture, for all that is of the picture; phi is that of this tick. */
#if CALIB_FUSED
static inline float calib_then(const calib_state *state, float phi, float delay) {
    const float *turned = state->turned_rad + CALIB_PAST_TICKS - 1;
    while (calib_bits(delay) > calib_bits(1.0f) && turned != state->turned_rad) {
        phi -= *turned--;
        delay -= 1.0f;
    }
    return calib_clip(phi - delay * *turned, CALIB_PHI_LIMIT_RAD);
}
#else
static inline float calib_then(const calib_state *state, float phi, float late) {
    float part = CALIB_TIME_OFFSET_PART - late;
    (void)phi;
#if CALIB_TIME_OFFSET_TICKS > 1
    float there = state->past_rad[1], next = state->past_rad[2];
#elif CALIB_TIME_OFFSET_TICKS > 0
    float there = state->past_rad[1], next = phi;
#else
    float there = phi, next = phi;
#endif
    return there + part * (calib_negative(part) ? there - state->past_rad[0] : next - there);
}
#endif

#if !CALIB_FUSED
#if CALIB_LEVELLING
/*
 * A sum of small changes, with what rounding leaves of each kept for the next (Kahan 1965): the filter remembers for
 * half a minute, over which the roundings of 2000 ticks would add up to 4e-6 rad.
 */
static inline float calib_carried(float sum, float change, float *rest) {
    float all = change + *rest, now = sum + all;
    *rest = all - (now - sum);
    return now;
}
#endif

/* Angle filter: (2.3), or levelling. Returns flags. */
static inline uint16_t calib_angle(calib_state *state, const calib_inputs *in) {
    float ax, ay, gz, e = 0.0f, phi = state->phi_rad;
#if CALIB_LEVELLING
    float turned = 0.0f;
    uint8_t afresh = (uint8_t)(state->imu_age > CALIB_HOLD_TICKS / 2);
#else
    uint8_t afresh = (uint8_t)(state->imu_age == CALIB_NEVER);
#endif
    uint16_t flags = 0;
    if (!calib_sampled(in)) {
        return calib_imu_lost(state);
    }
    ax = CALIB_AX(in);
    ay = CALIB_AY(in);
    gz = CALIB_GZ(in);
#if CALIB_LEVELLING
    if (!afresh) {
        turned = state->integral_rad - (0.5f * CALIB_MM_DT_S) * (gz + state->before_radps);
        if (state->imu_age > 0) {
            turned *= (float)(state->imu_age + 1u); /* the ticks without a sample as well */
        }
        phi += turned;
    }
    state->before_radps = gz;
#endif
    /* Differences, because a compiler may leave out x - 0 and x * 1, but not x + 0. */
    ax = ax - CALIB_IMU_ACCEL_BIAS_X_MPS2;
    ay = (ay - CALIB_IMU_ACCEL_BIAS_Y_MPS2) * CALIB_IMU_ACCEL_RATIO;
    if (calib_within(ax, CALIB_IMU_ACCEL_WEAK_MPS2) && calib_within(ay, CALIB_IMU_ACCEL_WEAK_MPS2)) {
        if (afresh) {
            return (uint16_t)(CALIB_ACCEL_WEAK | calib_imu_lost(state));
        }
        flags = CALIB_ACCEL_WEAK;
    } else {
        e = calib_atan2(ay, ax) - CALIB_IMU_MOUNT_ANGLE_RAD - phi;
        if (!calib_within(e, CALIB_PI_F)) {
            e = calib_negative(e) ? e + 2.0f * CALIB_PI_F : e - 2.0f * CALIB_PI_F;
        }
    }
    if (afresh) {
        phi += e;
#if CALIB_LEVELLING
        state->sum_rad = 0.0f;
        state->rest_rad[0] = 0.0f;
        state->ticks = 0;
        state->step = 0;
#endif
    } else {
#if CALIB_LEVELLING
        uint8_t i = state->step;
        float S = state->sum_rad + e;
        float J = calib_carried(state->integral_rad, CALIB_TABLE_READ(&calib_levelling_bias[i]) * S, &state->rest_rad[1]);
        state->integral_rad = calib_clip(J, CALIB_MM_INTEGRAL_LIMIT_RAD);
        turned += CALIB_TABLE_READ(&calib_levelling_angle[i]) * S;
        phi = calib_carried(state->phi_rad, turned, &state->rest_rad[0]);
        state->sum_rad = S - CALIB_TABLE_READ(&calib_levelling_sum[i]) * S;
        if (i < CALIB_LEVELLING_STEPS - 1u) {
            state->ticks = (uint16_t)(state->ticks + 1u);
            if ((float)state->ticks >= CALIB_TABLE_READ(&calib_levelling_until[i])) {
                state->step = (uint8_t)(i + 1u);
            }
        }
#else
        float J = calib_clip(state->integral_rad + CALIB_MM_KI_DT2 * e, CALIB_MM_INTEGRAL_LIMIT_RAD);
        state->integral_rad = J;
        phi += CALIB_MM_KP_DT * e + (J - CALIB_MM_DT_S * gz);
#endif
    }
    if (!calib_within(phi, CALIB_PHI_LIMIT_RAD)) {
        phi = calib_clip(phi, CALIB_PHI_LIMIT_RAD);
        flags = (uint16_t)(flags | CALIB_ANGLE_LIMIT);
    }
    state->phi_rad = phi;
    state->imu_age = 0;
    return flags;
}
#endif

#if CALIB_UNDISTORT
/* Undistorted normalised coordinates of a pixel. */
static inline void calib_undistort(float u, float v, float *x, float *y) {
    float yd = (v - CALIB_CAMERA_CY_PX) * CALIB_CAMERA_PER_FY, P, r2;
#if CALIB_CAMERA_HAS_SKEW
    float xd = (u - CALIB_CAMERA_CX_PX - CALIB_CAMERA_SKEW_PX * yd) * CALIB_CAMERA_PER_FX;
#else
    float xd = (u - CALIB_CAMERA_CX_PX) * CALIB_CAMERA_PER_FX;
#endif
#if CALIB_LENS_DECENTERING_STEPS > 0
    uint8_t step;
#endif
    r2 = xd * xd + yd * yd;
    P = CALIB_LENS_INVERSE_P(r2);
    *x = xd * P;
    *y = yd * P;
#if CALIB_LENS_DECENTERING_STEPS > 0
    for (step = 0; step < CALIB_LENS_DECENTERING_STEPS; step++) {
        float xx = *x * *x, yy = *y * *y, xy = 2.0f * *x * *y, a, b;
        r2 = xx + yy;
        a = xd - (CALIB_CAMERA_P1 * xy + CALIB_CAMERA_P2 * (r2 + 2.0f * xx));
        b = yd - (CALIB_CAMERA_P1 * (r2 + 2.0f * yy) + CALIB_CAMERA_P2 * xy);
        r2 = a * a + b * b;
        P = CALIB_LENS_INVERSE_P(r2);
        *x = a * P;
        *y = b * P;
    }
#endif
}
#endif

/*
 * Marker in the plane, with its age. Returns flags. state->marker_m keeps the last good one;
 * *afresh is set where the low-pass has to start again.
 */
static inline uint16_t calib_marker(calib_state *state, const calib_inputs *in, uint8_t *afresh) {
    uint16_t flags = CALIB_MARKER_HELD;
#if CALIB_HAS_PLANE
    float u = in->u_px, v = in->v_px, W;
#else
    (void)in;
#endif
    *afresh = 0;
#if CALIB_HAS_PLANE
    /* A picture begins half a pixel before the centre of its first one. */
    if (in->marker_seen && calib_within(u, calib_negative(u) ? 0.5f : CALIB_CAMERA_GREATEST_U_PX) &&
        calib_within(v, calib_negative(v) ? 0.5f : CALIB_CAMERA_GREATEST_V_PX)) {
#if CALIB_UNDISTORT
        float x, y;
        calib_undistort(u, v, &x, &y);
        W = CALIB_PLANE_NORMALISED_31 * x + CALIB_PLANE_NORMALISED_32 * y + CALIB_PLANE_NORMALISED_33;
        if (calib_above(W, CALIB_PLANE_LEAST_PER_M)) {
            float s = 1.0f / W;
            state->marker_m[0] =
                s * (CALIB_PLANE_NORMALISED_11 * x + CALIB_PLANE_NORMALISED_12 * y + CALIB_PLANE_NORMALISED_13);
            state->marker_m[1] =
                s * (CALIB_PLANE_NORMALISED_21 * x + CALIB_PLANE_NORMALISED_22 * y + CALIB_PLANE_NORMALISED_23);
            flags = 0;
        }
#else
        W = CALIB_PLANE_RAW_31 * u + CALIB_PLANE_RAW_32 * v + CALIB_PLANE_RAW_33;
        if (calib_above(W, CALIB_PLANE_RAW_LEAST_PER_M)) {
            float s = 1.0f / W;
            state->marker_m[0] = s * (CALIB_PLANE_RAW_11 * u + CALIB_PLANE_RAW_12 * v + CALIB_PLANE_RAW_13);
            state->marker_m[1] = s * (CALIB_PLANE_RAW_21 * u + CALIB_PLANE_RAW_22 * v + CALIB_PLANE_RAW_23);
            flags = 0;
        }
#endif
        else {
            flags = CALIB_MARKER_HELD | CALIB_HORIZON;
            calib_count(state, CALIB_COUNT_HORIZON);
        }
    }
#endif
    if (flags) {
        calib_count(state, CALIB_COUNT_MARKER);
        state->marker_age = calib_older(state->marker_age);
    } else {
        *afresh = (uint8_t)(state->marker_age > CALIB_HOLD_TICKS);
        state->marker_age = 0;
    }
    return flags;
}

#if !CALIB_FUSED
#if CALIB_LOWPASS_PAIRS > 0
/* One section of order two; Z is 0 for zeros at z = -1. */
static inline float calib_lowpass_pair(float *s, float x, float A1, float A2, float A3, float Z) {
    float v3 = x - s[1], v1 = A1 * s[0] + A2 * v3;
    x = s[1] + (A2 * s[0] + A3 * v3);
    s[1] = 2.0f * x - s[1];
    if (CALIB_LOWPASS_ZEROS) {
        x += Z * (v1 - s[0]);
    }
    s[0] = 2.0f * v1 - s[0];
    return x;
}
#endif

/* One tick of the low-pass of one coordinate; s is its memory. Exact at rest. */
static inline float calib_lowpass(float *s, float x) {
#if CALIB_LOWPASS_PAIRS > 0
    x = calib_lowpass_pair(s, x, CALIB_LOWPASS_PAIR1_A1, CALIB_LOWPASS_PAIR1_A2, CALIB_LOWPASS_PAIR1_A3,
                           CALIB_LOWPASS_PAIR1_Z);
    s += 2;
#endif
#if CALIB_LOWPASS_PAIRS > 1
    x = calib_lowpass_pair(s, x, CALIB_LOWPASS_PAIR2_A1, CALIB_LOWPASS_PAIR2_A2, CALIB_LOWPASS_PAIR2_A3,
                           CALIB_LOWPASS_PAIR2_Z);
    s += 2;
#endif
#if CALIB_LOWPASS_PAIRS > 2
    x = calib_lowpass_pair(s, x, CALIB_LOWPASS_PAIR3_A1, CALIB_LOWPASS_PAIR3_A2, CALIB_LOWPASS_PAIR3_A3,
                           CALIB_LOWPASS_PAIR3_Z);
    s += 2;
#endif
#if CALIB_LOWPASS_PAIRS > 3
    x = calib_lowpass_pair(s, x, CALIB_LOWPASS_PAIR4_A1, CALIB_LOWPASS_PAIR4_A2, CALIB_LOWPASS_PAIR4_A3,
                           CALIB_LOWPASS_PAIR4_Z);
    s += 2;
#endif
#if CALIB_LOWPASS_SINGLES > 0
    {
        float v = CALIB_LOWPASS_SINGLE_G * (x - s[0]);
        x = s[0] + v;
        s[0] = x + v;
    }
#endif
    return x;
}

/* The memory after x has been the input for ever. */
static inline void calib_lowpass_settle(float *s, float x) {
#if CALIB_LOWPASS_PAIRS > 0
    uint8_t k;
    for (k = 0; k < CALIB_LOWPASS_PAIRS; k++) {
        *s++ = 0.0f;
        *s++ = x;
    }
#endif
#if CALIB_LOWPASS_SINGLES > 0
    *s = x;
#endif
}
#else
/* Half of a finite number, by its exponent; one below 1e-37 stays. */
static inline float calib_half(float value) {
    uint32_t bits = calib_bits(value);
    if (bits & 0x7F000000UL) {
        bits = (uint32_t)(bits - 0x00800000UL);
    }
    memcpy(&value, &bits, sizeof value);
    return value;
}

/*
 * The fused estimator. A picture tells where the head was when it was exposed; with h half the angle of then, see
 * calib_then, the marker's place across the chord tells that angle's error, its place along the chord the length,
 * without root or arc tangent. Returns flags.
 */
static inline uint16_t calib_fuse(calib_state *state, const calib_inputs *in, calib_outputs *out) {
    float phi = state->phi_rad, turned = 0.0f, A = 0.0f, B = 0.0f, half, then, h, w, s, sh, ch, chord, c = 0.0f;
    uint16_t flags = 0, age = state->marker_age;
    uint8_t sampled = calib_sampled(in), afresh, i;
    float delay = CALIB_FUSED_DELAY_TICKS + calib_late(in);
    if (sampled) {
        float ax = CALIB_AX(in), ay = CALIB_AY(in);
        /* Gravity's share along and across the head, times the accelerometer's gain. */
        A = CALIB_FUSED_ACCEL_11 * ax + (CALIB_FUSED_ACCEL_12 * ay - CALIB_FUSED_ACCEL_1);
        B = CALIB_FUSED_ACCEL_21 * ax + (CALIB_FUSED_ACCEL_22 * ay - CALIB_FUSED_ACCEL_2);
        half = CALIB_FUSED_HALF_BIAS_RAD - CALIB_FUSED_HALF_DT_S * CALIB_GZ(in);
        if (calib_within(A, CALIB_FUSED_ACCEL_WEAK) && calib_within(B, CALIB_FUSED_ACCEL_WEAK)) {
            flags = CALIB_ACCEL_WEAK;
        }
        if (state->imu_age <= CALIB_HOLD_TICKS || age <= CALIB_HOLD_TICKS) {
#if CALIB_RATE_IS_MEAN
            turned = half + half + state->bias_rad;
#else
            turned = half + (state->imu_age ? half : state->half_rad) + state->bias_rad;
#endif
            phi += turned;
        } else if (flags) {
            sampled = 0;
        } else {
            /* Nothing is known of the angle: the accelerometer's. */
            phi = calib_clip(calib_atan2(B, A), CALIB_PHI_LIMIT_RAD);
            memset(state->turned_rad, 0, sizeof state->turned_rad);
        }
        state->half_rad = half;
    }
    if (sampled) {
        state->imu_age = 0;
    } else {
        flags = (uint16_t)(flags | calib_imu_lost(state));
    }
    for (i = 0; i + 1 < CALIB_PAST_TICKS; i++) {
        state->turned_rad[i] = state->turned_rad[i + 1];
    }
    state->turned_rad[i] = turned;
    CALIB_STAGE(2);
    flags = (uint16_t)(flags | calib_marker(state, in, &afresh));
    CALIB_STAGE(3);
    then = calib_then(state, phi, delay);
    h = calib_half(then);
    w = h * h;
    s = calib_sinc_half(w);
    sh = h * s;
    ch = calib_cos_half(w);
    if (sampled && !(flags & CALIB_ACCEL_WEAK)) {
        /* B cos(then) - A sin(then), which is the angle's error of then, seen now. */
        c = B - (sh + sh) * (B * sh + A * ch) - CALIB_FUSED_ACCEL_GAIN * (phi - then);
        c = calib_clip(c, CALIB_FUSED_ACCEL_GAIN);
        state->pull_rad = c;
    }
    CALIB_STAGE(4);
    state->length_m += state->rate_m;
    chord = s * (state->length_m - delay * state->rate_m);
    if (flags & CALIB_MARKER_HELD) {
        state->rate_m *= CALIB_FUSED_RATE_DECAY;
    } else {
        float X = state->marker_m[0], Y = state->marker_m[1], e, more = 0.0f;
        float across = X * ch - (Y + CALIB_MARKER_OFFSET_M) * sh;
        float along = X * sh + (Y - CALIB_MARKER_OFFSET_M) * ch;
        if (afresh || state->rejected >= CALIB_FUSED_PATIENCE) {
            chord = along;
            state->length_m = along / s;
            state->rate_m = 0.0f;
            state->slow_m = 0.0f;
            state->boost = CALIB_FUSED_BOOST_TICKS;
            state->moving = CALIB_FUSED_MOVING_TICKS;
            state->rejected = 0;
        }
        e = along - chord;
        if (state->boost) {
            state->boost--;
            c = calib_clip(CALIB_FUSED_BOOST_PHI_PER_M * across, CALIB_FUSED_BOOST);
            more = CALIB_FUSED_BOOST * e;
        } else if (calib_within(across, CALIB_FUSED_GATE_M) && calib_within(e, CALIB_FUSED_GATE_M)) {
            state->rejected = 0;
            if (sampled) {
                c += CALIB_FUSED_PHI_PER_M * across;
            } else {
                c = CALIB_FUSED_ALONE_PHI_PER_M * across;
            }
            state->slow_m += CALIB_FUSED_SLOW * (e - state->slow_m);
            if (!calib_within(state->slow_m, CALIB_FUSED_MOVING_M) ||
                !calib_within(state->rate_m, CALIB_FUSED_STILL_M)) {
                state->moving = CALIB_FUSED_MOVING_TICKS;
                flags = (uint16_t)(flags | CALIB_LENGTH_MOVES);
            } else if (state->moving) {
                state->moving--;
            }
            if (state->moving) {
                more = CALIB_FUSED_MOVING_LENGTH * e;
                state->rate_m += CALIB_FUSED_MOVING_RATE * e;
            } else {
                more = CALIB_FUSED_REST_LENGTH * e;
                state->rate_m *= CALIB_FUSED_RATE_DECAY;
            }
        } else {
            state->rejected++;
            state->rate_m *= CALIB_FUSED_RATE_DECAY;
            state->marker_age = calib_older(age);
            calib_count(state, CALIB_COUNT_REJECTED);
            flags = (uint16_t)(flags | CALIB_MARKER_REJECTED);
        }
        state->length_m += more;
        chord += more;
    }
    if (sampled && !state->boost) {
        state->bias_rad = calib_clip(state->bias_rad + CALIB_FUSED_BIAS * c, CALIB_MM_INTEGRAL_LIMIT_RAD);
    }
    phi += c;
    if (!calib_within(phi, CALIB_PHI_LIMIT_RAD)) {
        phi = calib_clip(phi, CALIB_PHI_LIMIT_RAD);
        flags = (uint16_t)(flags | CALIB_ANGLE_LIMIT);
    }
    state->phi_rad = phi;
    CALIB_STAGE(5);
    out->phi_rad = phi;
    phi *= CALIB_BELLOWS_RADIUS_M;
    out->q_m[0] = state->length_m + phi;
    out->q_m[1] = state->length_m - phi;
    /* The head at the time of the picture (3.6). */
    out->head_m[0] = chord * sh;
    out->head_m[1] = chord * ch;
    return flags;
}
#endif

/* Feed-forward of one bellows (4.6), or from the table. */
static inline float calib_feed_forward(float q_ref_m) {
#if CALIB_FF_USE_TABLE
    float at = (q_ref_m - CALIB_FF_TABLE_FROM_M) * CALIB_FF_TABLE_PER_STEP, low;
    uint8_t i;
    if (at < 0.0f) {
        return 0.0f;
    }
    if (at >= (float)(CALIB_FF_TABLE_SIZE - 1)) {
        return CALIB_TABLE_READ(&calib_ff_table_pwm[CALIB_FF_TABLE_SIZE - 1]);
    }
    i = (uint8_t)at;
    low = CALIB_TABLE_READ(&calib_ff_table_pwm[i]);
    return low + (at - (float)i) * (CALIB_TABLE_READ(&calib_ff_table_pwm[i + 1]) - low);
#else
    float u;
    if (calib_negative(q_ref_m) || calib_bits(q_ref_m) < calib_bits(CALIB_FF_FROM_M)) {
        return 0.0f;
    }
    u = CALIB_FF_SLOPE_PWM_PER_M * q_ref_m - CALIB_FF_MINUS_PWM;
    return u < CALIB_FF_LIMIT_PWM ? u : CALIB_FF_LIMIT_PWM;
#endif
}

/* A state that has seen nothing yet. */
static inline void calib_start(calib_state *state) {
    /* All floats to zero; so is the feed-forward of no length. */
    memset(state, 0, sizeof *state);
#if CALIB_FUSED
    state->length_m = CALIB_REST_LENGTH_M;
#else
    state->integral_rad = CALIB_MM_GYRO_BIAS_DT_RAD;
#endif
    state->marker_age = CALIB_NEVER;
    state->imu_age = CALIB_NEVER;
    state->mode = CALIB_MODE_OFF;
}

/* Whether the pumps can do it; the limits are not negative. */
static inline uint8_t calib_in_limits(float u) {
    return (uint8_t)(!calib_negative(u) && calib_within(u, CALIB_PUMP_HIGH_PWM) &&
                     calib_bits(u) >= calib_bits(CALIB_PUMP_LOW_PWM));
}

/*
 * One controller, unsaturated: (4.4) summed up. *sum is P = S + KI e of the tick before, so that a tick takes three
 * products: u = KPDI e + (P - KD e1), P += KI2 e. *clamped is set where the integration was left out: then
 * u loses KI (e + e1), and P becomes P + KI (e - e1). integral and clamping are known when this is compiled.
 */
static inline float calib_pid(float *sum, float e, float e1, float KPDI, float KD, float KI, uint8_t integral,
                              uint8_t clamping, uint8_t *clamped) {
    float u;
    *clamped = 0;
    if (!integral) {
        return KPDI * e - KD * e1;
    }
    u = KPDI * e + (*sum - KD * e1);
    if (clamping && !calib_in_limits(u)) {
        float now = KI * e, before = KI * e1;
        *clamped = 1;
        *sum += now - before;
        return u - (now + before);
    }
    *sum += 2.0f * KI * e;
    return u;
}

/* The nearest whole number of 0 <= u <= 255, halves upwards: twice u has the exponent one higher. */
static inline uint8_t calib_whole(float u) {
    uint32_t bits = calib_bits(u);
    if (bits < 0x00800000UL) {
        return 0;
    }
    bits += 0x00800000UL;
    memcpy(&u, &bits, sizeof u);
    return (uint8_t)(((uint16_t)u + 1u) >> 1);
}

/* Without clamping, which looks at the feedback alone, the integral's sum carries the feed-forward: one sum less. */
#define CALIB_FED_IN_SUM (CALIB_POSITION_HAS_KI && !CALIB_POSITION_CLAMPING)

static inline void calib_pumps_off(calib_state *state, calib_outputs *out) {
    uint8_t i;
    memset(state->channel, 0, sizeof state->channel);
    for (i = 0; i < 2; i++) {
        out->pwm[i] = CALIB_PUMP_LOW_PWM;
        out->duty[i] = calib_whole(CALIB_PUMP_LOW_PWM);
    }
}

/* The controller that in->mode asks for. Returns flags. */
static inline uint16_t calib_control(calib_state *state, const calib_inputs *in, calib_outputs *out) {
    uint16_t flags = 0;
    uint8_t i, clamped, position = (uint8_t)(in->mode == CALIB_MODE_POSITION);
    if (in->mode != state->mode) {
        calib_pumps_off(state, out);
        state->mode = in->mode;
    }
    if (!position && in->mode != CALIB_MODE_ORIENTATION) {
        calib_pumps_off(state, out);
        return 0;
    }
    if (state->imu_age > CALIB_HOLD_TICKS || (position && state->marker_age > CALIB_HOLD_TICKS)) {
        calib_pumps_off(state, out);
        calib_count(state, CALIB_COUNT_STALE);
        return CALIB_STALE;
    }
    if (!calib_within(in->reference[0], CALIB_REFERENCE_LIMIT) ||
        (position && !calib_within(in->reference[1], CALIB_REFERENCE_LIMIT))) {
        calib_pumps_off(state, out);
        calib_count(state, CALIB_COUNT_REFERENCE);
        return CALIB_BAD_REFERENCE;
    }
    for (i = 0; i < 2; i++) {
        calib_channel *own = &state->channel[i];
        float e, u;
        if (position) {
            float wanted = in->reference[i];
            if (calib_bits(wanted) != calib_bits(own->fed_m)) {
                float fed = calib_feed_forward(wanted);
                if (CALIB_FED_IN_SUM) {
                    own->sum += fed - own->fed_pwm;
                }
                own->fed_m = wanted;
                own->fed_pwm = fed;
            }
            e = wanted - out->q_m[i];
            u = calib_pid(&own->sum, e, own->error, CALIB_POSITION_KPDI_PWM_PER_M,
                          CALIB_POSITION_KD_PER_DT_PWM_PER_M, CALIB_POSITION_KI_HALF_DT_PWM_PER_M,
                          CALIB_POSITION_HAS_KI, CALIB_POSITION_CLAMPING, &clamped);
            if (!CALIB_FED_IN_SUM) {
                u += own->fed_pwm;
            }
        } else {
            e = in->reference[0] - out->phi_rad;
            if (CALIB_ORIENTATION_SIGN < 0) {
                e = -e;
            }
            if (i) {
                e = -e;
            }
            u = calib_pid(&own->sum, e, own->error, CALIB_ORIENTATION_KPDI_PWM_PER_RAD,
                          CALIB_ORIENTATION_KD_PER_DT_PWM_PER_RAD, CALIB_ORIENTATION_KI_HALF_DT_PWM_PER_RAD,
                          CALIB_ORIENTATION_HAS_KI, CALIB_ORIENTATION_CLAMPING, &clamped);
        }
        own->error = e;
        if (clamped) {
            flags = (uint16_t)(flags | (CALIB_CLAMPED_1 << i));
        }
        if (!calib_in_limits(u)) {
            float limited = calib_above(u, CALIB_PUMP_HIGH_PWM) ? CALIB_PUMP_HIGH_PWM : CALIB_PUMP_LOW_PWM;
#if CALIB_ORIENTATION_HAS_BACK
            if (!position) {
                own->sum += CALIB_ORIENTATION_BACK * (limited - u);
            }
#endif
#if CALIB_POSITION_HAS_BACK
            if (position) {
                own->sum += CALIB_POSITION_BACK * (limited - u);
            }
#endif
            u = limited;
            flags = (uint16_t)(flags | (CALIB_SATURATED_1 << i));
        }
        out->pwm[i] = u;
        out->duty[i] = calib_whole(u);
    }
    if (flags & (CALIB_SATURATED_1 | CALIB_SATURATED_2)) {
        calib_count(state, CALIB_COUNT_SATURATED);
    }
    return flags;
}

/* One tick. Nothing in inputs has to be finite. */
static inline void calib_tick(calib_state *state, const calib_inputs *in, calib_outputs *out) {
    uint16_t flags;
#if CALIB_FUSED

    CALIB_STAGE(1);
    flags = calib_fuse(state, in, out);
    flags = (uint16_t)(flags | CALIB_BY_FUSED | (CALIB_RATE_IS_MEAN ? CALIB_BY_MEAN_RATE : 0u));
    out->marker_m[0] = state->marker_m[0];
    out->marker_m[1] = state->marker_m[1];
#else
    uint8_t afresh;
    float phi, w;

    CALIB_STAGE(1);
    flags = calib_angle(state, in);
    phi = state->phi_rad;
    out->phi_rad = phi;

    CALIB_STAGE(2);
    flags = (uint16_t)(flags | calib_marker(state, in, &afresh));
    out->marker_m[0] = state->marker_m[0];
    out->marker_m[1] = state->marker_m[1];

    CALIB_STAGE(3);
    if (state->marker_age != CALIB_NEVER) {
        float x, y, then = calib_then(state, phi, calib_late(in));
        w = then * then;
        x = state->marker_m[0] - calib_sin(CALIB_MARKER_OFFSET_M, then, w);
        y = state->marker_m[1] - calib_cos(CALIB_MARKER_OFFSET_M, w);
        CALIB_STAGE(4);
        if (afresh) {
            calib_lowpass_settle(state->lowpass[0], x);
            calib_lowpass_settle(state->lowpass[1], y);
        }
        out->head_m[0] = calib_lowpass(state->lowpass[0], x);
        out->head_m[1] = calib_lowpass(state->lowpass[1], y);
        CALIB_STAGE(5);
        calib_bellows(out->head_m[0], out->head_m[1], phi, w, out->q_m);
    } else {
        /* Until the first picture the actuator has its rest length. */
        out->head_m[0] = 0.0f;
        out->head_m[1] = CALIB_REST_LENGTH_M;
        out->q_m[0] = CALIB_REST_LENGTH_M + CALIB_BELLOWS_RADIUS_M * phi;
        out->q_m[1] = CALIB_REST_LENGTH_M - CALIB_BELLOWS_RADIUS_M * phi;
    }
    memmove(state->past_rad, state->past_rad + 1, sizeof state->past_rad - sizeof phi);
    state->past_rad[CALIB_PAST_TICKS - 1] = phi;
#endif

    CALIB_STAGE(6);
    out->flags = (uint16_t)(flags | calib_control(state, in, out));
    CALIB_STAGE(0);
}

#ifdef __cplusplus
}
#endif

#endif /* CALIB_PIPELINE_H */
