/*
 * calib_guard.h - whether the pumps may run. To be asked before and after each tick:
 *
 *   calib_guard guard;                                calib_guard_start(&guard) once, pumps off
 *   calib_guard_ready(&guard, calib_selftest() == 0)  after the self-test
 *   in.mode = calib_guard_mode(&guard, wanted, in.reference);
 *   calib_tick(&state, &in, &out);
 *   calib_guard_tick(&guard, &state, &in, &out);      out.duty is 0 now unless the pumps may run
 *
 *   BOOT    until the self-test has passed
 *   ARMED   pumps off; RUN where a mode is wanted and the sensors were sound for CALIB_GUARD_QUIET_TICKS
 *   RUN     pumps as commanded
 *   FAULT   pumps off, guard.fault tells why
 *
 * fault                      after                                               ends
 *   CALIB_FAULT_SELFTEST     the self-test failed                                at a reset
 *   CALIB_FAULT_IMU_LOST     12 samples in a row lost, weightless or beyond 3 g,  by itself
 *                            or more than a fifth of them for long
 *   CALIB_FAULT_IMU_FROZEN   12 times the very same sample, or 72 times the same  by itself
 *                            rate or the same force
 *   CALIB_FAULT_CAMERA_LOST  the marker not seen for 15 ticks, or two ticks old  by itself
 *                            in more than a fifth of them, where a mode needs it
 *   CALIB_FAULT_CAMERA_FROZEN the marker on one pixel while the angle turns      by itself
 *   CALIB_FAULT_APART        marker and angle of two places for half a second    by itself
 *   CALIB_FAULT_REACH        angle or lengths beyond the envelope for 6 ticks    by calib_guard_clear
 *   CALIB_FAULT_RATE         lengths that change faster than the envelope says   by calib_guard_clear
 *   CALIB_FAULT_FULL_POWER   a pump at its greatest command for longer than the  by calib_guard_clear
 *                            envelope says
 *   CALIB_FAULT_LONG         in open loop a pump on for longer than the envelope  by calib_guard_clear
 *                            says, less four times what it was off
 *   CALIB_FAULT_REFERENCE    a reference beyond the envelope, at once            with the next good one
 *   CALIB_FAULT_LATE, _HOST  told by the program: ticks too late, host silent    by themselves
 * What ends by itself does so after CALIB_GUARD_QUIET_TICKS without a cause, doubled with each of CALIB_GUARD_TRIES;
 * then it stays as well. The envelope stands in calib_constants.h.
 */
#ifndef CALIB_GUARD_H
#define CALIB_GUARD_H

#include "calib_pipeline.h"

/* Constants without a plane control nothing. */
#if CALIB_HAS_PLANE && (!CALIB_RIG_OK || CALIB_SIMULATED) && (defined(__AVR__) || defined(ARDUINO)) && \
    !defined(CALIB_I_KNOW)
#error "calib: these constants are not ok or of a simulated rig, calib_constants.h says which; CALIB_I_KNOW 1 takes them"
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* guard.state */
#define CALIB_BOOT 0
#define CALIB_ARMED 1
#define CALIB_RUN 2
#define CALIB_FAULT 3

/* guard.fault; those from CALIB_FAULT_STAYS on end by calib_guard_clear alone. */
#define CALIB_FAULT_NONE 0
#define CALIB_FAULT_IMU_LOST 1
#define CALIB_FAULT_IMU_FROZEN 2
#define CALIB_FAULT_CAMERA_LOST 3
#define CALIB_FAULT_CAMERA_FROZEN 4
#define CALIB_FAULT_APART 5
#define CALIB_FAULT_REFERENCE 6
#define CALIB_FAULT_LATE 7
#define CALIB_FAULT_HOST 8
#define CALIB_FAULT_STAYS 16
#define CALIB_FAULT_REACH 16
#define CALIB_FAULT_RATE 17
#define CALIB_FAULT_FULL_POWER 18
#define CALIB_FAULT_SELFTEST 19
#define CALIB_FAULT_WATCHDOG 20 /* of a program that keeps it over a reset */
#define CALIB_FAULT_LONG 21

/* A mode beside those of the pipeline: reference[] are commands that the program gives itself, PWM. */
#define CALIB_MODE_OPEN 3

