/* Receivers on a serial line: golden frames, flags, and frames under damage and noise; pulses under the same.
 *     serial_radio [bytes]    of noise and damaged frames for each kind, an edge of a pulse counted as one */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "check.h"
#include "serial_radio.h"

static const uint32_t byte_us[] = {120, 24, 87}, gap_us[] = {6000, 4000, 5000};
static uint64_t now_us = 1000000;
static uint32_t seed = 1;

static uint32_t draw(uint32_t below)
{
    seed ^= seed << 13;
    seed ^= seed >> 17;
    seed ^= seed << 5;
    return seed % below;
}

static void send(serial_radio *r, const uint8_t *bytes, size_t count)
{
    for (size_t i = 0; i < count; i++) {
        now_us += byte_us[r->kind];
        serial_radio_take(r, bytes[i], now_us);
    }
}

/* As captured: SBUS and IBUS of receivers, CRSF of Betaflight's own test. */
static const uint8_t sbus[25] = {0x0F, 0xE0, 0x03, 0x1F, 0x58, 0xC0, 0x07, 0x16, 0xB0, 0x80, 0x05, 0x2C, 0x60,
                                 0x01, 0x0B, 0xF8, 0xC0, 0x07, 0x00, 0x00, 0x00, 0x00, 0x00, 0x03, 0x00};
static const uint8_t crsf[26] = {0xC8, 0x18, 0x16, 0xBD, 0x08, 0x9F, 0xF4, 0xAE, 0xF7, 0xBD, 0xEF, 0x7D, 0xEF,
                                 0xFB, 0xAD, 0xFD, 0x45, 0x2B, 0x5A, 0x01, 0x00, 0x00, 0x00, 0x00, 0x00, 0x6C};
static const uint8_t ibus[32] = {0x20, 0x40, 0xDB, 0x05, 0xDC, 0x05, 0x54, 0x05, 0xDC, 0x05, 0xE8,
                                 0x03, 0xD0, 0x07, 0xD2, 0x05, 0xE8, 0x03, 0xDC, 0x05, 0xDC, 0x05,
                                 0xDC, 0x05, 0xDC, 0x05, 0xDC, 0x05, 0xDC, 0x05, 0xDA, 0xF3};
static const uint8_t *const golden[] = {sbus, crsf, ibus};
static const size_t lengths[] = {sizeof sbus, sizeof crsf, sizeof ibus};
static const float first[][4] = {{1500.0f, 1500.0f, 1100.0f, 1500.0f},
                                 {998.125f, 1500.625f, 1491.25f, 1494.375f},
                                 {1499.0f, 1500.0f, 1364.0f, 1500.0f}};

static bool failsafe(const serial_radio *r)
{
    return serial_radio_now(r, now_us).failsafe;
}

static void twice(serial_radio *r)
{
    for (int k = 0; k < 2; k++) {
        send(r, golden[r->kind], lengths[r->kind]);
        now_us += gap_us[r->kind];
    }
}

static void test_golden(serial_kind kind)
{
    serial_radio r;
    serial_radio_start(&r, kind);
    check(failsafe(&r), "nothing was heard yet");
    send(&r, golden[kind], lengths[kind]);
    now_us += gap_us[kind];
    check(failsafe(&r) && r.frames == 1, "one frame is not believed");
    send(&r, golden[kind], lengths[kind]);
    now_us += gap_us[kind];
    const quad_receiver now = serial_radio_now(&r, now_us);
    check(!now.failsafe && r.frames == 2 && r.bad == 0, "two are");
    for (size_t i = 0; i < 4; i++) {
        check(fabsf(now.pulse_us[i] - first[kind][i]) < 1e-3f, "channels");
    }
    now_us += RADIO_LOST_US + 1;
    check(failsafe(&r), "silence");
}

