/* The firmware as a Linux process: a pseudo-terminal stands for the UART to the bridge, standard
 * input (a socket, both ways) for the line to the simulation. It ends when that line ends. */
#define _GNU_SOURCE /* ppoll */

#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "quad_hil.h"
#include "terminal.h"

#define EPOCH_2015 1420070400
#define LINE 0

static uint64_t clock_us(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return 1000000u * (uint64_t)now.tv_sec + (uint64_t)now.tv_nsec / 1000u;
}

typedef struct {
    quad_firmware firmware;
    quad_hil hil;
    quad_hil_boot boot;
    quad_inputs inputs;
    uint64_t due_us;   /* time of the cycle whose inputs have come */
    uint64_t last_us;  /* time of the last cycle */
    uint64_t start_us; /* on the host's clock, of cycle 0 */
    bool booted, started, waiting, ended;
    terminal port;
} board;

static uint64_t now_us(const board *b)
{
    if (b->boot.lockstep || !b->started) {
        return b->last_us;
    }
    return clock_us(CLOCK_MONOTONIC) - b->start_us;
}

static void send_all(board *b)
{
    uint8_t bytes[2048];
    const size_t count = quad_firmware_send(&b->firmware, bytes, sizeof bytes);
    if (count > 0) {
        terminal_write(&b->port, bytes, count);
    }
}

static void hear_bridge(board *b)
{
    uint8_t bytes[4096];
    const size_t count = terminal_read(&b->port, bytes, sizeof bytes);
    if (count > 0) {
        quad_firmware_receive(&b->firmware, bytes, count, now_us(b));
        send_all(b);
    }
}

static void hear_simulation(board *b)
{
    uint8_t bytes[4096];
    const ssize_t count = read(LINE, bytes, sizeof bytes);
    if (count <= 0) {
        b->ended = !(count < 0 && errno == EINTR);
        return;
    }
    for (ssize_t i = 0; i < count; i++) {
        switch (quad_hil_take(&b->hil, bytes[i], &b->boot, &b->due_us, &b->inputs)) {
        case QUAD_HIL_BOOT:
            b->ended = b->booted; /* another flight needs another process */
            b->booted = true;
            break;
        case QUAD_HIL_SENSORS:
            b->waiting = b->booted;
            break;
        default:
            break;
        }
    }
}

static void run_cycle(board *b)
{
    float motors[4];
    uint8_t frame[QUAD_HIL_MOTORS];
    hear_bridge(b); /* what came before this cycle is heeded in it */
    const uint64_t began_us = now_us(b);
    b->last_us = b->due_us;
    quad_firmware_cycle(&b->firmware, b->due_us, &b->inputs, motors);
    quad_firmware_timed(&b->firmware, b->due_us, began_us, now_us(b));
    send_all(b);
    b->waiting = false;
    quad_hil_motors(motors, b->due_us, &b->firmware.timing, frame);
    b->ended = b->ended || write(LINE, frame, sizeof frame) != (ssize_t)sizeof frame;
}

/* A motor frame before the first: the simulation may speak. */
static void say_ready(board *b)
{
    const float stopped[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    uint8_t frame[QUAD_HIL_MOTORS];
    quad_hil_motors(stopped, 0, &b->firmware.timing, frame);
    b->ended = write(LINE, frame, sizeof frame) != (ssize_t)sizeof frame;
}

static void wait_for_bytes(board *b)
{
    struct pollfd lines[2] = {{LINE, POLLIN, 0}, {b->port.master, POLLIN, 0}};
    struct timespec wait = {0, 0};
    const uint64_t now = now_us(b);
    if (b->waiting && b->due_us > now) {
        wait.tv_sec = (time_t)((b->due_us - now) / 1000000u);
        wait.tv_nsec = (long)((b->due_us - now) % 1000000u) * 1000;
    }
    if (ppoll(lines, 2, b->waiting ? &wait : NULL, NULL) <= 0) {
        return;
    }
    if ((lines[1].revents & POLLIN) != 0) {
        hear_bridge(b);
    }
    if (lines[0].revents != 0) {
        hear_simulation(b);
    }
}

static int fail(const char *what, const char *why)
{
    fprintf(stderr, "virtual_stm32: %s: %s\n", what, why);
    return 2;
}

static void fly(board *b, const uint8_t *key)
{
    while (!b->ended && !b->booted) {
        hear_simulation(b);
    }
    b->boot.settings.endpoint.key = key;
    if (key != NULL) {
        b->boot.settings.endpoint.signing_time =
            clock_us(CLOCK_REALTIME) / 10u - EPOCH_2015 * 100000ull;
    }
    quad_firmware_init(&b->firmware, &b->boot.settings);
    while (!b->ended) {
        if (!b->waiting || (!b->boot.lockstep && b->started && b->due_us > now_us(b))) {
            wait_for_bytes(b);
        } else {
            if (!b->started) {
                b->started = true;
                b->start_us = clock_us(CLOCK_MONOTONIC);
            }
            run_cycle(b);
        }
    }
}

int main(int count, char **given)
{
    static board b;
    static uint8_t key[32];
    const char *link = NULL, *key_file = NULL, *why;
    for (int i = 1; i < count; i++) {
        const bool is_link = strcmp(given[i], "--link") == 0;
        if (!is_link && strcmp(given[i], "--key") != 0) {
            return fail(given[i], "known are --link PATH, --key FILE");
        }
        if (i + 1 == count || given[i + 1][0] == '\0') {
            return fail(given[i], "needs a value");
        }
        i++;
        if (is_link) {
            link = given[i];
        } else {
            key_file = given[i];
        }
    }
    if (key_file != NULL && (why = terminal_read_key(key_file, key)) != NULL) {
        return fail(key_file, why);
    }
    signal(SIGINT, SIG_IGN); /* a flight ends with its simulation */
    signal(SIGTERM, SIG_IGN);
    signal(SIGPIPE, SIG_IGN);
    if ((why = terminal_open(&b.port, link)) != NULL) {
        return fail(link != NULL ? link : "pseudo-terminal", why);
    }
    printf("virtual STM32 on %s\n", b.port.path);
    fflush(stdout);
    say_ready(&b);
    fly(&b, key_file != NULL ? key : NULL);
    terminal_close(&b.port);
    if (b.port.dropped > 0) {
        printf("%llu bytes dropped: nobody read them\n", (unsigned long long)b.port.dropped);
    }
    const quad_counts *c = &b.firmware.endpoint.counts;
    printf("frames %u bad %u unsigned %u forged %u replayed %u dropped %u\n", c->frames, c->bad,
           c->unsigned_frames, c->forged, c->replayed, c->dropped);
    return 0;
}
