/*
 * One tick after the other, for a host (records on stdin and stdout) and for an AVR under a simulator that
 * fills `in` when GPIOR0 becomes 1 and fetches `out` when it becomes 2. CALIB_MOVING: the reference is a point
 * (x, y) that has to be turned into lengths in the same tick. CALIB_SELFTEST: the self-test instead of a tick.
 * CALIB_GUARDED: the guard before and after the tick, and with CALIB_MEASURE made to run in every one.
 */
#ifdef __AVR__
#include <avr/io.h>
#ifdef CALIB_MEASURE
#define CALIB_STAGE(n) (GPIOR1 = (n))
#endif
#else
#include <stdio.h>
#include <string.h>
#endif

#ifdef CALIB_GUARDED
#include "calib_guard.h"
static calib_guard guard;
#elif defined(CALIB_SELFTEST)
#include "calib_selftest.h"
#else
#include "calib_pipeline.h"
#endif

static calib_state state;
calib_inputs in;
calib_outputs out;

static void one_tick(void) {
#ifdef CALIB_SELFTEST
    out.flags = calib_selftest();
    return;
#endif
#ifdef CALIB_MOVING
    if (in.mode == CALIB_MODE_POSITION) {
        float x = in.reference[0], y = in.reference[1];
        calib_reference_point(x, y, in.reference);
    }
#endif
#ifdef CALIB_GUARDED
#ifdef CALIB_MEASURE
    guard.state = CALIB_RUN;
#endif
    in.mode = calib_guard_mode(&guard, in.mode, in.reference);
#endif
    calib_tick(&state, &in, &out);
#ifdef CALIB_GUARDED
    calib_guard_tick(&guard, &state, &in, &out);
#endif
}

#ifdef __AVR__
int main(void) {
    calib_start(&state);
    for (;;) {
        GPIOR0 = 1;
        /* The simulator has changed `in`. */
        __asm__ volatile("" ::: "memory");
        one_tick();
        __asm__ volatile("" ::: "memory");
        GPIOR0 = 2;
    }
}
#else
int main(int argc, char **argv) {
    unsigned char bytes[35];
    (void)argv;
    calib_start(&state);
#ifdef CALIB_GUARDED
    calib_guard_start(&guard);
    calib_guard_ready(&guard, 1);
#endif
    while (fread(bytes, sizeof bytes, 1, stdin) == 1) {
        memcpy(&in, bytes, sizeof bytes);
        one_tick();
        fwrite(&out, 40, 1, stdout);
        fwrite(state.count, sizeof state.count, 1, stdout);
        if (argc > 1) {
            fflush(stdout);
        }
    }
    return 0;
}
#endif