#define CALIB_GUARD_QUIET_TICKS 30
#define CALIB_GUARD_TRIES 5
#define CALIB_GUARD_SOUND_TICKS 600 /* in RUN, after which the tries begin anew */

/* A bad tick counts four times what a good one takes away: a fifth of bad ones is too many. */
#define CALIB_GUARD_BAD 4
#define CALIB_GUARD_IMU_BAD (12 * CALIB_GUARD_BAD)
#define CALIB_GUARD_CAMERA_BAD (14 * CALIB_GUARD_BAD)
#define CALIB_GUARD_SAME 12
/* Of one sensor alone. At rest a gyroscope whose noise is 0.4 of its step repeats itself four times of five. */
#define CALIB_GUARD_SAME_ONE 72
#define CALIB_GUARD_SHAKEN_MPS2 30.0f /* specific force that a rig has for moments only */
#define CALIB_GUARD_FROZEN_RAD 0.25f /* angle that moves the marker by pixels */
/* The fused angle follows the pictures: from the accelerometer's, on the mean of some 30 ticks. */
#define CALIB_GUARD_LEANS_RAD 0.2f
#define CALIB_GUARD_FROZEN 6
#define CALIB_GUARD_APART (8 * CALIB_GUARD_BAD) /* in fourths of the ticks, as the rate */
#define CALIB_GUARD_REACH (6 * CALIB_GUARD_BAD)
#define CALIB_GUARD_RATE (2 * CALIB_GUARD_BAD)

typedef struct {
    uint32_t imu[3], pixel[2];            /* bits of the last sample, and of the last marker */
    float marker_m[2], tangent;           /* of the last fourth tick: marker, tangent of half the angle */
    float phi_rad;                        /* angle when the marker came to that pixel */
#if CALIB_FUSED
    float leans_rad;                      /* mean pull of the accelerometer */
#endif
    float q_m[2];                         /* lengths four ticks ago */
    uint16_t full[2];                     /* ticks at full power, less those below it */
    uint16_t on[2];                       /* ticks in open loop with a command, less four times those without */
    uint16_t quiet, sound;                /* ticks without a cause; ticks in RUN */
    uint8_t imu_bad, rate_same, force_same, camera_bad, frozen, apart, reach, rate;
    uint8_t state, fault, tries, needs_camera, turn, shown;
} calib_guard;

static inline void calib_guard_start(calib_guard *guard) {
    memset(guard, 0, sizeof *guard);
}

/* One bad or good tick for a count that stops at its limit, so that it soon is 0 again. */
static inline uint8_t calib_guard_counted(uint8_t count, uint8_t bad, uint8_t limit) {
    if (bad) {
        return count > limit - CALIB_GUARD_BAD ? limit : (uint8_t)(count + CALIB_GUARD_BAD);
    }
    return count ? (uint8_t)(count - 1u) : 0;
}

/*
 * Something is wrong: pumps off from now on. Of several causes the one that stays is kept, and a bad reference, which
 * the next good one ends, comes after all others.
 */
static inline void calib_guard_fault(calib_guard *guard, uint8_t fault) {
    guard->quiet = 0;
    if (guard->state == CALIB_FAULT && (guard->fault >= CALIB_FAULT_STAYS || fault == CALIB_FAULT_REFERENCE)) {
        return;
    }
    if (guard->state != CALIB_FAULT && fault != CALIB_FAULT_REFERENCE) {
        guard->tries++;
    }
    guard->state = CALIB_FAULT;
    guard->fault = fault;
}

/* After the self-test. */
static inline void calib_guard_ready(calib_guard *guard, uint8_t passed) {
    if (passed && guard->state == CALIB_BOOT) {
        guard->state = CALIB_ARMED;
    } else if (!passed) {
        calib_guard_fault(guard, CALIB_FAULT_SELFTEST);
    }
}

/* A person has looked: back to ARMED, but not from a failed self-test. How long pumps were on is not forgotten. */
static inline void calib_guard_clear(calib_guard *guard) {
    if (guard->state == CALIB_FAULT && guard->fault != CALIB_FAULT_SELFTEST) {
        guard->state = CALIB_ARMED;
        guard->fault = CALIB_FAULT_NONE;
        guard->tries = 0;
        guard->quiet = 0;
    }
}

