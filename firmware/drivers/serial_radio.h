/* Receivers that send frames of bytes: SBUS, CRSF (ExpressLRS, Crossfire), IBUS. Pure: the board's UART brings the
 * bytes. NOT YET RUN ON A BOARD.
 *
 *     SBUS   100,000 baud 8E2, inverted (an inverter before the STM32F4's pin)   25 bytes, two flags
 *     CRSF   420,000 baud 8N1                                                    CRC-8, link statistics, telemetry back
 *     IBUS   115,200 baud 8N1                                                    32 bytes, a checksum, no flag
 *
 * A frame that says that it repeats what was heard before (SBUS "frame lost", CRSF with a link quality of 0) is as
 * good as none: RADIO_LOST_US without another is a failsafe. SBUS' own failsafe flag is one at once. An IBUS receiver,
 * and one of pulses, must be set up to send nothing where it hears nothing: no flag says so. */
#ifndef SERIAL_RADIO_H
#define SERIAL_RADIO_H

#include "radio.h"

typedef enum { SERIAL_SBUS, SERIAL_CRSF, SERIAL_IBUS } serial_kind;

#define SERIAL_LONGEST 64u /* bytes of a frame */

/* CRSF's link statistics, of the line to the aircraft. */
typedef struct {
    bool known;      /* it has come */
    uint8_t quality; /* %, 0 where nothing is heard */
    int16_t rssi_dbm;
    int8_t snr_db;
} serial_link;

typedef struct {
    serial_kind kind;
    uint8_t frame[SERIAL_LONGEST];
    size_t count;
    uint64_t byte_us;  /* time of the last byte */
    uint64_t good_us;  /* time of the last good frame with channels, plus 1; 0: never */
    uint64_t heard_us; /* time of the last one that was accepted, likewise */
    bool failsafe;     /* the receiver's own */
    quad_receiver receiver;
    serial_link link;
    uint32_t frames, bad;
} serial_radio;

void serial_radio_start(serial_radio *r, serial_kind kind);

/* Take a byte that arrived at now_us. */
void serial_radio_take(serial_radio *r, uint8_t byte, uint64_t now_us);

/* What the receiver says now. */
quad_receiver serial_radio_now(const serial_radio *r, uint64_t now_us);

/* CRSF's telemetry to the receiver, a frame each: at most SERIAL_LONGEST bytes are written, their number is returned. */
size_t serial_radio_battery(float volts, uint8_t *bytes);

/* Attitude (3) in rad, FRD and NED, as the firmware has it. */
size_t serial_radio_attitude(const float attitude[3], uint8_t *bytes);

#endif
