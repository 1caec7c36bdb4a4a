/*
 * calib_example - the pipeline on a board with the Arduino core: IMU on I2C, Pixy2, two pumps on pins 9 and 10.
 *
 * Keep this file in one folder with the headers that `calib firmware` wrote beside it. It serves `calib record`:
 * every tick goes out as a frame, or samples of the sensors at their own times while the computer drives the pumps in
 * open loop within the envelope (frames: calib_link.h). With constants that have no plane it does the latter alone.
 *
 * The pumps stay off until CALIB_EXAMPLE_MODE is set to something else than CALIB_MODE_OFF. With
 * CALIB_EXAMPLE_HEARTBEAT 1 they moreover stop where no frame came from the computer for CALIB_LINK_SILENT_MS; in open
 * loop they always do.
 *
 * Before including, or as flags: CALIB_IMU_MPU6050 1 for that IMU instead of the BNO055, CALIB_PIXY2_I2C 1 for the
 * camera on I2C instead of SPI, CALIB_I2C_HZ.
 *
 * A loop that does not come round, as on a bus that hangs, is stopped by the watchdog: pumps off within 62 ms (125 ms
 * where a tick takes more than 25 ms), then a reset. A sensor that does not answer, or is not what it should be, is
 * started anew, ever more seldom.
 */
#define CALIB_PROGMEM 1
#define CALIB_EXPECT_SCHEMA 8
#define CALIB_EXPECT_PUMP_HIGH 255

#include <Arduino.h>
#if defined(__AVR__)
#include <avr/interrupt.h>
#include <avr/wdt.h>
#endif

#include "calib_guard.h"
#include "calib_link.h"
#include "calib_selftest.h"
#if defined(CALIB_IMU_MPU6050)
#include "calib_mpu6050.h"
#else
#include "calib_bno055.h"
#endif
#include "calib_pixy2.h"

#if CALIB_TICK_RATE_MHZ < 16000 || CALIB_TICK_RATE_MHZ > 110000
#error "calib: this sketch ticks 16 to 110 times a second: the watchdog bears no longer, the serial port no more"
#endif
#ifndef CALIB_EXAMPLE_MODE
#define CALIB_EXAMPLE_MODE CALIB_MODE_OFF
#endif
#ifndef CALIB_EXAMPLE_HEARTBEAT
#define CALIB_EXAMPLE_HEARTBEAT 0
#endif

static const uint8_t PUMP_PINS[2] = {9, 10};
static const uint32_t TICK_US = 1000000000UL / CALIB_TICK_RATE_MHZ, SAMPLE_US = 10000;

static calib_state state;
static calib_inputs in;
static calib_outputs out;
static calib_guard guard;
static calib_link link;
static uint16_t ticks, samples;
static uint32_t next_us, sample_us, imu_us, asked_us, picture_us;
static uint8_t sampling, overruns;
static float force[3], rate[3];

/* Why the pumps were stopped last: kept over a reset and told in every frame, until a person clears it or the supply goes. */
#define CHECK_OF(fault) ((uint16_t)(0xC5A0u ^ (uint16_t)((fault) * 257u)))
#if defined(__AVR__)
static uint8_t kept_fault __attribute__((section(".noinit")));
static uint16_t kept_check __attribute__((section(".noinit")));

/* Before anything else: a watchdog that is still on would end the start, and its period is short. */
void calib_early(void) __attribute__((naked, used, section(".init3")));
void calib_early(void) {
    MCUSR = 0;
    wdt_disable();
}

static void keep(uint8_t fault) {
    kept_fault = fault;
    kept_check = CHECK_OF(fault);
}

/* The loop did not come round: pumps off. The next time-out is a reset, also where interrupts are off. */
ISR(WDT_vect) {
    digitalWrite(PUMP_PINS[0], LOW);
    digitalWrite(PUMP_PINS[1], LOW);
    keep(CALIB_FAULT_WATCHDOG);
}

static void watch(void) {
    cli();
    wdt_reset();
    WDTCSR = (uint8_t)(_BV(WDCE) | _BV(WDE));
    WDTCSR = (uint8_t)(_BV(WDIE) | _BV(WDE) | (TICK_US > 25000 ? WDTO_120MS : WDTO_60MS));
    sei();
}