/* Whether a length is within the envelope; false for NaN. */
static inline uint8_t calib_guard_length(float q_m) {
    return (uint8_t)(calib_within(q_m, CALIB_ENVELOPE_GREATEST_M) && !calib_negative(q_m) &&
                     calib_bits(q_m) >= calib_bits(CALIB_ENVELOPE_LEAST_M));
}

/* The mode for this tick: the wanted one where the pumps may run, else CALIB_MODE_OFF. */
static inline uint8_t calib_guard_mode(calib_guard *guard, uint8_t wanted, const float *reference) {
    uint8_t good = 1;
    if (wanted == CALIB_MODE_ORIENTATION) {
        good = calib_within(reference[0], CALIB_ENVELOPE_ANGLE_RAD);
    } else if (wanted == CALIB_MODE_POSITION) {
        good = (uint8_t)(calib_guard_length(reference[0]) && calib_guard_length(reference[1]));
    } else if (wanted == CALIB_MODE_OPEN) {
        uint8_t i;
        for (i = 0; i < 2; i++) {
            good = (uint8_t)(good && !calib_negative(reference[i]) &&
                             calib_within(reference[i], CALIB_ENVELOPE_OPEN_HIGH_PWM));
        }
    } else {
        wanted = CALIB_MODE_OFF;
    }
    guard->needs_camera =
        (uint8_t)(wanted == CALIB_MODE_POSITION || (CALIB_FUSED && wanted != CALIB_MODE_OPEN));
    if (!good && guard->state != CALIB_BOOT) {
        calib_guard_fault(guard, CALIB_FAULT_REFERENCE);
    } else if (guard->fault == CALIB_FAULT_REFERENCE) {
        guard->state = CALIB_ARMED;
        guard->fault = CALIB_FAULT_NONE;
    }
    if (wanted == CALIB_MODE_OFF) {
        if (guard->state == CALIB_RUN) {
            guard->state = CALIB_ARMED;
        }
    } else if (guard->state == CALIB_ARMED && guard->quiet >= CALIB_GUARD_QUIET_TICKS) {
        guard->state = CALIB_RUN;
        guard->sound = 0;
    }
    return guard->state == CALIB_RUN ? wanted : CALIB_MODE_OFF;
}

/* How many readings in a row are the same. */
static inline uint8_t calib_guard_again(uint8_t count, uint8_t same) {
    return same ? (uint8_t)(count + (count < CALIB_GUARD_SAME_ONE)) : 0;
}

/* Whether readings of the IMU stand still. */
static inline uint8_t calib_guard_frozen(const calib_guard *guard) {
    return (uint8_t)((guard->rate_same >= CALIB_GUARD_SAME && guard->force_same >= CALIB_GUARD_SAME) ||
                     guard->rate_same >= CALIB_GUARD_SAME_ONE || guard->force_same >= CALIB_GUARD_SAME_ONE);
}

/* Health of the IMU in this tick. */
static inline uint8_t calib_guard_imu(calib_guard *guard, const calib_state *state, const calib_inputs *in,
                                      uint16_t flags) {
    uint8_t lost = (uint8_t)(state->imu_age != 0 || (flags & CALIB_ACCEL_WEAK) ||
                             !calib_within(in->ax_mps2, CALIB_GUARD_SHAKEN_MPS2) ||
                             !calib_within(in->ay_mps2, CALIB_GUARD_SHAKEN_MPS2));
    guard->imu_bad = calib_guard_counted(guard->imu_bad, lost, CALIB_GUARD_IMU_BAD);
    if (in->imu_read) {
        uint32_t ax = calib_bits(in->ax_mps2), ay = calib_bits(in->ay_mps2), gz = calib_bits(in->gz_radps);
        guard->force_same =
            calib_guard_again(guard->force_same, (uint8_t)(ax == guard->imu[0] && ay == guard->imu[1]));
        guard->rate_same = calib_guard_again(guard->rate_same, (uint8_t)(gz == guard->imu[2]));
        guard->imu[0] = ax;
        guard->imu[1] = ay;
        guard->imu[2] = gz;
    }
    if (calib_guard_frozen(guard)) {
        return CALIB_FAULT_IMU_FROZEN;
    }
    return guard->imu_bad >= CALIB_GUARD_IMU_BAD ? CALIB_FAULT_IMU_LOST : CALIB_FAULT_NONE;
}

