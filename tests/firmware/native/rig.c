/*
 * The sketch with the real Arduino core on a simulated ATmega328P, around it a BNO055 or MPU6050 and a Pixy2 on I2C or
 * SPI, pumps and an actuator that follows them, and one fault. As a library (`rig_open` and the rest) it takes what the
 * sensors show from its caller, who has an actuator of its own.
 *
 *   rig SKETCH.elf FAULT AT_MS UNTIL_MS END_MS U0 V0 U1 V1
 *   rig SKETCH.elf CLOCK@OVERFLOWS:MILLIS AT_MS STEP_MS COUNT U0 V0 U1 V1 FAULT...
 *
 * The second way has COUNT moments STEP_MS apart, in each of which the simulated board is continued once with each
 * fault: for 700 ms, and from the first moment on to its end and 3 s longer. A line of stdout for each: the fault, the
 * moment, milliseconds until both pumps were off for good, -1 for never, and whether they ran in the end. OVERFLOWS and
 * MILLIS are places of the core's clock, which is set so that it begins anew in the middle of the moments.
 *
 * (U0, V0) and (U1, V1) show the marker of the straight actuator at its rest length and 40 mm longer. The serial
 * port's bytes go to stdout. On stderr one line: milliseconds with a pump on before the fault; of the fault's time
 * from 400 ms on, those with a pump on; the first time after the fault at which both were off for good, -1 for never;
 * whether they ran at the end; resets.
 */
#include <math.h>
#include <simavr/avr_spi.h>
#include <simavr/avr_twi.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_interrupts.h>
#include <simavr/sim_io.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/wait.h>
#include <unistd.h>

#define TCCR1A 0x80
#define OCR1AL 0x88
#define OCR1BL 0x8A
#define PORTB 0x25
#define TWCR 0xBC
#define WDTCSR 0x60
#define WDT_VECTOR 6
#define TWI_VECTOR 24

static avr_t *avr;
static avr_irq_t *bus_in, *serial_in;
static const char *fault;
static double at_ms, until_ms, u0, v0, u1, v1;
static double length[2]; /* share of 40 mm by which each bellows is longer */
static FILE *out;
static unsigned char from_board[65536], to_board[4096];
static size_t came, to_board_at, to_board_end;
static unsigned addressed, index_, place, resets, wanted;
static unsigned char written[8], reply[32], answer[sizeof reply];
static unsigned char registers[256], second[8]; /* `second`: of the BNO055, places 0x08 to 0x0F of page 1 */
static unsigned noise = 1;
static int quiet, of_caller, shown[10]; /* force, rate in the sensor's units; marker seen, u, v; number of the picture */
static avr_irq_t *spi_in;

static double now_ms(void) {
    return (double)avr->cycle / 16000.0;
}

static int is(const char *name) {
    return strcmp(fault, name) == 0 && now_ms() >= at_ms && now_ms() < until_ms;
}

static int rough(void) {
    noise = noise * 1103515245u + 12345u;
    return (int)(noise >> 16) % 5 - 2;
}

static int pump(int which) {
    unsigned compare = avr->data[which ? OCR1BL : OCR1AL], bit = which ? 0x20u : 0x80u;
    if (avr->data[TCCR1A] & bit) {
        return (int)compare;
    }
    return avr->data[PORTB] & (which ? 4 : 2) ? 255 : 0;
}

static void put(unsigned where, double value) {
    int whole = (int)lrint(value);
    reply[where] = (unsigned char)(whole & 255);
    reply[where + 1] = (unsigned char)(whole >> 8 & 255);
}

static avr_int_vector_t *vector_of(unsigned number) {
    unsigned i = 0;
    while (i + 1u < avr->interrupts.vector_count && avr->interrupts.vector[i]->vector != number) {
        i++;
    }
    return avr->interrupts.vector[i];
}

static double angle(void) {
    double turned = 0.04 * (length[0] - length[1]) / (2 * 0.0126);
    return is("marker_frozen") ? turned + 0.6 * sin(0.003 * (now_ms() - at_ms)) : turned;
}