static void test_sbus_flags(void)
{
    for (int flag = 4; flag <= 8; flag += 4) {
        serial_radio r;
        uint8_t frame[25];
        serial_radio_start(&r, SERIAL_SBUS);
        twice(&r);
        memcpy(frame, sbus, sizeof frame);
        frame[23] = (uint8_t)flag;
        frame[1] = 0x00;
        for (int k = 0; k < 20; k++) {
            send(&r, frame, sizeof frame);
            now_us += gap_us[0];
            check(failsafe(&r) || (flag == 4 && k < 12), "9 ms a frame: lost ones are a failsafe after 100 ms");
            check(!failsafe(&r) || flag == 8 || k > 8, "and not before");
            check(serial_radio_now(&r, now_us).pulse_us[0] == 1500.0f, "and nothing of theirs is used");
        }
        twice(&r);
        check(!failsafe(&r), "heard again");
    }
}

static void test_crsf_link(void)
{
    serial_radio r;
    serial_radio_start(&r, SERIAL_CRSF);
    uint8_t link[14] = {0xC8, 12, 0x14, 75, 80, 0, (uint8_t)-5, 0, 2, 3, 90, 99, 7, 0};
    for (int quality = 0; quality <= 99; quality += 99) {
        uint8_t sum = 0;
        link[5] = (uint8_t)quality;
        for (size_t i = 2; i < 13; i++) { /* bit by bit, another way than the driver's */
            for (int bit = 7; bit >= 0; bit--) {
                const bool out = (sum >> 7) != ((link[i] >> bit) & 1);
                sum = (uint8_t)((uint32_t)sum << 1 ^ (out ? 0xD5u : 0u));
            }
        }
        link[13] = sum;
        send(&r, link, sizeof link);
        now_us += gap_us[1];
        twice(&r);
        check(failsafe(&r) == (quality == 0), "a link of quality 0 repeats what it heard");
        check(r.link.quality == quality && r.link.rssi_dbm == -75 && r.link.snr_db == -5, "statistics");
    }
    uint8_t bytes[SERIAL_LONGEST];
    const float attitude[3] = {0.1f, -0.2f, 3.0f};
    check(serial_radio_battery(11.1f, bytes) == 12 && bytes[2] == 0x08 && bytes[3] == 0 && bytes[4] == 111, "battery");
    check(serial_radio_attitude(attitude, bytes) == 10 && bytes[2] == 0x1E, "attitude");
    check((int16_t)((bytes[3] << 8) | bytes[4]) == -2000 && (int16_t)((bytes[5] << 8) | bytes[6]) == 1000 &&
              (int16_t)((bytes[7] << 8) | bytes[8]) == 30000, "pitch, roll, yaw in 1e-4 rad");
    send(&r, bytes, 10);
    check(r.bad == 0, "its checksum holds");
}

/* Noise, and frames that are cut, flipped or lengthened, between whole ones: a whole one behind a pause is always
 * taken, two of them end a failsafe, and 100 ms without one begin it. */
static void test_damage(serial_kind kind, long bytes)
{
    serial_radio r;
    serial_radio_start(&r, kind);
    long sent = 0, wrong = 0;
    while (sent < bytes) {
        const uint32_t burst = draw(40);
        const uint64_t since_us = now_us;
        for (uint32_t k = 0; k < burst; k++) {
            uint8_t frame[80];
            const size_t noise = draw(60), at = 1 + draw((uint32_t)lengths[kind] - 1);
            size_t count = lengths[kind];
            memcpy(frame, golden[kind], count);
            switch (draw(4)) {
            case 0: /* noise */
                count = noise;
                for (size_t i = 0; i < count; i++) {
                    frame[i] = (uint8_t)draw(256);
                }
                break;
            case 1:
                count = at;
                break;
            case 2:
                frame[at] ^= (uint8_t)(1u << draw(8));
                if (kind == SERIAL_SBUS) { /* no checksum would see it */
                    frame[24] = 0xFF;
                }
                break;
            default:
                memmove(&frame[at + 1], &frame[at], count - at);
                frame[at] = (uint8_t)~frame[at + 1];
                count++;
                if (kind == SERIAL_SBUS) {
                    frame[24] = 0xFF;
                }
            }
            send(&r, frame, count);
            sent += (long)count;
            now_us += gap_us[kind] * draw(3) / 2 + gap_us[kind];
        }
        const uint64_t silent_us = now_us - since_us;
        wrong += silent_us > RADIO_LOST_US + 20000 && !failsafe(&r);
        now_us += gap_us[kind];
        const uint32_t frames = r.frames;
        twice(&r);
        sent += 2 * (long)lengths[kind];
        check(r.frames == frames + 2, "whole frames are taken");
        check(!failsafe(&r), "and end a failsafe");
        const quad_receiver now = serial_radio_now(&r, now_us);
        for (size_t i = 0; i < 4; i++) {
            check(fabsf(now.pulse_us[i] - first[kind][i]) < 1e-3f, "with their channels");
        }
    }
    check(wrong == 0, "damage and noise are no frame");
}

