/* Linux only: the pseudo-terminal that stands for the UART, and the file with the key. */
#ifndef TERMINAL_H
#define TERMINAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef struct {
    int master, slave;
    const char *link;
    char path[64];
    uint8_t rest[2048]; /* the end of what was sent last and did not fit */
    size_t waiting;
    uint64_t taken_s; /* when the output became full; 0 where it is not */
    uint64_t dropped; /* bytes */
} terminal;

/* Open a raw pseudo-terminal; `link` (or NULL) becomes a symbolic link to it, in the place of one
 * that is there. NULL, or what is wrong. */
const char *terminal_open(terminal *t, const char *link);

/* What has arrived; 0 where nothing has. */
size_t terminal_read(terminal *t, uint8_t *bytes, size_t room);

/* Send `bytes`; they are dropped whole, and counted, while older ones are stuck: as on a UART that
 * nobody reads, its sender is never held up. */
void terminal_write(terminal *t, const uint8_t *bytes, size_t count);

/* Takes the link away too, if it is still ours. */
void terminal_close(terminal *t);

/* The key in a file for its owner alone: 64 hexadecimal digits with white space around, or 32 raw
 * bytes. NULL, or what is wrong. */
const char *terminal_read_key(const char *path, uint8_t key[32]);

#endif
