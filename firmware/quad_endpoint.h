/* The STM32's end of the link: bytes in, control cycles in, bytes out.
 *
 * One struct holds all state; nothing is allocated, nothing is read or written but through the
 * calls below, and nothing blocks. All calls belong into one context (the control loop):
 *
 *     quad_endpoint_receive(&e, bytes, count, now_us);         what the UART has brought
 *     quad_endpoint_begin_cycle(&e, now_us, &pilot, &record);  what to add, and with which gains
 *     ... filters, control law and mixer fill the record ...
 *     quad_endpoint_end_cycle(&e, &record, &pilot, &slow);
 *     count = quad_endpoint_send(&e, buffer, room);            to the UART's DMA
 *
 * Times are us since boot on a counter that never goes back. Body axes are FRD (x forward, y
 * right, z down), attitude is relative to NED, units are SI. */
#ifndef QUAD_ENDPOINT_H
#define QUAD_ENDPOINT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "quad_attitude.h"
#include "quad_excitation.h"
#include "quad_gains.h"
#include "quad_mavlink.h"
#include "quad_parameters.h"

#define QUAD_OUTBOX 2048 /* bytes: five cycles at 921600 baud and 250 Hz */
#define QUAD_RC_CHANNELS 18
#define QUAD_LOW_THROTTLE 0.05f /* below it nothing but itself is commanded, and only there something arms */
#define QUAD_TEST_THROTTLE 0.25f /* most of a motor that is tested */
#define QUAD_MOST_VOLTS 100.0f  /* a measurement beyond is none */
#define QUAD_BRIDGE_SYSTEM 1       /* who the bridge is: its frames alone say that it is there */
#define QUAD_BRIDGE_COMPONENT 191
#define QUAD_SIGNING_LAST (1ull << 47) /* August 2059: no signature's time is beyond it */

typedef struct {
    uint8_t system, component; /* ids of this end, usually 1 and 1 */
    uint64_t aircraft;         /* unique number of this controller, as the chip's id */
    uint16_t rate_hz;          /* control cycles per second, 50 or more */
    float low_battery_v;       /* no excitation and no arming below it */
    bool armed;                /* at the start: for rigs, whose switch is in the supply */
    bool may_arm;              /* by command of the bridge; disarming is always obeyed */
    const float *stored;       /* QUAD_PARAMETERS confirmed values from flash, or NULL */
    bool unreadable;           /* flash holds other values, of which nothing is known */
    const uint8_t *key;        /* 32 bytes, or NULL: nobody signs */
    uint64_t signing_time;     /* with a key: see quad_endpoint_signing_time; 0 where unknown */
} quad_settings;

/* What the pilot's receiver says. */
typedef struct {
    uint16_t pulse_us[QUAD_RC_CHANNELS];
    uint8_t count;
    bool failsafe, kill; /* kill disarms */
    bool throttle_low;   /* below QUAD_LOW_THROTTLE: the stick */
    bool idle;           /* the same of the throttle that is commanded */
} quad_pilot;

/* All that one control cycle knew. begin_cycle fills what is marked (e), the control law the rest
 * and adds its flags SATURATED and ANGLE_LIMIT. */
typedef struct {
    uint64_t time_us; /* (e) start of the cycle */
    uint32_t cycle;   /* (e) */
    uint16_t flags;   /* (e) QUAD_FLAG_* */
    uint8_t injection, excitation_seq; /* (e) */
    float excitation[3];               /* (e) to be added in this cycle, and logged as added */
    const float *gains;                /* (e) QUAD_PARAMETERS values in force in this cycle */
    float gyro[3];                     /* rad/s, filtered, bias removed */
    float accel[3];                    /* m/s^2: at rest and level 0, 0, -9.81 */
    float attitude[3];                 /* roll, pitch, yaw, rad */
    float attitude_setpoint[3];        /* that C1 used, excitation included */
    float rate_setpoint[3];            /* that C2 used, excitation included */
    float control[4];                  /* U1 (up) and U2..U4 before the mixer, normalised */
    float motors[4];                   /* 0..1, after the limits */
} quad_cycle;

typedef struct {
    uint32_t frames;   /* used */
    uint32_t bad;      /* wrong checksum, or of an unknown message */
    uint32_t unsigned_frames, forged, replayed; /* with a key: ignored */
    uint32_t dropped;  /* ours, for want of room in the outbox */
} quad_counts;

typedef struct {
    quad_settings settings;
    quad_counts counts;
    quad_gains gains;
    quad_excitation excitation;
    float in_force[QUAD_PARAMETERS];
    bool armed, low_battery, tilted;
    bool unreadable; /* values in flash are not used */
    const char *unfit; /* what is wrong with the set-up; NULL: nothing */
    struct {
        size_t motor;
        float throttle;
        uint64_t until_us; /* 0: none */
    } test;
    uint64_t flew_us; /* when it was last armed, or turned */
    bool throttle_low; /* in the last cycle */
    bool blind; /* no gyro, as at first: the control loop says so; nothing arms */
    float volts; /* low-passed; QUAD_MOST_VOLTS before the first measurement */
    uint16_t last_flags;
    uint32_t cycle;
    uint64_t began_us;
    uint8_t list_next; /* parameter that PARAM_REQUEST_LIST still waits for */
    mavlink_message_t rx;
    mavlink_status_t link;
    mavlink_signing_t signing;
    mavlink_signing_streams_t streams;
    uint8_t outbox[QUAD_OUTBOX];
    size_t first, waiting;
} quad_endpoint;

/* The settings are copied; `stored` and `key` need not outlive the call. */
void quad_endpoint_init(quad_endpoint *e, const quad_settings *settings);

/* Take bytes that arrived at now_us; what answers them waits for quad_endpoint_send. */
void quad_endpoint_receive(quad_endpoint *e, const uint8_t *bytes, size_t count, uint64_t now_us);

/* Begin the cycle that starts at now_us: fills the record as described there. */
void quad_endpoint_begin_cycle(quad_endpoint *e, uint64_t now_us, const quad_pilot *pilot,
                               quad_cycle *record);

/* End it: queues the cycle's frame and what is due beside it. */
void quad_endpoint_end_cycle(quad_endpoint *e, const quad_cycle *record, const quad_pilot *pilot,
                             const quad_slow *slow);

/* The motors of a cycle in which none flies: one that is tested. */
void quad_endpoint_test_motor(const quad_endpoint *e, quad_cycle *record);

/* Whether nothing forbids to begin a motor's test: at rest on the ground, disarmed, the pilot's switches heard. */
bool quad_endpoint_may_test_now(const quad_endpoint *e);

/* What the last cycle knew of that forbids arming, in a text of STATUSTEXT's length; NULL where nothing did. */
const char *quad_endpoint_unarmed(const quad_endpoint *e);

/* Up to `room` bytes to send now; their number. */
size_t quad_endpoint_send(quad_endpoint *e, uint8_t *out, size_t room);

/* Signature time now, 10 us since 2015. Without a clock of its own the board keeps it in flash:
 * store it plus a minute, once a minute, and hand the stored one to the next start. Whatever is
 * older than that start is refused, so that no recording can be replayed. */
uint64_t quad_endpoint_signing_time(const quad_endpoint *e);

#endif