/* Health of the camera, by itself and against the angle; the latter is spread over four ticks. */
static inline uint8_t calib_guard_camera(calib_guard *guard, const calib_state *state, const calib_inputs *in,
                                         const calib_outputs *out) {
    uint8_t shown = (uint8_t)(state->marker_age == 0);
    /* Where pictures come as often as ticks and with them, each second or third tick has none and the next has two. */
    guard->camera_bad =
        calib_guard_counted(guard->camera_bad, (uint8_t)(state->marker_age > 1), CALIB_GUARD_CAMERA_BAD);
    if (shown) {
        uint32_t u = calib_bits(in->u_px), v = calib_bits(in->v_px);
        if (u != guard->pixel[0] || v != guard->pixel[1]) {
            guard->pixel[0] = u;
            guard->pixel[1] = v;
            guard->phi_rad = out->phi_rad;
            guard->frozen = 0;
        } else if (calib_within(out->phi_rad - guard->phi_rad, CALIB_GUARD_FROZEN_RAD)) {
            guard->frozen = 0;
        } else if (guard->frozen < CALIB_GUARD_FROZEN) {
            guard->frozen++;
        }
    }
    if (guard->turn == 0) {
#if CALIB_FUSED
        float phi = out->phi_rad;
#else
        /* When the picture was exposed: a head that swings before a slow camera is elsewhere by now. */
        float phi = state->past_rad[0];
#endif
        /* The tangent of half the angle, to 0.03 up to 1.4 rad. */
        guard->tangent = phi * (0.5f + phi * phi * 0.0416666679f);
        guard->marker_m[0] = out->marker_m[0];
        guard->marker_m[1] = out->marker_m[1];
        guard->shown = shown;
    } else if (guard->turn == 1 && guard->shown) {
        float across = guard->marker_m[0] - guard->tangent * (guard->marker_m[1] + CALIB_MARKER_OFFSET_M);
        uint8_t off = (uint8_t)!calib_within(across, CALIB_ENVELOPE_APART_M);
#if CALIB_FUSED
        off = (uint8_t)(off || !calib_within(guard->leans_rad, CALIB_GUARD_LEANS_RAD * CALIB_FUSED_ACCEL_GAIN));
#endif
        guard->apart = calib_guard_counted(guard->apart, off, CALIB_GUARD_APART);
    }
#if CALIB_FUSED
    if (guard->turn == 3) {
        guard->leans_rad = state->pull_rad + 0.875f * (guard->leans_rad - state->pull_rad);
    }
#endif
    if (guard->camera_bad >= CALIB_GUARD_CAMERA_BAD) {
        return CALIB_FAULT_CAMERA_LOST;
    }
    if (guard->frozen >= CALIB_GUARD_FROZEN) {
        return CALIB_FAULT_CAMERA_FROZEN;
    }
    return guard->apart >= CALIB_GUARD_APART ? CALIB_FAULT_APART : CALIB_FAULT_NONE;
}

/* Whether a pump has been on for too long in open loop, where nothing else knows how full a bellows is. */
static inline uint8_t calib_guard_open(calib_guard *guard, const calib_outputs *out, uint8_t open) {
    uint8_t i;
    for (i = 0; i < 2; i++) {
        if (!open || out->duty[i] == 0) {
            guard->on[i] = guard->on[i] > 4 ? (uint16_t)(guard->on[i] - 4u) : 0;
        } else if (++guard->on[i] >= CALIB_ENVELOPE_OPEN_TICKS) {
            return CALIB_FAULT_LONG;
        }
    }
    return CALIB_FAULT_NONE;
}

