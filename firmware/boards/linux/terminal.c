/* See terminal.h. */
#define _DEFAULT_SOURCE /* cfmakeraw */
#define _XOPEN_SOURCE 700

#include "terminal.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define GIVE_UP_S 1 /* a reader that reads nothing for so long counts as absent */
#define LARGEST_KEY 4096 /* bytes of the file, white space included */

static const char *make_link(terminal *t, const char *link)
{
    char fresh[PATH_MAX];
    struct stat about;
    if (lstat(link, &about) == 0 && !S_ISLNK(about.st_mode)) {
        return "exists and is not a symbolic link";
    }
    if (snprintf(fresh, sizeof fresh, "%s.%d", link, (int)getpid()) >= (int)sizeof fresh) {
        return strerror(ENAMETOOLONG);
    }
    unlink(fresh);
    if (symlink(t->path, fresh) != 0) {
        return strerror(errno);
    }
    if (rename(fresh, link) != 0) { /* over the link of a host that was killed */
        const char *why = strerror(errno);
        unlink(fresh);
        return why;
    }
    t->link = link;
    return NULL;
}

const char *terminal_open(terminal *t, const char *link)
{
    struct termios mode;
    memset(t, 0, sizeof *t);
    t->master = posix_openpt(O_RDWR | O_NOCTTY);
    if (t->master < 0 || grantpt(t->master) != 0 || unlockpt(t->master) != 0) {
        return strerror(errno);
    }
    const char *name = ptsname(t->master);
    if (name == NULL || strlen(name) >= sizeof t->path) {
        return "has no name";
    }
    strcpy(t->path, name);
    /* the slave stays open here, or its raw mode would be lost with the last reader */
    t->slave = open(t->path, O_RDWR | O_NOCTTY);
    if (t->slave < 0 || tcgetattr(t->slave, &mode) != 0) {
        return strerror(errno);
    }
    cfmakeraw(&mode);
    if (tcsetattr(t->slave, TCSANOW, &mode) != 0 ||
        fcntl(t->master, F_SETFL, O_NONBLOCK) != 0) {
        return strerror(errno);
    }
    return link != NULL ? make_link(t, link) : NULL;
}

size_t terminal_read(terminal *t, uint8_t *bytes, size_t room)
{
    const ssize_t count = read(t->master, bytes, room);
    return count > 0 ? (size_t)count : 0;
}

static uint64_t clock_s(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec;
}

/* Send what fits of `rest`; drop it where the reader has read nothing for long. */
static void push(terminal *t)
{
    const ssize_t count = write(t->master, t->rest, t->waiting);
    if (count > 0) {
        t->waiting -= (size_t)count;
        memmove(t->rest, &t->rest[count], t->waiting);
        t->taken_s = 0;
    } else if (t->taken_s == 0) {
        t->taken_s = clock_s();
    } else if (clock_s() - t->taken_s > GIVE_UP_S) {
        tcflush(t->slave, TCIFLUSH);
        t->taken_s = 0;
    }
}

void terminal_write(terminal *t, const uint8_t *bytes, size_t count)
{
    if (t->waiting > 0) {
        push(t);
    }
    if (t->waiting > 0 || count > sizeof t->rest) {
        t->dropped += count;
        return;
    }
    memcpy(t->rest, bytes, count);
    t->waiting = count;
    push(t);
}

void terminal_close(terminal *t)
{
    char path[sizeof t->path];
    const ssize_t count = t->link != NULL ? readlink(t->link, path, sizeof path) : -1;
    if (count == (ssize_t)strlen(t->path) && memcmp(path, t->path, (size_t)count) == 0) {
        unlink(t->link);
    }
    close(t->slave);
    close(t->master);
}

static int digit(char c)
{
    static const char digits[] = "0123456789abcdef";
    const char *found = strchr(digits, c >= 'A' && c <= 'F' ? c + ('a' - 'A') : c);
    return c != '\0' && found != NULL ? (int)(found - digits) : -1;
}

static bool space(char c)
{
    return c == ' ' || (c >= '\t' && c <= '\r');
}

/* What is accepted is the same in quad_bridge/key_file.py. */
static const char *key_in(const char *data, size_t count, uint8_t key[32])
{
    static const char what[] = "must hold 64 hexadecimal digits, or 32 raw bytes";
    size_t first = 0, end = count, digits = 0, set = 0;
    while (end > 0 && space(data[end - 1])) {
        end--;
    }
    while (first < end && space(data[first])) {
        first++;
    }
    while (first + digits < end && digit(data[first + digits]) >= 0) {
        digits++;
    }
    const bool text = first + digits == end;
    if (text && digits == 64) {
        for (size_t i = 0; i < 32; i++) {
            const char *pair = &data[first + 2 * i];
            key[i] = (uint8_t)(16 * digit(pair[0]) + digit(pair[1]));
        }
    } else if (!text && count == 32) { /* 32 digits are half a key */
        memcpy(key, data, 32);
    } else {
        return what;
    }
    for (size_t i = 0; i < 32; i++) {
        set += key[i] != 0;
    }
    return set > 0 ? NULL : "is all zeros, which is no secret";
}

const char *terminal_read_key(const char *path, uint8_t key[32])
{
    char data[LARGEST_KEY + 1];
    size_t count = 0;
    ssize_t got = 1;
    struct stat about;
    const int file = open(path, O_RDONLY);
    if (file < 0) {
        return strerror(errno);
    }
    const bool known = fstat(file, &about) == 0;
    while (got > 0 && count < sizeof data) {
        got = read(file, &data[count], sizeof data - count);
        count += got > 0 ? (size_t)got : 0;
    }
    const char *why = got < 0 ? strerror(errno) : NULL;
    close(file);
    if (why != NULL) {
        return why;
    }
    if (!known || (about.st_mode & (S_IRWXG | S_IRWXO)) != 0) {
        return "must be for its owner alone (chmod 600)";
    }
    return count > LARGEST_KEY ? "is too long for a key" : key_in(data, count, key);
}