/* What the BNO055 would read: 0.01 m/s^2 and 1/900 rad/s. */
static void axes(int *force, int *rate) {
    static int kept[6];
    double phi = angle();
    int i, now[6] = {0};
    if (of_caller) {
        memcpy(force, shown, 3 * sizeof *force);
        memcpy(rate, shown + 3, 3 * sizeof *rate);
        return;
    }
    now[0] = (int)lrint(981 * cos(phi)) + rough();
    now[1] = (int)lrint(981 * sin(phi)) + rough();
    now[5] = (int)lrint(rough() - (is("marker_frozen") ? 900 * 0.6 * 3 * cos(0.003 * (now_ms() - at_ms)) : 0));
    if (is("imu_tilted")) {
        now[0] = (int)lrint(981 * cos(phi + 0.7)) + rough();
        now[1] = (int)lrint(981 * sin(phi + 0.7)) + rough();
    }
    if (is("gyro_biased")) {
        now[5] += 2700;
    }
    if (is("imu_saturated")) {
        now[0] = 32767;
        now[1] = -32768;
        now[5] = 32767;
    }
    if (is("imu_garbage")) {
        for (i = 0; i < 6; i++) {
            now[i] = (rough() * 37 & 255) | (rough() * 37 & 255) << 8;
            now[i] = (int16_t)now[i];
        }
    }
    /* Readings stand still, all or those of one sensor; registers answer. */
    for (i = 0; i < 6; i++) {
        if (!is("imu_frozen") && !is(i < 3 ? "force_frozen" : "rate_frozen")) {
            kept[i] = now[i];
        }
    }
    memcpy(force, kept, 3 * sizeof *force);
    memcpy(rate, kept + 3, 3 * sizeof *rate);
}

static void imu_reply(void) {
    int force[3], rate[3], i;
    memset(reply, 0, sizeof reply);
    if (registers[0x07] == 1 && place >= 0x08) {
        reply[0] = place < 0x10 ? second[place - 8] : 0;
    } else if (place == 0x08) {
        if (registers[0x3D] == 5 && !is("imu_zero")) {
            axes(force, rate);
            for (i = 0; i < 3; i++) {
                put(2 * i, force[i]);
                put(12 + 2 * i, rate[i]);
            }
        }
    } else {
        reply[0] = place ? registers[place] : is("wrong_id") ? 0xA1 : 0xA0;
        if (is("imu_zero") && place) {
            reply[0] = 0;
        }
    }
}

/* The MPU6050: 1/8192 g and 1/16.384 deg/s, high bytes first. */
static void mpu_reply(void) {
    int force[3], rate[3], i;
    memset(reply, 0, sizeof reply);
    if (place == 0x3B) {
        if (registers[0x6B] == 1) {
            axes(force, rate);
            for (i = 0; i < 3; i++) {
                int f = (int)lrint(force[i] * 0.01 / 9.80665 * 8192), w = (int)lrint(rate[i] / 900.0 * 938.73);
                reply[2 * i] = (unsigned char)(f >> 8 & 255);
                reply[2 * i + 1] = (unsigned char)(f & 255);
                reply[8 + 2 * i] = (unsigned char)(w >> 8 & 255);
                reply[9 + 2 * i] = (unsigned char)(w & 255);
            }
        }
    } else {
        reply[0] = place == 0x75 ? 0x68 : registers[place];
    }
}

static void pixy_reply(void) {
    double share = 0.5 * (length[0] + length[1]), phi = angle(), sum = 0, chord, across;
    unsigned i, from = is("pixy_shifted") ? 3 : 0, total = 0;
    unsigned char *r = reply + from;
    static int given;
    int picture = of_caller ? shown[9] : 1 + (int)(now_ms() * 0.06);
    memset(reply, 0, sizeof reply);
    if (is("blob_lost") || (is("camera_slow") && fmod(now_ms() - at_ms, 1000.0) < 980.0)) {
        return;
    }
    if (picture == given || (of_caller && !shown[6])) {
        /* Busy: this picture was given. */
        static const unsigned char busy[] = {0xAF, 0xC1, 0x03, 0x01, 0xFE, 0x00, 0xFE};
        memcpy(r, busy, sizeof busy);
        return;
    }
    given = picture;
    if (is("beyond_reach")) {
        share = 1.6;
    }
    /* Places of the picture change by what moves the straight actuator, turned by half the angle. */
    if (is("marker_frozen")) {
        phi = 0;
    }
    chord = (0.065 + 0.04 * share) * (fabs(phi) > 1e-6 ? sin(phi / 2) / (phi / 2) : 1);
    across = chord * sin(phi / 2) + 0.015 * sin(phi);
    chord = chord * cos(phi / 2) + 0.015 * cos(phi) - 0.08;
    sum = chord / 0.04;
    r[0] = 0xAF;
    r[1] = 0xC1;
    r[2] = is("pixy_error") ? 0x03 : 0x21;
    r[3] = is("many_blobs") ? 28 : 14;
    put(from + 6, 1);
    put(from + 8, u0 + (u1 - u0) * sum + (v1 - v0) / 0.04 * across + (is("blob_elsewhere") ? 90 : 0) + 0.5 * rough());
    put(from + 10, v0 + (v1 - v0) * sum - (u1 - u0) / 0.04 * across + 0.5 * rough());
    if (is("marker_frozen")) {
        put(from + 8, u0);
        put(from + 10, v0);
    }
    if (of_caller) {
        put(from + 8, shown[7]);
        put(from + 10, shown[8]);
    }
    for (i = 6; i < 20; i++) {
        total += r[i];
    }
    put(from + 4, (double)(total + (is("bad_checksum") ? 1 : 0)));
    for (i = 0; is("pixy_garbage") && i < sizeof reply; i++) {
        reply[i] = (unsigned char)(rough() * 37 & 255);
    }
}