static void edge(radio *r, uint8_t wire, bool high, uint32_t after_us)
{
    now_us += after_us;
    const radio_edge one = {(uint16_t)now_us, wire, high};
    radio_take(r, one, now_us);
}

static void pulse(radio *r, uint8_t wire, uint32_t width_us)
{
    edge(r, wire, true, 20);
    edge(r, wire, false, width_us);
}

/* Rising edges of a PPM frame with so many channels, and the gap before it. */
static void ppm_frame(radio *r, size_t channels)
{
    edge(r, 0, true, 6000);
    for (size_t i = 0; i < channels; i++) {
        edge(r, 0, true, 1100 + 100 * (uint32_t)i);
    }
}

/* Glitches, lost edges and frames with an edge too many: none of them is a frame or a pulse. */
static void test_pulses(bool ppm, long edges)
{
    radio r;
    radio_start(&r, ppm);
    long sent = 0, wrong = 0;
    size_t channels = 7;
    while (sent < edges) {
        const uint64_t since_us = now_us;
        for (uint32_t burst = draw(40); burst > 0; burst--) {
            if (ppm && draw(2) == 0) { /* an edge lost, or one too many; never two alike in a row */
                channels = 16 - channels;
                ppm_frame(&r, channels);
            }
            for (uint32_t k = draw(12); k > 0; k--) {
                pulse(&r, (uint8_t)(ppm ? 0 : draw(12)), draw(2) == 0 ? 1 + draw(700) : 2300 + draw(300));
            }
            now_us += 3000 + draw(3000); /* a gap: shorter ones would be channels by chance */
            sent += 30;
        }
        const bool long_ago = now_us - since_us > RADIO_LOST_US + 20000;
        wrong += long_ago && !radio_now(&r, now_us).failsafe;
        for (int again = 0; again < 4; again++) {
            if (ppm) {
                ppm_frame(&r, 8);
            }
            for (uint8_t wire = 0; wire < 6 && !ppm; wire++) {
                pulse(&r, wire, 1100 + 100u * wire);
            }
        }
        if (ppm) {
            edge(&r, 0, true, 6000);
        }
        const quad_receiver now = radio_now(&r, now_us);
        check(!now.failsafe, "whole frames end a failsafe");
        for (size_t i = 0; i < 6; i++) {
            check(now.pulse_us[i] == (float)(1100 + 100 * i), "with their channels");
        }
    }
    check(wrong == 0, "glitches are no frame");
}

int main(int count, char **arguments)
{
    const long bytes = count > 1 ? strtol(arguments[1], NULL, 10) : 1000000;
    for (int kind = 0; kind < 3; kind++) {
        test_golden((serial_kind)kind);
        test_damage((serial_kind)kind, bytes);
    }
    test_pulses(true, bytes);
    test_pulses(false, bytes);
    test_sbus_flags();
    test_crsf_link();
    return checked();
}