static void watched(void) {
    wdt_reset();
    /* A time-out clears the interrupt; without it the pumps would stay on until the reset. */
    WDTCSR = (uint8_t)(WDTCSR | _BV(WDIE));
}

static void recall(void) {
    if (kept_check != CHECK_OF(kept_fault)) {
        kept_fault = CALIB_FAULT_NONE;
    }
}
#elif defined(ARDUINO_ARCH_NRF52840) || defined(NRF52840_XXAA)
/* Nano 33 BLE: its watchdog resets at once, which makes the pins inputs; the resistors to ground hold the pumps off. */
#define REGISTER(at) (*(volatile uint32_t *)(at))
static uint8_t kept_fault; /* not over a reset, but for the watchdog's */
static void keep(uint8_t fault) {
    kept_fault = fault;
}
static void watch(void) {
    REGISTER(0x4001050CUL) = 1u;    /* also while the processor sleeps */
    REGISTER(0x40010504UL) = TICK_US > 25000 ? 4095u : 2047u; /* 125 or 62 ms at 32,768 Hz */
    REGISTER(0x40010508UL) = 1u;
    REGISTER(0x40010000UL) = 1u;
}
static void watched(void) {
    REGISTER(0x40010600UL) = 0x6E524635UL;
}
static void recall(void) {
    if (REGISTER(0x40000400UL) & 2u) {
        kept_fault = CALIB_FAULT_WATCHDOG;
        REGISTER(0x40000400UL) = 2u;
    }
}
#else
#if !defined(CALIB_NO_WATCHDOG)
#error "calib: no watchdog is known for this board; write watch() and watched(), or CALIB_NO_WATCHDOG 1 does without"
#endif
static uint8_t kept_fault; /* not over a reset */
static void keep(uint8_t fault) {
    kept_fault = fault;
}
static void watch(void) {}
static void watched(void) {}
static void recall(void) {}
#endif

static uint8_t imu_step, imu_failed;
static uint16_t imu_wait, imu_pause = 6, imu_checked;

/* A step that failed begins the IMU's start anew after a pause, doubled each time up to ten seconds. */
static void imu_again(void) {
    imu_step = 0;
    imu_wait = imu_pause;
    imu_pause = imu_pause < 300 ? (uint16_t)(2 * imu_pause) : 600;
}

static bool imu_measures(void) {
    return imu_step >= CALIB_IMU_STEPS && imu_wait == 0;
}

/* Once a tick: a step of the start, or a look at whether the IMU restarted without a word. */
static void keep_imu(void) {
    if (imu_wait) {
        imu_wait--;
    } else if (imu_step < CALIB_IMU_STEPS) {
        if (!calib_imu_start(imu_step)) {
            imu_again();
            return;
        }
        imu_wait = (uint16_t)(CALIB_IMU_WAIT_MS * (uint32_t)1000 / TICK_US);
        imu_step++;
        imu_failed = 0;
        imu_checked = 0;
    } else if (imu_checked++ == CALIB_HOLD_TICKS) {
        imu_checked = 0;
        imu_pause = 6;
        if (!calib_imu_alive()) {
            imu_again();
        }
    }
}

/* Six axes, and what the tick needs of them. At the end of the sensor's range it is a sample, but none to go by. */
static bool read_imu(void) {
    bool came;
    imu_us = micros();
    came = imu_measures() && calib_imu_read(force, rate);
    in.imu_read = (uint8_t)(came && calib_within(force[0], CALIB_IMU_FULL_MPS2) &&
                            calib_within(force[1], CALIB_IMU_FULL_MPS2) &&
                            calib_within(rate[2], CALIB_IMU_FULL_RADPS));
    if (came) {
        in.ax_mps2 = force[0];
        in.ay_mps2 = force[1];
        in.gz_radps = rate[2];
    }
    if (imu_measures()) {
        imu_failed = came ? 0 : (uint8_t)(imu_failed + 1u);
        if (imu_failed >= CALIB_GUARD_SAME || calib_guard_frozen(&guard)) {
            guard.rate_same = 0;
            guard.force_same = 0;
            imu_again();
        }
    }
    return came;
}