static int absent(unsigned slave) {
    if (slave != 0x54) {
        return is("imu_nack") || (is("imu_slow") && fmod(now_ms() - at_ms, 1000.0) < 980.0) ||
               (strcmp(fault, "deaf_start") == 0 && now_ms() < 400);
    }
    return is("pixy_nack");
}

static void on_bus(struct avr_irq_t *irq, uint32_t value, void *param) {
    avr_twi_msg_irq_t v;
    (void)irq;
    (void)param;
    v.u.v = value;
    if (v.u.twi.msg & TWI_COND_STOP) {
        addressed = 0;
    }
    if (v.u.twi.msg & TWI_COND_START) {
        unsigned slave = v.u.twi.addr >> 1;
        addressed = 0;
        index_ = 0;
        if ((slave == 0x28 || slave == 0x68 || slave == 0x54) && !absent(slave)) {
            addressed = slave;
            wanted = v.u.twi.addr;
            if (wanted & 1) {
                if (slave == 0x54) {
                    memcpy(reply, answer, sizeof reply);
                    memset(answer, 0, sizeof answer);
                } else {
                    (slave == 0x28 ? imu_reply : mpu_reply)();
                }
            }
            avr_raise_irq(bus_in, avr_twi_irq_msg(TWI_COND_ACK, (uint8_t)wanted, 1));
        }
    }
    if (!addressed) {
        return;
    }
    if (v.u.twi.msg & TWI_COND_WRITE) {
        avr_raise_irq(bus_in, avr_twi_irq_msg(TWI_COND_ACK, (uint8_t)wanted, 1));
        if (index_ < sizeof written) {
            written[index_++] = v.u.twi.data;
        }
        if (addressed == 0x54 && index_ == 6 && written[0] == 0xAE && written[1] == 0xC1) {
            pixy_reply();
            memcpy(answer, reply, sizeof answer);
        }
        if (addressed != 0x54) {
            place = written[0];
            if (index_ == 2 && addressed == 0x28 && registers[0x07] == 1 && place >= 0x08) {
                /* Only in the configuration mode. */
                if (place < 0x10 && registers[0x3D] == 0) {
                    second[place - 8] = written[1];
                }
            } else if (index_ == 2) {
                registers[place] = place == 0x6B ? written[1] & 0x7F : written[1];
            }
        }
    }
    if (v.u.twi.msg & TWI_COND_READ) {
        unsigned char byte = reply[index_++ % sizeof reply];
        avr_raise_irq(bus_in, avr_twi_irq_msg(TWI_COND_READ, (uint8_t)wanted, byte));
    }
}

/* The Pixy2 on SPI: each byte of the board's gets one of the answer to what was asked before. */
static void on_spi(struct avr_irq_t *irq, uint32_t value, void *param) {
    static unsigned char asked[2];
    static unsigned sent = sizeof reply;
    (void)irq;
    (void)param;
    asked[0] = asked[1];
    asked[1] = (unsigned char)value;
    avr_raise_irq(spi_in, sent < sizeof answer ? answer[sent] : 0);
    sent++;
    if (asked[0] == 0xAE && asked[1] == 0xC1) {
        pixy_reply();
        memcpy(answer, reply, sizeof answer);
        if (is("pixy_nack")) {
            memset(answer, 0, sizeof answer);
        }
        /* After the rest of the question, and a few bytes of which nothing is known. */
        sent = (unsigned)-6;
    }
}

