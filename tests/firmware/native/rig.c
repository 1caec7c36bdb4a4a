/*
 * The sketch with the real Arduino core on a simulated ATmega328P, around it a BNO055 and a Pixy2 on its bus, pumps
 * and an actuator that follows them, and one fault.
 *
 *   rig SKETCH.elf FAULT AT_MS UNTIL_MS END_MS U0 V0 U1 V1 [MICROS_ADDRESS]
 *
 * (U0, V0) and (U1, V1) show the marker of the straight actuator at its rest length and 40 mm longer. The serial
 * port's bytes go to stdout. On stderr one line: milliseconds with a pump on before the fault; of the fault's time
 * from 400 ms on, those with a pump on; the first time after the fault at which both were off for good, -1 for never;
 * whether they ran at the end; resets.
 */
#include <math.h>
#include <simavr/avr_twi.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_interrupts.h>
#include <simavr/sim_io.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define TCCR1A 0x80
#define OCR1AL 0x88
#define OCR1BL 0x8A
#define PORTB 0x25
#define TWCR 0xBC
#define TWI_VECTOR 24

static avr_t *avr;
static avr_irq_t *bus_in, *serial_in;
static const char *fault;
static double at_ms, until_ms, u0, v0, u1, v1;
static double length[2]; /* share of 40 mm by which each bellows is longer */
static FILE *out;
static unsigned addressed, index_, place, resets, wanted;
static unsigned char written[8], reply[32];
static unsigned mode_register, unit_register, noise = 1;

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

static double angle(void) {
    double turned = 0.04 * (length[0] - length[1]) / (2 * 0.0126);
    return is("marker_frozen") ? turned + 0.6 * sin(0.003 * (now_ms() - at_ms)) : turned;
}

static void imu_reply(void) {
    static unsigned char last[16];
    double phi = angle();
    memset(reply, 0, sizeof reply);
    if (place == 0x00) {
        reply[0] = is("wrong_id") ? 0xA1 : 0xA0;
    } else if (place == 0x3D) {
        reply[0] = (unsigned char)mode_register;
    } else if (place == 0x3B) {
        reply[0] = (unsigned char)unit_register;
    } else if (is("imu_zero") || mode_register != 7) {
        return;
    } else if (place == 0x08) {
        put(0, 981 * cos(phi) + rough());
        put(2, 981 * sin(phi) + rough());
        if (is("imu_saturated")) {
            put(0, 32767);
            put(2, -32768);
        }
    } else if (place == 0x14) {
        put(4, rough() - (is("marker_frozen") ? 900 * 0.6 * 3 * cos(0.003 * (now_ms() - at_ms)) : 0));
        if (is("imu_saturated")) {
            put(4, 32767);
        }
    }
    if (is("imu_garbage")) {
        unsigned i;
        for (i = 0; i < 6; i++) {
            reply[i] = (unsigned char)(rough() * 37);
        }
    }
    /* Its readings stand still; its registers answer. */
    if (place == 0x08 || place == 0x14) {
        unsigned char *kept = last + (place == 0x14 ? 8 : 0);
        if (is("imu_frozen")) {
            memcpy(reply, kept, 8);
        } else {
            memcpy(kept, reply, 8);
        }
    }
}

static void pixy_reply(void) {
    double share = 0.5 * (length[0] + length[1]), phi = angle(), sum = 0, chord, across;
    unsigned i, from = is("pixy_shifted") ? 3 : 0, total = 0;
    unsigned char *r = reply + from;
    memset(reply, 0, sizeof reply);
    if (is("blob_lost") || (is("camera_slow") && fmod(now_ms(), 1000.0) > 20.0)) {
        return;
    }
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
    r[3] = 14;
    put(from + 6, 1);
    put(from + 8, u0 + (u1 - u0) * sum + (v1 - v0) / 0.04 * across + (is("blob_elsewhere") ? 90 : 0) + 0.5 * rough());
    put(from + 10, v0 + (v1 - v0) * sum - (u1 - u0) / 0.04 * across + 0.5 * rough());
    if (is("marker_frozen")) {
        put(from + 8, u0);
        put(from + 10, v0);
    }
    for (i = 6; i < 20; i++) {
        total += r[i];
    }
    put(from + 4, (double)(total + (is("bad_checksum") ? 1 : 0)));
}

