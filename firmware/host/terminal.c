/* See terminal.h. */
#define _DEFAULT_SOURCE /* cfmakeraw */
#define _XOPEN_SOURCE 700

#include "terminal.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <termios.h>
#include <unistd.h>

bool terminal_open(terminal *t, const char *link)
{
    struct termios mode;
    t->link = NULL;
    t->master = posix_openpt(O_RDWR | O_NOCTTY);
    if (t->master < 0 || grantpt(t->master) != 0 || unlockpt(t->master) != 0) {
        return false;
    }
    const char *name = ptsname(t->master);
    if (name == NULL || strlen(name) >= sizeof t->path) {
        return false;
    }
    strcpy(t->path, name);
    /* the slave stays open here, or its raw mode would be lost with the last reader */
    t->slave = open(t->path, O_RDWR | O_NOCTTY);
    if (t->slave < 0 || tcgetattr(t->slave, &mode) != 0) {
        return false;
    }
    cfmakeraw(&mode);
    if (tcsetattr(t->slave, TCSANOW, &mode) != 0 ||
        fcntl(t->master, F_SETFL, O_NONBLOCK) != 0) {
        return false;
    }
    if (link != NULL && symlink(t->path, link) != 0) {
        return false;
    }
    t->link = link;
    return true;
}

size_t terminal_read(terminal *t, uint8_t *bytes, size_t room, int64_t wait_us)
{
    struct pollfd port = {t->master, POLLIN, 0};
    const int wait_ms = wait_us > 0 ? (int)((wait_us + 999) / 1000) : 0;
    if (poll(&port, 1, wait_ms) <= 0) {
        return 0;
    }
    const ssize_t count = read(t->master, bytes, room);
    return count > 0 ? (size_t)count : 0;
}

void terminal_write(terminal *t, const uint8_t *bytes, size_t count)
{
    if (write(t->master, bytes, count) < 0 && errno == EAGAIN) {
        tcflush(t->slave, TCIFLUSH); /* nobody reads: what is old goes */
    }
}

void terminal_close(terminal *t)
{
    if (t->link != NULL) {
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

const char *terminal_read_key(const char *path, uint8_t key[32])
{
    char text[80] = {0};
    struct stat about;
    const int file = open(path, O_RDONLY);
    if (file < 0) {
        return strerror(errno);
    }
    const bool known = fstat(file, &about) == 0;
    const ssize_t count = read(file, text, sizeof text - 1);
    close(file);
    if (!known || (about.st_mode & (S_IRWXG | S_IRWXO)) != 0) {
        return "must be for its owner alone (chmod 600)";
    }
    if (count == 32) {
        memcpy(key, text, 32);
        return NULL;
    }
    for (size_t i = 0; i < 32; i++) {
        const int high = digit(text[2 * i]), low = high < 0 ? -1 : digit(text[2 * i + 1]);
        if (low < 0) {
            return "must hold 32 bytes, or 64 hexadecimal digits";
        }
        key[i] = (uint8_t)(16 * high + low);
    }
    if (digit(text[64]) >= 0) {
        return "must hold 32 bytes, or 64 hexadecimal digits";
    }
    return NULL;
}