static void on_serial(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    (void)param;
    if (of_caller) {
        if (came < sizeof from_board) {
            from_board[came++] = (unsigned char)value;
        }
    } else if (!quiet) {
        fputc((int)(value & 255), out);
    }
}

/* What stands in the BNO055 after its reset: 62.5 Hz, 32 Hz. */
static void restart_imu(void) {
    memset(registers, 0, sizeof registers);
    memset(second, 0, sizeof second);
    second[0] = 0x0D;
    second[2] = 0x38;
}

static int opened(const char *path) {
    elf_firmware_t firmware;
    uint32_t flags = 0;
    memset(&firmware, 0, sizeof firmware);
    restart_imu();
    if (elf_read_firmware(path, &firmware) != 0) {
        return 3;
    }
    avr = avr_make_mcu_by_name("atmega328p");
    avr_init(avr);
    avr->frequency = 16000000;
    avr->log = LOG_NONE;
    avr_load_firmware(avr, &firmware);
    bus_in = avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_INPUT);
    serial_in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    spi_in = avr_io_getirq(avr, AVR_IOCTL_SPI_GETIRQ(0), SPI_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_OUTPUT), on_bus, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_SPI_GETIRQ(0), SPI_IRQ_OUTPUT), on_spi, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_serial, NULL);
    /* Neither the simulator's own printing of the port, nor its waiting for one. */
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    return 0;
}

/* ---- as a library ---- */

int rig_open(const char *path) {
    of_caller = 1;
    fault = "none";
    return opened(path);
}

/* Whole numbers: force (3), rate (3) as the BNO055 counts, whether the marker is seen, u, v, the picture's number. */
void rig_show(const int *numbers) {
    memcpy(shown, numbers, sizeof shown);
}

/* ACC_CONFIG and, 256 times, GYR_CONFIG_0 of the BNO055. */
int rig_bandwidths(void) {
    return second[0] + 256 * second[2];
}

/* Bytes for the board's serial port, which takes them at its own speed. */
void rig_give(const unsigned char *bytes, int count) {
    while (count-- && to_board_end < sizeof to_board) {
        to_board[to_board_end++] = *bytes++;
    }
}

int rig_take(unsigned char *bytes) {
    int count = (int)came;
    memcpy(bytes, from_board, came);
    came = 0;
    return count;
}

void rig_reset(void) {
    avr_reset(avr);
}

/* Let some microseconds pass; both commands, 256 times the second, or -1 when the processor stopped. */
int rig_pass(double us) {
    static double next;
    avr_cycle_count_t end = avr->cycle + (avr_cycle_count_t)(16.0 * us);
    while (avr->cycle < end) {
        int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed) {
            return -1;
        }
        if (to_board_at < to_board_end && (now_ms() >= next || now_ms() + 1.0 < next)) {
            avr_raise_irq(serial_in, to_board[to_board_at++]);
            next = now_ms() + 0.087;
            if (to_board_at == to_board_end) {
                to_board_at = to_board_end = 0;
            }
        }
    }
    return pump(0) + 256 * pump(1);
}

/* ---- as a program ---- */

/* Milliseconds with a pump on before the fault and during it; since when both are off; whether one is on. */
static double on_before, on_during, off_since;
static int was_on;