/* Whether the actuator is where and, every fourth tick, as fast as the envelope allows; lengths need the camera. */
static inline uint8_t calib_guard_envelope(calib_guard *guard, const calib_outputs *out, uint8_t lengths) {
    uint8_t i, beyond = (uint8_t)!calib_within(out->phi_rad, CALIB_ENVELOPE_ANGLE_RAD), fast = 0;
    for (i = 0; i < 2; i++) {
        if (lengths && !calib_guard_length(out->q_m[i])) {
            beyond = 1;
        }
        if (guard->turn == 2) {
            if (lengths && !calib_within(out->q_m[i] - guard->q_m[i], 4.0f * CALIB_ENVELOPE_STEP_M)) {
                fast = 1;
            }
            guard->q_m[i] = out->q_m[i];
        }
        if (out->duty[i] < CALIB_PUMP_HIGH) {
            guard->full[i] = guard->full[i] ? (uint16_t)(guard->full[i] - 1u) : 0;
        } else if (++guard->full[i] >= CALIB_ENVELOPE_FULL_TICKS) {
            return CALIB_FAULT_FULL_POWER;
        }
    }
    guard->reach = calib_guard_counted(guard->reach, beyond, CALIB_GUARD_REACH);
    if (guard->turn == 2) {
        guard->rate = calib_guard_counted(guard->rate, fast, CALIB_GUARD_RATE);
    }
    guard->turn = (uint8_t)((guard->turn + 1u) & 3u);
    if (guard->reach >= CALIB_GUARD_REACH) {
        return CALIB_FAULT_REACH;
    }
    return guard->rate >= CALIB_GUARD_RATE ? CALIB_FAULT_RATE : CALIB_FAULT_NONE;
}

/* After a tick: out->duty stays where the pumps may run, and is 0 elsewhere. */
static inline void calib_guard_tick(calib_guard *guard, const calib_state *state, const calib_inputs *in,
                                    calib_outputs *out) {
    uint8_t imu = calib_guard_imu(guard, state, in, out->flags);
    uint8_t camera = calib_guard_camera(guard, state, in, out);
    /* A camera that shows something must not show something else, needed or not. */
    uint8_t fault = camera == CALIB_FAULT_CAMERA_LOST && !guard->needs_camera ? CALIB_FAULT_NONE : camera;
    uint8_t envelope = calib_guard_envelope(guard, out, (uint8_t)(camera == CALIB_FAULT_NONE));
    if (imu) {
        fault = imu;
    }
    if (!envelope) {
        envelope = calib_guard_open(guard, out, (uint8_t)(in->mode == CALIB_MODE_OPEN));
    }
    if (guard->state == CALIB_RUN) {
        if (!fault) {
            fault = envelope;
        }
        if (fault) {
            calib_guard_fault(guard, fault);
        } else if (guard->tries && ++guard->sound >= CALIB_GUARD_SOUND_TICKS) {
            guard->tries = 0;
        }
    }
    if (fault || guard->imu_bad || state->imu_age == CALIB_NEVER ||
        (guard->needs_camera && (guard->camera_bad || state->marker_age == CALIB_NEVER))) {
        guard->quiet = 0;
    } else if (guard->quiet < 0xFFFFu) {
        guard->quiet++;
    }
    if (guard->state == CALIB_FAULT && guard->fault < CALIB_FAULT_STAYS && guard->fault != CALIB_FAULT_REFERENCE &&
        guard->tries <= CALIB_GUARD_TRIES && guard->quiet >= ((uint16_t)((uint16_t)CALIB_GUARD_QUIET_TICKS << guard->tries))) {
        guard->state = CALIB_ARMED;
        guard->fault = CALIB_FAULT_NONE;
    }
    if (guard->state != CALIB_RUN) {
        out->duty[0] = 0;
        out->duty[1] = 0;
    }
}

/* What the self-test turns: a guard, and what it looks at. */
typedef struct {
    calib_inputs in;
    calib_outputs out;
    calib_guard guard;
    calib_state state;
} calib_trial;

/*
 * One tick of a sound rig for the self-test, k its number: bent, one axis of the IMU changes in each tick, the pixel in
 * each sixteenth, and the marker is where the angle puts it (the series of above, in half the angle).
 */
