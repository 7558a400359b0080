/* The endpoint on Linux: on a pseudo-terminal, with a simple plant, in real time. For the desk and
 * the tests; on the board main.c is yours, and this is how it goes. */
#define _XOPEN_SOURCE 700

#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "plant.h"
#include "terminal.h"

#define RATE_HZ 250
#define PERIOD_US (1000000 / RATE_HZ)
#define THROTTLE 0.5f
#define BURST 50 /* cycles run at once after a stall of the machine */
#define EPOCH_2015 1420070400
#define LONGEST_S 1e9

static volatile sig_atomic_t stopped;

static void stop(int number)
{
    (void)number;
    stopped = 1;
}

static uint64_t clock_us(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return 1000000u * (uint64_t)now.tv_sec + (uint64_t)now.tv_nsec / 1000u;
}

static void send_all(quad_endpoint *e, terminal *port)
{
    uint8_t bytes[512];
    size_t count;
    while ((count = quad_endpoint_send(e, bytes, sizeof bytes)) > 0) {
        terminal_write(port, bytes, count);
    }
}

static void run(quad_endpoint *e, terminal *port, uint64_t last_us)
{
    const quad_slow slow = {12.2f, {0.2f, 0.0f, 0.4f}, 1013.25f, 25.0f};
    quad_pilot pilot = {{1500, 1500, 1500, 1500, 1000, 1000, 1000, 1000, 1000}, 9, false, false};
    const uint64_t start_us = clock_us(CLOCK_MONOTONIC);
    uint64_t due_us = 0;
    plant axes;
    plant_init(&axes);
    while (!stopped && due_us < last_us) {
        uint8_t bytes[1024];
        uint64_t now_us = clock_us(CLOCK_MONOTONIC) - start_us;
        const size_t count =
            terminal_read(port, bytes, sizeof bytes, (int64_t)due_us - (int64_t)now_us);
        now_us = clock_us(CLOCK_MONOTONIC) - start_us;
        quad_endpoint_receive(e, bytes, count, now_us);
        for (int i = 0; i < BURST && due_us <= now_us; i++, due_us += PERIOD_US) {
            quad_cycle record;
            quad_endpoint_begin_cycle(e, due_us, &pilot, &record);
            plant_cycle(&axes, &record, THROTTLE, 1e-6f * PERIOD_US);
            quad_endpoint_end_cycle(e, &record, &pilot, &slow);
            send_all(e, port);
        }
        send_all(e, port);
    }
}

static int fail(const char *what, const char *why)
{
    fprintf(stderr, "quad_host: %s: %s\n", what, why);
    return 2;
}

/* What the command line says. */
typedef struct {
    const char *link, *key_file;
    uint64_t last_us;
    bool disarmed;
} options;

static const char *take_seconds(const char *text, uint64_t *us)
{
    char *end;
    const double seconds = strtod(text, &end);
    if (end == text || *end != '\0' || !(seconds > 0.0 && seconds <= LONGEST_S)) {
        return "must be seconds, above 0 and at most 1e9";
    }
    *us = (uint64_t)(1e6 * seconds);
    return NULL;
}

/* 0, or the exit status. */
static int read_options(int count, char **given, options *o)
{
    for (int i = 1; i < count; i++) {
        const char *name = given[i], *value = i + 1 < count ? given[i + 1] : "";
        if (strcmp(name, "--disarmed") == 0) {
            o->disarmed = true;
            continue;
        }
        const bool link = strcmp(name, "--link") == 0, key = strcmp(name, "--key") == 0;
        if (!link && !key && strcmp(name, "--duration") != 0) {
            return fail(name, "known are --link PATH, --key FILE, --duration S, --disarmed");
        }
        if (value[0] == '\0') {
            return fail(name, "needs a value");
        }
        if (link) {
            o->link = value;
        } else if (key) {
            o->key_file = value;
        } else {
            const char *why = take_seconds(value, &o->last_us);
            if (why != NULL) {
                return fail(name, why);
            }
        }
        i++;
    }
    return 0;
}

int main(int count, char **given)
{
    static quad_endpoint endpoint;
    options asked = {NULL, NULL, UINT64_MAX, false};
    uint8_t key[32];
    terminal port;
    const int status = read_options(count, given, &asked);
    if (status != 0) {
        return status;
    }
    quad_settings settings = {.system = 1,
                              .component = 1,
                              .aircraft = 0x686f737471756164u,
                              .rate_hz = RATE_HZ,
                              .low_battery_v = 9.9f,
                              .armed = !asked.disarmed,
                              .may_arm = true};
    if (asked.key_file != NULL) {
        const char *why = terminal_read_key(asked.key_file, key);
        if (why != NULL) {
            return fail(asked.key_file, why);
        }
        settings.key = key;
        settings.signing_time = clock_us(CLOCK_REALTIME) / 10u - EPOCH_2015 * 100000ull;
    }
    const char *why = terminal_open(&port, asked.link);
    if (why != NULL) {
        return fail(asked.link != NULL ? asked.link : "pseudo-terminal", why);
    }
    signal(SIGINT, stop);
    signal(SIGTERM, stop);
    printf("quad host on %s\n", port.path);
    fflush(stdout);
    quad_endpoint_init(&endpoint, &settings);
    run(&endpoint, &port, asked.last_us);
    terminal_close(&port);
    const quad_counts *c = &endpoint.counts;
    printf("frames %u bad %u unsigned %u forged %u replayed %u dropped %u\n", c->frames, c->bad,
           c->unsigned_frames, c->forged, c->replayed, c->dropped);
    return 0;
}