static int absent(unsigned slave) {
    if (slave == 0x28) {
        return is("imu_nack") || (is("imu_slow") && fmod(now_ms(), 1000.0) > 20.0) ||
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
        if ((slave == 0x28 || slave == 0x54) && !absent(slave)) {
            addressed = slave;
            wanted = v.u.twi.addr;
            if (wanted & 1) {
                (slave == 0x28 ? imu_reply : pixy_reply)();
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
        if (addressed == 0x28) {
            place = written[0];
            if (index_ == 2 && place == 0x3D) {
                mode_register = written[1];
            } else if (index_ == 2 && place == 0x3B) {
                unit_register = written[1];
            }
        }
    }
    if (v.u.twi.msg & TWI_COND_READ) {
        unsigned char byte = reply[index_++ % sizeof reply];
        avr_raise_irq(bus_in, avr_twi_irq_msg(TWI_COND_READ, (uint8_t)wanted, byte));
    }
}

static void on_serial(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    (void)param;
    fputc((int)(value & 255), out);
}

int main(int argc, char **argv) {
    elf_firmware_t firmware;
    double end_ms, next_ms = 0, on_before = 0, on_during = 0, off_since = -1, last_ms = 0;
    int was_on = 0, done = 0;
    if (argc < 10) {
        return 2;
    }
    out = fdopen(dup(1), "wb");
    if (out == NULL || dup2(2, 1) < 0) {
        return 6;
    }
    fault = argv[2];
    at_ms = atof(argv[3]);
    until_ms = atof(argv[4]);
    end_ms = atof(argv[5]);
    u0 = atof(argv[6]);
    v0 = atof(argv[7]);
    u1 = atof(argv[8]);
    v1 = atof(argv[9]);
    memset(&firmware, 0, sizeof firmware);
    if (elf_read_firmware(argv[1], &firmware) != 0) {
        return 3;
    }
    avr = avr_make_mcu_by_name("atmega328p");
    avr_init(avr);
    avr->frequency = 16000000;
    avr->log = LOG_NONE;
    avr_load_firmware(avr, &firmware);
    bus_in = avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_INPUT);
    serial_in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_OUTPUT), on_bus, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_serial, NULL);
    {
        /* The simulator's own printing of the port, and its waiting for one. */
        uint32_t flags = 0;
        avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    }
    while (now_ms() < end_ms) {
        avr_cycle_count_t before = avr->cycle;
        int state;
        if (is("bus_hang") && avr->interrupts.vector[0] != NULL) {
            /* A line that is held: no byte ever ends. */
            unsigned i;
            for (i = 0; i < avr->interrupts.vector_count; i++) {
                avr_int_vector_t *vector = avr->interrupts.vector[i];
                if (vector->vector == TWI_VECTOR) {
                    avr_clear_interrupt(avr, vector);
                }
            }
            avr->data[TWCR] &= 0x7F;
        }
        state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed) {
            return 5;
        }
        if (avr->cycle < before) {
            resets++;
        }
        if (!done && strcmp(fault, "reset") == 0 && now_ms() >= at_ms) {
            done = 1;
            avr_reset(avr);
            resets++;
        }
        if (now_ms() >= next_ms) {
            double step = now_ms() - last_ms;
            int i, on = pump(0) || pump(1);
            for (i = 0; i < 2; i++) {
                double goes_to = is("stuck") ? length[i] : pow((double)pump(i) / 255, 2);
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
    fflush(out);
    fprintf(stderr, "\nresult %.1f %.1f %.1f %d %u\n", on_before, on_during, off_since < 0 ? -1 : off_since - at_ms,
            was_on, resets);
    return 0;
}