static inline void calib_trial_sound(calib_trial *of, uint8_t k) {
    float phi = 0.8f * CALIB_ENVELOPE_ANGLE_RAD, h = 0.5f * phi, w = h * h;
    uint8_t third = (uint8_t)(k % 6u);
    of->state.imu_age = 0;
    of->state.marker_age = (uint16_t)((k & 15u) == 15u);
#if CALIB_FUSED
    of->state.pull_rad = 0.0f;
#else
    of->state.past_rad[0] = phi;
#endif
    of->in.imu_read = 1;
    of->in.ax_mps2 = (uint8_t)(third - 1u) < 3u ? 9.01f : 9.0f;
    of->in.ay_mps2 = (uint8_t)(third - 2u) < 3u ? 0.51f : 0.5f;
    of->in.gz_radps = third < 3u ? 0.1f : 0.11f;
    of->in.u_px = (float)((k >> 4) + 1);
    of->in.reference[0] = CALIB_ENVELOPE_LEAST_M;
    of->in.reference[1] = CALIB_ENVELOPE_LEAST_M;
    of->out.flags = 0;
    of->out.phi_rad = phi;
    of->out.marker_m[0] = h * (1.0f + w * 0.333333343f) * (CALIB_REST_LENGTH_M + CALIB_MARKER_OFFSET_M);
    of->out.marker_m[1] = CALIB_REST_LENGTH_M;
    of->out.q_m[0] = CALIB_ENVELOPE_LEAST_M;
    of->out.q_m[1] = CALIB_ENVELOPE_LEAST_M;
    of->out.duty[0] = 1;
    of->out.duty[1] = 1;
}

/* One tick of the guard. Whether a pump is on. */
static inline uint8_t calib_trial_once(calib_trial *of, uint8_t mode) {
    of->in.mode = calib_guard_mode(&of->guard, mode, of->in.reference);
    calib_guard_tick(&of->guard, &of->state, &of->in, &of->out);
    return (uint8_t)(of->out.duty[0] || of->out.duty[1]);
}

/* Ticks of a sound rig until a pump is on, no more than `most`; 0xFFFF for never. */
static inline uint16_t calib_trial_until(calib_trial *of, uint16_t most) {
    uint16_t k;
    for (k = 0; k < most; k++) {
        calib_trial_sound(of, (uint8_t)k);
        if (calib_trial_once(of, CALIB_MODE_POSITION)) {
            return k;
        }
    }
    return 0xFFFFu;
}

/* From the start to where it waits for sound ticks. Whether a pump was on before. */
static inline uint8_t calib_trial_start(calib_trial *of) {
    uint8_t on;
    memset(of, 0, sizeof *of);
    calib_guard_start(&of->guard);
    calib_trial_sound(of, 0);
    on = calib_trial_once(of, CALIB_MODE_POSITION);
    calib_guard_ready(&of->guard, 1);
    return on;
}

/*
 * Ticks until one fault stops pumps that run, and 256 times those until they run again, after calib_guard_clear where
 * that is needed; 0 when they did not run before it or ran again without, 255 when it never stopped them. CALIB_FAULT_NONE is a lost camera that nothing needs.
 *
 * Of most faults there are two kinds: of the first bellows or the second, in each tick or in each second one.
 */
