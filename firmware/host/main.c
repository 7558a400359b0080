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

int main(int count, char **given)
{
    static quad_endpoint endpoint;
    quad_settings settings = {.system = 1,
                              .component = 1,
                              .aircraft = 0x686f737471756164u,
                              .rate_hz = RATE_HZ,
                              .low_battery_v = 9.9f,
                              .armed = true,
                              .may_arm = true};
    const char *link = NULL;
    uint8_t key[32];
    uint64_t last_us = UINT64_MAX;
    terminal port;
    for (int i = 1; i < count; i++) {
        const char *value = i + 1 < count ? given[i + 1] : "";
        if (strcmp(given[i], "--disarmed") == 0) {
            settings.armed = false;
            continue;
        }
        if (strcmp(given[i], "--link") == 0 && value[0] != '\0') {
            link = value;
        } else if (strcmp(given[i], "--duration") == 0 && atof(value) > 0.0) {
            last_us = (uint64_t)(1e6 * atof(value));
        } else if (strcmp(given[i], "--key") == 0) {
            const char *why = terminal_read_key(value, key);
            if (why != NULL) {
                return fail(value, why);
            }
            settings.key = key;
            settings.signing_time = clock_us(CLOCK_REALTIME) / 10u - EPOCH_2015 * 100000ull;
        } else {
            return fail(given[i], "known are --link PATH, --key FILE, --duration S, --disarmed");
        }
        i++;
    }
    if (!terminal_open(&port, link)) {
        return fail(link != NULL ? link : "pseudo-terminal", "cannot be made");
    }
    signal(SIGINT, stop);
    signal(SIGTERM, stop);
    printf("quad host on %s\n", port.path);
    fflush(stdout);
    quad_endpoint_init(&endpoint, &settings);
    run(&endpoint, &port, last_us);
    terminal_close(&port);
    const quad_counts *c = &endpoint.counts;
    printf("frames %u bad %u unsigned %u forged %u replayed %u dropped %u\n", c->frames, c->bad,
           c->unsigned_frames, c->forged, c->replayed, c->dropped);
    return 0;
}
