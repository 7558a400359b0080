/* What a test program counts, and how it ends. */
#ifndef CHECK_H
#define CHECK_H

#include <stdbool.h>
#include <stdio.h>

static long checks, failures;

static void check(bool holds, const char *what)
{
    checks++;
    if (!holds && failures++ < 20) {
        printf("not so: %s\n", what);
    }
}

static int checked(void)
{
    printf("%ld checks, %ld failed\n", checks, failures);
    return failures > 0;
}

#endif