static inline uint16_t calib_guard_try(calib_trial *of, uint8_t fault, uint8_t kind) {
    uint8_t k, mode = CALIB_MODE_POSITION;
    if (calib_trial_start(of) || calib_trial_until(of, 140) != 29 ||
        of->guard.state != CALIB_RUN) {
        return 0;
    }
    /* A mode that nobody knows is none. */
    if (calib_trial_once(of, CALIB_MODE_OPEN + 1) || of->guard.state != CALIB_ARMED) {
        return 0;
    }
    for (k = 1; k < 255; k++) {
        calib_trial_sound(of, k);
        switch (fault) {
        case CALIB_FAULT_IMU_LOST:
            of->state.imu_age = (uint16_t)(k & 1u || !kind);
            break;
        case CALIB_FAULT_IMU_FROZEN:
            /* Of both sensors, of the accelerometer, of the gyroscope. */
            if (kind != 2) {
                of->in.ax_mps2 = 9.0f;
                of->in.ay_mps2 = 0.5f;
            }
            if (kind != 1) {
                of->in.gz_radps = 0.1f;
            }
            break;
        case CALIB_FAULT_NONE:
            mode = CALIB_MODE_ORIENTATION;
            of->in.reference[0] = 0.0f;
            of->state.marker_age = 2;
            break;
        case CALIB_FAULT_CAMERA_LOST:
            of->state.marker_age = (uint16_t)(k & 1u || !kind ? 2 : 0);
            break;
        case CALIB_FAULT_CAMERA_FROZEN:
            mode = CALIB_MODE_ORIENTATION;
            of->in.reference[0] = 0.0f;
            of->in.u_px = -1.0f;
            of->in.v_px = 7.0f;
            /* As it was once or never, then just beyond CALIB_GUARD_FROZEN_RAD: no longer than a narrow envelope bears. */
            of->out.phi_rad -= k + kind > 2 ? 0.2525f : 0.0f;
            break;
        case CALIB_FAULT_APART:
#if CALIB_FUSED
            if (kind == 2) {
                of->state.pull_rad = -CALIB_FUSED_ACCEL_GAIN;
                break;
            }
#endif
            of->out.marker_m[0] += kind ? -1.004f * CALIB_ENVELOPE_APART_M : 1.004f * CALIB_ENVELOPE_APART_M;
            break;
        case CALIB_FAULT_REFERENCE:
            if (kind > 2) {
                mode = CALIB_MODE_OPEN;
                of->in.reference[kind - 3u] = -1.0f;
            } else if (kind > 1) {
                mode = CALIB_MODE_ORIENTATION;
                of->in.reference[0] = 1.1f * CALIB_ENVELOPE_ANGLE_RAD;
            } else {
                of->in.reference[kind] = 2.0f * CALIB_ENVELOPE_GREATEST_M;
            }
            break;
        case CALIB_FAULT_REACH:
            of->out.q_m[kind] = 2.0f * CALIB_ENVELOPE_GREATEST_M;
            break;
        case CALIB_FAULT_RATE:
            of->out.q_m[kind] = CALIB_ENVELOPE_LEAST_M + ((k & 4) ? 5.0f * CALIB_ENVELOPE_STEP_M : 0.0f);
            break;
        case CALIB_FAULT_LONG:
            /* One tick in closed loop takes four off. */
            if (k == 1) {
                of->guard.on[kind] = CALIB_ENVELOPE_OPEN_TICKS + 2;
            } else {
                mode = CALIB_MODE_OPEN;
                of->in.reference[0] = 1.0f;
                of->in.reference[1] = CALIB_ENVELOPE_OPEN_HIGH_PWM;
            }
            break;
        default:
            /* One tick below full power, which takes one off, then at it. */
            if (k == 1) {
                of->guard.full[kind] = CALIB_ENVELOPE_FULL_TICKS - 2;
            } else {
                of->out.duty[kind] = (uint8_t)CALIB_PUMP_HIGH_PWM;
            }
            break;
        }
        if (calib_trial_once(of, mode)) {
            if (fault == CALIB_FAULT_NONE && k > 30) {
                return 1;
            }
        } else if (of->guard.state != CALIB_FAULT || of->guard.fault != fault) {
            return 255;
        } else {
            uint16_t again;
            /* To want nothing clears nothing but a bad reference. */
            if (calib_trial_once(of, CALIB_MODE_OFF) ||
                (of->guard.state == CALIB_FAULT) != (fault != CALIB_FAULT_REFERENCE)) {
                return 0;
            }
            if (fault >= CALIB_FAULT_STAYS) {
                calib_guard_fault(&of->guard, CALIB_FAULT_LATE);
                if (calib_trial_until(of, 140) != 0xFFFFu) {
                    return 0;
                }
                calib_guard_clear(&of->guard);
            }
            again = calib_trial_until(of, 140);
            if (of->guard.fault != CALIB_FAULT_NONE || of->guard.tries != (fault < CALIB_FAULT_REFERENCE)) {
                return 0;
            }
            return (uint16_t)(k + 256u * again);
        }
    }
    return 255;
}

/*
 * Whether the pumps wait twice as long after each of five faults and for ever after the next, which a bad reference does
 * not end; 600 sound ticks make them good. Numbers stand here once more, so that none of above can change.
 */