/* A picture is as old as the question that brought it, within half the time since the one before. */
static void ask_camera(void) {
    static uint32_t before_us;
    uint32_t now_us = micros();
    if (calib_camera_read(&in.u_px, &in.v_px)) {
        in.marker_seen = 1;
        picture_us = before_us + (asked_us - before_us) / 2;
    }
    before_us = asked_us;
    asked_us = now_us;
}

static void send_hello(void) {
    calib_link_begin(&link, CALIB_LINK_HELLO, 16);
    calib_link_word(&link, samples, 2);
    calib_link_word(&link, CALIB_ID, 4);
    calib_link_word(&link, CALIB_TICK_RATE_MHZ, 4);
    calib_link_byte(&link, (uint8_t)CALIB_ENVELOPE_OPEN_HIGH);
    calib_link_byte(&link, kept_fault);
    calib_link_byte(&link, CALIB_IMU_KIND);
    calib_link_byte(&link, CALIB_CAMERA_KIND);
    calib_link_byte(&link, CALIB_HAS_PLANE);
    calib_link_byte(&link, CALIB_EXAMPLE_MODE);
    calib_link_end(&link);
}

static void send_guard(void) {
    calib_link_byte(&link, out.duty[0]);
    calib_link_byte(&link, out.duty[1]);
    calib_link_byte(&link, guard.state);
    calib_link_byte(&link, guard.fault);
    calib_link_byte(&link, kept_fault);
}

static void send_tick(void) {
    calib_link_begin(&link, CALIB_LINK_TICK, 91);
    calib_link_word(&link, imu_us, 4);
    calib_link_word(&link, CALIB_ID, 4);
    calib_link_word(&link, CALIB_TICK_RATE_MHZ, 4);
    calib_link_word(&link, ticks++, 2);
    calib_link_byte(&link, (uint8_t)(in.marker_seen | (in.imu_read << 1)));
    calib_link_byte(&link, in.mode);
    calib_link_floats(&link, &in.u_px, CALIB_INPUT_FLOATS);
    calib_link_floats(&link, &out.phi_rad, CALIB_OUTPUT_FLOATS);
    calib_link_word(&link, out.flags, 2);
    send_guard();
    calib_link_end(&link);
}

static void send_imu(void) {
    calib_link_begin(&link, CALIB_LINK_IMU, 30);
    calib_link_word(&link, samples++, 2);
    calib_link_word(&link, imu_us, 4);
    calib_link_floats(&link, force, 3);
    calib_link_floats(&link, rate, 3);
    calib_link_end(&link);
}

/* The picture, what the pumps got `after_us` later, and how the board is. */
static void send_picture(uint32_t after_us) {
    calib_link_begin(&link, CALIB_LINK_PICTURE, 23);
    calib_link_word(&link, samples++, 2);
    calib_link_word(&link, picture_us, 4);
    calib_link_word(&link, after_us > 0xFFFFu ? 0xFFFFu : after_us, 2);
    calib_link_byte(&link, in.marker_seen);
    calib_link_floats(&link, &in.u_px, 2);
    send_guard();
    calib_link_byte(&link, overruns);
    calib_link_end(&link);
}

static void listen(void) {
    uint8_t i;
    while (Serial.available() > 0) {
        calib_link_take(&link, (uint8_t)Serial.read(), millis());
    }
    if (link.clear) {
        link.clear = 0;
        calib_guard_clear(&guard);
        keep(CALIB_FAULT_NONE);
    }
    if (calib_link_silent(&link, millis()) && (sampling || CALIB_EXAMPLE_HEARTBEAT)) {
        if (guard.state == CALIB_RUN) {
            calib_guard_fault(&guard, CALIB_FAULT_HOST);
        }
        /* Nothing begins either. */
        guard.quiet = 0;
    }
    if (link.samples != sampling) {
        sampling = link.samples;
        sample_us = micros();
        overruns = 0;
        for (i = 0; i < 2; i++) {
            link.duty[i] = sampling ? link.duty[i] : 0;
        }
        send_hello();
    }
}

