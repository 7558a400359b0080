/* See serial_radio.h. Sources: Futaba's SBUS as Betaflight and PX4 read it (11 bits a channel, 880 us + 5/8 us a step);
 * TBS, CRSF protocol specification (rev. 07); FlySky's IBUS (channels in us). */
#include "serial_radio.h"

#include <math.h>
#include <string.h>

#define SBUS_BYTES 25u
#define SBUS_HEAD 0x0Fu
#define SBUS_LOST 0x04u     /* this frame repeats the one before */
#define SBUS_FAILSAFE 0x08u
#define SBUS_GAP_US 2000u   /* longer than any pause within a frame, shorter than one between two */
#define CRSF_SYNC 0xC8u     /* the address of the flight controller */
#define CRSF_BATTERY 0x08u
#define CRSF_LINK 0x14u
#define CRSF_CHANNELS 0x16u
#define CRSF_ATTITUDE 0x1Eu
#define CRSF_GAP_US 1750u
#define IBUS_BYTES 32u
#define IBUS_GAP_US 3000u

void serial_radio_start(serial_radio *r, serial_kind kind)
{
    memset(r, 0, sizeof *r);
    r->kind = kind;
}

/* Channel of 11 bits, least significant first, SBUS' and CRSF's alike. */
static float packed(const uint8_t *bytes, size_t channel)
{
    const size_t bit = 11 * channel, at = bit / 8;
    uint32_t word = (uint32_t)bytes[at] | (uint32_t)bytes[at + 1] << 8;
    word |= bit % 8 > 5 ? (uint32_t)bytes[at + 2] << 16 : 0u;
    return 880.0f + 0.625f * (float)((word >> (bit % 8)) & 0x7FFu);
}

/* Channels that were heard. After a silence two frames in a row are believed, not one: SBUS has no checksum. */
static void heard(serial_radio *r, const float pulse_us[QUAD_CHANNELS], uint64_t now_us)
{
    const bool again = r->good_us > 0 && now_us <= r->good_us + RADIO_LOST_US;
    r->good_us = now_us + 1;
    if (again) {
        memcpy(r->receiver.pulse_us, pulse_us, sizeof r->receiver.pulse_us);
        r->heard_us = now_us + 1;
    }
}

static void refused(serial_radio *r)
{
    r->bad++;
    r->count = 0;
    if (r->heard_us != r->good_us) { /* the first of two */
        r->good_us = 0;
    }
}

static void take_sbus(serial_radio *r, uint64_t now_us)
{
    const uint8_t flags = r->frame[23];
    r->failsafe = (flags & SBUS_FAILSAFE) != 0;
    if ((flags & (SBUS_LOST | SBUS_FAILSAFE)) == 0) {
        float pulse_us[QUAD_CHANNELS];
        for (size_t i = 0; i < QUAD_CHANNELS; i++) {
            pulse_us[i] = packed(&r->frame[1], i);
        }
        heard(r, pulse_us, now_us);
    }
}

/* DVB-S2: polynomial 0xD5. */
static uint8_t crc(const uint8_t *bytes, size_t count)
{
    uint8_t sum = 0;
    for (size_t i = 0; i < count; i++) {
        sum ^= bytes[i];
        for (int bit = 0; bit < 8; bit++) {
            sum = (uint8_t)((sum & 0x80u) != 0 ? (uint32_t)sum << 1 ^ 0xD5u : (uint32_t)sum << 1);
        }
    }
    return sum;
}

static void take_crsf(serial_radio *r, uint64_t now_us)
{
    const uint8_t *payload = &r->frame[3];
    const size_t count = r->frame[1] - 2u;
    if (r->frame[2] == CRSF_LINK && count == 10) {
        r->link = (serial_link){true, payload[2], (int16_t)-(int16_t)payload[0], (int8_t)payload[3]};
    } else if (r->frame[2] == CRSF_CHANNELS && count == 22 && (r->link.quality > 0 || !r->link.known)) {
        float pulse_us[QUAD_CHANNELS];
        for (size_t i = 0; i < QUAD_CHANNELS; i++) {
            pulse_us[i] = packed(payload, i);
        }
        heard(r, pulse_us, now_us);
    }
}

static void take_ibus(serial_radio *r, uint64_t now_us)
{
    float pulse_us[QUAD_CHANNELS];
    for (size_t i = 0; i < QUAD_CHANNELS; i++) {
        const uint8_t *at = &r->frame[2 + 2 * i];
        pulse_us[i] = (float)(((uint32_t)at[1] << 8 | at[0]) & 0x0FFFu);
    }
    heard(r, pulse_us, now_us);
}