static inline uint8_t calib_guard_patient(calib_trial *of) {
    uint16_t wait;
    uint8_t k, tries;
    (void)calib_trial_start(of);
    of->guard.quiet = 0xFFFFu;
    if (calib_trial_once(of, CALIB_MODE_OFF) || calib_trial_until(of, 1)) {
        return 0;
    }
    /* Where nothing is wrong, to clear is nothing. */
    calib_guard_clear(&of->guard);
    if (calib_trial_until(of, 1)) {
        return 0;
    }
    for (wait = 60; wait < 1000; wait = (uint16_t)(2u * wait)) {
        /* Twice is once. */
        calib_guard_fault(&of->guard, CALIB_FAULT_LATE);
        calib_guard_fault(&of->guard, CALIB_FAULT_LATE);
        of->guard.quiet = (uint16_t)(wait - 5u);
        if (calib_trial_until(of, 10) != 5) {
            return 0;
        }
    }
    calib_guard_fault(&of->guard, CALIB_FAULT_LATE);
    of->in.reference[0] = 2.0f * CALIB_ENVELOPE_GREATEST_M;
    if (calib_trial_once(of, CALIB_MODE_POSITION)) {
        return 0;
    }
    of->guard.quiet = 0xFFFFu;
    if (calib_trial_until(of, 10) != 0xFFFFu) {
        return 0;
    }
    calib_guard_clear(&of->guard);
    (void)calib_trial_until(of, 100);
    calib_guard_fault(&of->guard, CALIB_FAULT_LATE);
    if (calib_trial_until(of, 100) != 60) {
        return 0;
    }
    of->guard.sound = (uint16_t)(of->guard.sound + 590u);
    for (k = 2; k < 10; k++) {
        (void)calib_trial_until(of, 1);
    }
    tries = of->guard.tries;
    (void)calib_trial_until(of, 1);
    if (tries != 1 || of->guard.tries != 0) {
        return 0;
    }
    calib_guard_ready(&of->guard, 0);
    calib_guard_clear(&of->guard);
    return of->guard.fault == CALIB_FAULT_SELFTEST;
}

/* 0 when every fault stops the pumps in its tick and no longer, else the number of the first that does not. */
static inline uint8_t calib_guard_selftest(void) {
    /* Fault, kind, tick, ticks until it is over. The fused estimator always needs the camera, and has one kind more. */
    static const uint8_t tries[25][4] = {
        {CALIB_FAULT_IMU_LOST, 0, 12, 107},     {CALIB_FAULT_IMU_LOST, 1, 31, 107},
        {CALIB_FAULT_IMU_FROZEN, 0, 13, 61},    {CALIB_FAULT_IMU_FROZEN, 1, 71, 61},
        {CALIB_FAULT_IMU_FROZEN, 2, 73, 63},
        {CALIB_FAULT_CAMERA_LOST, 0, 14, 115},
        {CALIB_FAULT_CAMERA_LOST, 1, 37, 115},  {CALIB_FAULT_CAMERA_FROZEN, 0, 8, 60},
        {CALIB_FAULT_CAMERA_FROZEN, 1, 7, 60},
        {CALIB_FAULT_APART, 0, 30, 62},         {CALIB_FAULT_APART, 1, 30, 62},
        {CALIB_FAULT_REFERENCE, 0, 1, 28},      {CALIB_FAULT_REFERENCE, 1, 1, 28},
        {CALIB_FAULT_REFERENCE, 2, 1, 28},      {CALIB_FAULT_REFERENCE, 3, 1, 28},
        {CALIB_FAULT_REFERENCE, 4, 1, 28},
        {CALIB_FAULT_REACH, 0, 6, 30},          {CALIB_FAULT_REACH, 1, 6, 30},
        {CALIB_FAULT_RATE, 0, 11, 30},          {CALIB_FAULT_RATE, 1, 11, 30},
        {CALIB_FAULT_FULL_POWER, 0, 4, 30},     {CALIB_FAULT_FULL_POWER, 1, 4, 30},
        {CALIB_FAULT_LONG, 0, 3, 30},           {CALIB_FAULT_LONG, 1, 3, 30},
#if CALIB_FUSED
        {CALIB_FAULT_APART, 2, 38, 98}};
#else
        {CALIB_FAULT_NONE, 0, 1, 0}};
#endif
    static calib_trial trial;
    uint8_t i;
    for (i = 0; i < 25; i++) {
        if (calib_guard_try(&trial, tries[i][0], tries[i][1]) != tries[i][2] + 256u * tries[i][3]) {
            return (uint8_t)(i + 1u);
        }
    }
    return calib_guard_patient(&trial) ? 0 : 26;
}

#ifdef __cplusplus
}
#endif

#endif /* CALIB_GUARD_H */
