/*
 * calib_link.h - frames between board and computer on Serial, 115200 baud, all little-endian:
 *
 *   A5 5A, version, kind, length, payload, CRC-16 (0x1021 from 0xFFFF, from version to payload)
 *
 * from the board   HELLO    what it is; at its start, when samples begin, and once a second with them
 *                  TICK     one tick whole: what went in, what came out
 *                  IMU      one sample of six axes with its time
 *                  PICTURE  what the camera showed, what the pumps got, and both times
 * to the board     ALIVE    the computer is there
 *                  SET      samples or ticks, pumps in open loop or as the sketch has them, two commands
 *                  CLEAR    a person has looked: faults that stay end
 *
 * Frames to the board that are damaged, of another version or length, are nothing: neither commands nor signs of life.
 */
#ifndef CALIB_LINK_H
#define CALIB_LINK_H

#include "calib_guard.h"

#define CALIB_LINK_VERSION 2
#define CALIB_LINK_HELLO 1
#define CALIB_LINK_TICK 2
#define CALIB_LINK_IMU 3
#define CALIB_LINK_PICTURE 4
#define CALIB_LINK_ALIVE 16
#define CALIB_LINK_SET 17
#define CALIB_LINK_CLEAR 18

/* In open loop the pumps stop when no frame has come for so long; it holds for the sketch's own mode on request. */
#define CALIB_LINK_SILENT_MS 250

typedef struct {
    uint32_t heard_ms;                    /* when the last whole frame came */
    uint16_t check;                       /* of what is sent at present */
    uint8_t frame[9], length;             /* of what comes in, from the version on */
    uint8_t synced, samples, open, duty[2], clear;
} calib_link;

static inline uint16_t calib_link_crc(uint16_t check, uint8_t value) {
    uint8_t bit;
    check = (uint16_t)(check ^ (uint16_t)((uint16_t)value << 8));
    for (bit = 0; bit < 8; bit++) {
        check = (uint16_t)(((unsigned)check << 1) ^ ((check & 0x8000u) ? 0x1021u : 0u));
    }
    return check;
}

/* One byte from the computer, at a time in ms. A whole frame changes what the link says is wanted. */
static inline void calib_link_take(calib_link *link, uint8_t value, uint32_t now_ms) {
    uint16_t check = 0xFFFFu;
    uint8_t i, length;
    if (link->synced < 2) {
        link->synced = (uint8_t)(value == 0xA5u ? 1u : (link->synced == 1 && value == 0x5Au) ? 2u : 0u);
        link->length = 0;
        return;
    }
    link->frame[link->length++] = value;
    if (link->length < 3) {
        return;
    }
    length = link->frame[2];
    if (link->frame[0] != CALIB_LINK_VERSION || length != (link->frame[1] == CALIB_LINK_SET ? 4u : 0u)) {
        link->synced = 0;
        return;
    }
    if (link->length < length + 5u) {
        return;
    }
    link->synced = 0;
    for (i = 0; i < length + 3u; i++) {
        check = calib_link_crc(check, link->frame[i]);
    }
    if (check != (uint16_t)(link->frame[i] | (uint16_t)((uint16_t)link->frame[i + 1] << 8))) {
        return;
    }
    if (link->frame[1] == CALIB_LINK_SET) {
        link->samples = link->frame[3];
        link->open = link->frame[4];
        link->duty[0] = link->frame[5];
        link->duty[1] = link->frame[6];
    } else if (link->frame[1] == CALIB_LINK_CLEAR) {
        link->clear = 1;
    } else if (link->frame[1] != CALIB_LINK_ALIVE) {
        return;
    }
    link->heard_ms = now_ms;
}

/* Whether the computer has fallen silent: then it wants nothing any more until it says so again. */
static inline uint8_t calib_link_silent(calib_link *link, uint32_t now_ms) {
    if (now_ms - link->heard_ms <= CALIB_LINK_SILENT_MS) {
        return 0;
    }
    /* Not to be near again when the clock has come round. */
    link->heard_ms = now_ms - CALIB_LINK_SILENT_MS - 1u;
    link->open = 0;
    link->duty[0] = 0;
    link->duty[1] = 0;
    return 1;
}

static inline void calib_link_byte(calib_link *link, uint8_t value) {
    link->check = calib_link_crc(link->check, value);
    Serial.write(value);
}

static inline void calib_link_word(calib_link *link, uint32_t value, uint8_t bytes) {
    while (bytes--) {
        calib_link_byte(link, (uint8_t)value);
        value >>= 8;
    }
}

static inline void calib_link_floats(calib_link *link, const float *values, uint8_t count) {
    while (count--) {
        calib_link_word(link, calib_bits(*values++), 4);
    }
}

static inline void calib_link_begin(calib_link *link, uint8_t kind, uint8_t length) {
    Serial.write((uint8_t)0xA5);
    Serial.write((uint8_t)0x5A);
    link->check = 0xFFFFu;
    calib_link_byte(link, CALIB_LINK_VERSION);
    calib_link_byte(link, kind);
    calib_link_byte(link, length);
}

static inline void calib_link_end(calib_link *link) {
    uint16_t check = link->check;
    Serial.write((uint8_t)check);
    Serial.write((uint8_t)(check >> 8));
}

#endif /* CALIB_LINK_H */