/* Bytes of the frame under way; 0 where its beginning is none. */
static size_t wanted(const serial_radio *r)
{
    const uint8_t *frame = r->frame;
    if (r->kind == SERIAL_SBUS) {
        return frame[0] == SBUS_HEAD ? SBUS_BYTES : 0;
    }
    if (r->kind == SERIAL_IBUS) {
        return frame[0] == IBUS_BYTES && (r->count < 2 || frame[1] == 0x40) ? IBUS_BYTES : 0;
    }
    if (frame[0] != CRSF_SYNC || (r->count > 1 && (frame[1] < 3 || frame[1] > SERIAL_LONGEST - 2u))) {
        return 0;
    }
    return r->count > 1 ? frame[1] + 2u : 3;
}

static bool whole(const serial_radio *r)
{
    const uint8_t *frame = r->frame;
    if (r->kind == SERIAL_SBUS) { /* SBUS2 has its slots in the last byte */
        return (frame[24] & 0xCFu) == 0x00 || (frame[24] & 0xCFu) == 0x04;
    }
    if (r->kind == SERIAL_CRSF) {
        return crc(&frame[2], frame[1] - 1u) == frame[r->count - 1];
    }
    uint32_t sum = 0xFFFF;
    for (size_t i = 0; i < IBUS_BYTES - 2; i++) {
        sum -= frame[i];
    }
    return (sum & 0xFFFFu) == ((uint32_t)frame[31] << 8 | frame[30]);
}

static void end(serial_radio *r, uint64_t now_us)
{
    r->frames++;
    if (r->kind == SERIAL_SBUS) {
        take_sbus(r, now_us);
    } else if (r->kind == SERIAL_CRSF) {
        take_crsf(r, now_us);
    } else {
        take_ibus(r, now_us);
    }
}

void serial_radio_take(serial_radio *r, uint8_t byte, uint64_t now_us)
{
    static const uint32_t gap_us[] = {SBUS_GAP_US, CRSF_GAP_US, IBUS_GAP_US};
    const bool after_gap = r->byte_us == 0 || now_us > r->byte_us + gap_us[r->kind];
    r->byte_us = now_us;
    if (after_gap && r->count > 0) {
        refused(r);
    }
    if (r->kind == SERIAL_SBUS && r->count == 0 && !after_gap) {
        return; /* its head may occur inside a frame: only a pause shows where one begins */
    }
    r->frame[r->count++] = byte;
    const size_t length = wanted(r);
    if (length == 0) {
        refused(r);
    } else if (r->count == length) {
        if (whole(r)) {
            r->count = 0;
            end(r, now_us);
        } else {
            refused(r);
        }
    }
}

quad_receiver serial_radio_now(const serial_radio *r, uint64_t now_us)
{
    quad_receiver receiver = r->receiver;
    const bool silent = r->heard_us == 0 || now_us > r->heard_us + RADIO_LOST_US;
    receiver.failsafe = silent || r->failsafe;
    return receiver;
}

static size_t framed(uint8_t *bytes, uint8_t type, size_t payload)
{
    bytes[0] = CRSF_SYNC;
    bytes[1] = (uint8_t)(payload + 2);
    bytes[2] = type;
    bytes[3 + payload] = crc(&bytes[2], payload + 1);
    return payload + 4;
}

static void put_16(uint8_t *at, float value)
{
    const float bounded = fmaxf(-32768.0f, fminf(32767.0f, floorf(value + 0.5f)));
    const uint16_t bits = (uint16_t)(int16_t)bounded;
    at[0] = (uint8_t)(bits >> 8);
    at[1] = (uint8_t)bits;
}

size_t serial_radio_battery(float volts, uint8_t *bytes)
{
    memset(bytes, 0, 12);
    put_16(&bytes[3], isfinite(volts) ? 10.0f * volts : 0.0f); /* current, charge and rest are not measured */
    return framed(bytes, CRSF_BATTERY, 8);
}

size_t serial_radio_attitude(const float attitude[3], uint8_t *bytes)
{
    static const size_t order[3] = {1, 0, 2}; /* pitch, roll, yaw in 1e-4 rad */
    for (size_t i = 0; i < 3; i++) {
        put_16(&bytes[3 + 2 * i], isfinite(attitude[order[i]]) ? 1e4f * attitude[order[i]] : 0.0f);
    }
    return framed(bytes, CRSF_ATTITUDE, 6);
}