/* Let the board and its rig go on to a time; whether the processor stopped. */
static int go_on(double end_ms) {
    static double next_ms, last_ms, waits_since;
    static int done;
    while (now_ms() < end_ms) {
        avr_cycle_count_t before = avr->cycle;
        int state;
        if (is("bus_hang") && avr->interrupts.vector[0] != NULL) {
            /* A line that is held: no byte ever ends. */
            avr_clear_interrupt(avr, vector_of(TWI_VECTOR));
            avr->data[TWCR] &= 0x7F;
        }
        if (is("stop_hang")) {
            /* The core waits for the stop in its interrupt, where no other comes. */
            avr->data[TWCR] |= 0x10;
        }
        state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed) {
            return 1;
        }
        if (avr->cycle < before) {
            resets++;
        }
        if (!vector_of(WDT_VECTOR)->pending) {
            waits_since = now_ms();
        } else if (now_ms() - waits_since > (double)(16 << (avr->data[WDTCSR] & 7))) {
            /* The data sheet's 10.9.2, which simavr lacks: a time-out while the last one still waits is a reset. */
            avr_reset(avr);
            resets++;
        }
        if (!done && now_ms() >= at_ms) {
            if (strcmp(fault, "imu_page") == 0) {
                registers[0x07] = 1;
            }
            if (strcmp(fault, "imu_brown_out") == 0 || strcmp(fault, "supply_reset") == 0) {
                restart_imu();
            }
            if (strcmp(fault, "supply_reset") == 0) {
                int i;
                for (i = 0x100; i <= (int)avr->ramend; i++) {
                    avr->data[i] = (unsigned char)(rough() * 37);
                }
            }
            if (strcmp(fault, "supply_reset") == 0 || strcmp(fault, "reset") == 0) {
                avr_reset(avr);
                resets++;
            }
            done = 1;
        }
        if (now_ms() >= next_ms) {
            double step = now_ms() - last_ms;
            int i, on = pump(0) || pump(1);
            for (i = 0; i < 2; i++) {
                double goes_to = is("stuck") ? length[i] : pow((double)pump(is("swapped") ? 1 - i : i) / 255, 2);
                length[i] += (goes_to - length[i]) * step / 300;
            }
            if (now_ms() < at_ms) {
                on_before += on ? step : 0;
            } else {
                if (on && now_ms() >= at_ms + 400 && now_ms() < until_ms) {
                    on_during += step;
                }
                if (now_ms() < until_ms) {
                    off_since = on ? -1 : off_since < 0 ? now_ms() : off_since;
                }
            }
            was_on = on;
            last_ms = now_ms();
            next_ms = last_ms + 0.25;
            if (is("serial_garbage")) {
                avr_raise_irq(serial_in, (uint32_t)(rough() * 51 + 128));
            }
        }
    }
    return 0;
}

static double off_after(void) {
    return off_since < 0 ? -1 : off_since - at_ms;
}

static void set(unsigned place_, uint32_t value) {
    unsigned i;
    for (i = 0; i < 4; i++) {
        avr->data[place_ + i] = (unsigned char)(value >> (8 * i));
    }
}

/* Each fault at each moment, in processes that part there. */
static int at_many_moments(const char *clock, double first_ms, double step_ms, int count, char **faults) {
    unsigned overflows, millis_;
    double middle_ms = first_ms + 0.5 * step_ms * count;
    int k, i;
    if (sscanf(clock, "CLOCK@%x:%x", &overflows, &millis_) != 2) {
        return 2;
    }
    fault = "none";
    at_ms = until_ms = 1e9;
    if (go_on(50.0)) {
        return 5;
    }
    set(overflows & 0xFFFFu, 0x400000u - (uint32_t)((middle_ms - 50.0) / 1.024));
    set(millis_ & 0xFFFFu, 0u - (uint32_t)(middle_ms - 50.0));
    for (k = 0; k < count; k++) {
        if (go_on(first_ms + step_ms * k)) {
            return 5;
        }
        if (k == 0) {
            fprintf(out, "on_before %.1f\n", on_before);
        }
        fflush(out);
        for (i = 0; faults[i] != NULL; i++) {
            if (fork() == 0) {
                fault = faults[i];
                at_ms = now_ms();
                until_ms = at_ms + 1500.0;
                off_since = -1;
                /* A fault may come back once while the angle recovers; then the guard waits twice as long. */
                if (go_on(k ? at_ms + 1400.0 : until_ms + 5000.0)) {
                    _exit(5);
                }
                fprintf(out, "%s %.1f %.2f %d\n", fault, at_ms, off_after(), was_on);
                fflush(out);
                _exit(0);
            }
            wait(NULL);
        }
    }
    return 0;
}

int main(int argc, char **argv) {
    if (argc < 10) {
        return 2;
    }
    out = fdopen(dup(1), "wb");
    if (out == NULL || dup2(2, 1) < 0) {
        return 6;
    }
    fault = argv[2];
    u0 = atof(argv[6]);
    v0 = atof(argv[7]);
    u1 = atof(argv[8]);
    v1 = atof(argv[9]);
    off_since = -1;
    if (opened(argv[1]) != 0) {
        return 3;
    }
    if (argc > 10) {
        quiet = 1;
        return at_many_moments(argv[2], atof(argv[3]), atof(argv[4]), atoi(argv[5]), argv + 10);
    }
    at_ms = atof(argv[3]);
    until_ms = atof(argv[4]);
    if (go_on(atof(argv[5]))) {
        return 5;
    }
    fflush(out);
    fprintf(stderr, "\nresult %.1f %.1f %.1f %d %u\n", on_before, on_during, off_after(), was_on, resets);
    return 0;
}