/* Where the actuator shall go: from the computer in open loop, or here a reference of your own. */
static uint8_t wanted_mode(void) {
    if (sampling) {
        in.reference[0] = (float)link.duty[0];
        in.reference[1] = (float)link.duty[1];
        return link.open ? CALIB_MODE_OPEN : CALIB_MODE_OFF;
    }
    if (CALIB_EXAMPLE_MODE == CALIB_MODE_ORIENTATION) {
        in.reference[0] = 0.3f;
    } else {
        calib_reference_point(0.0f, CALIB_REST_LENGTH_M + 0.01f, in.reference);
    }
#if CALIB_HAS_PLANE
    return CALIB_EXAMPLE_MODE;
#else
    return CALIB_MODE_OFF;
#endif
}

void setup() {
    uint8_t i;
    for (i = 0; i < 2; i++) {
        /* Before SPI: pin 10 is its SS, which it would pull up as an input. */
        digitalWrite(PUMP_PINS[i], LOW);
        pinMode(PUMP_PINS[i], OUTPUT);
    }
    calib_guard_start(&guard);
    recall();
    Serial.begin(115200);
    if (calib_selftest() != 0 || calib_guard_selftest() != 0) {
        /* It does not compute what it should: stay here with the pumps off. */
        calib_guard_ready(&guard, 0);
        pinMode(LED_BUILTIN, OUTPUT);
        for (;;) {
            digitalWrite(LED_BUILTIN, HIGH);
            delay(100);
            digitalWrite(LED_BUILTIN, LOW);
            delay(100);
        }
    }
    watch();
    calib_i2c_start();
    calib_camera_start();
    calib_start(&state);
    calib_guard_ready(&guard, 1);
    send_hello();
    next_us = micros();
}

void loop() {
    static uint8_t fresh;
    uint32_t began_us = micros();
    int32_t late_us;
    if (sampling && (int32_t)(began_us - sample_us) >= 0) {
        sample_us += SAMPLE_US;
        if ((int32_t)(began_us - sample_us) >= 0) {
            sample_us = began_us + SAMPLE_US;
            overruns = overruns < 255 ? (uint8_t)(overruns + 1u) : 255;
        }
        if (read_imu()) {
            send_imu();
        }
        fresh = in.imu_read;
    }
    late_us = (int32_t)(next_us - micros());
    if (late_us > 0) {
        if (late_us > (int32_t)(CALIB_CAMERA_POLL_US / 2) && micros() - asked_us >= CALIB_CAMERA_POLL_US) {
            ask_camera();
        }
        return;
    }
    watched();
    next_us += TICK_US;
    if ((int32_t)(micros() - next_us) > (int32_t)TICK_US) {
        /* More than two ticks behind: what was missed is not made up for. */
        calib_guard_fault(&guard, CALIB_FAULT_LATE);
        next_us = micros();
    }
    listen();
    keep_imu();
    if (sampling) {
        in.imu_read = fresh;
        fresh = 0;
    } else {
        read_imu();
    }
    ask_camera();
    if (!in.marker_seen) {
        picture_us = micros();
    }
    late_us = (int32_t)(imu_us - picture_us);
    in.late_ticks = late_us > 0 ? (float)late_us * (1.0f / (float)TICK_US) : 0.0f;
    in.mode = calib_guard_mode(&guard, wanted_mode(), in.reference);
    calib_tick(&state, &in, &out);
    if (in.mode == CALIB_MODE_OPEN) {
        out.duty[0] = link.duty[0];
        out.duty[1] = link.duty[1];
    }
    calib_guard_tick(&guard, &state, &in, &out);
    if (guard.fault != CALIB_FAULT_NONE && guard.fault != CALIB_FAULT_REFERENCE) {
        keep(guard.fault);
    }
    analogWrite(PUMP_PINS[0], out.duty[0]);
    analogWrite(PUMP_PINS[1], out.duty[1]);
    if (!sampling) {
        send_tick();
    } else {
        send_picture(micros() - picture_us);
        if (++ticks % CALIB_HOLD_TICKS == 0) {
            send_hello();
        }
    }
    in.marker_seen = 0;
}
