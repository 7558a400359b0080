/* What the host makes of key files: a line for each argument, the key or why it is none. */
#include <stdio.h>

#include "terminal.h"

int main(int count, char **given)
{
    for (int i = 1; i < count; i++) {
        uint8_t key[32];
        const char *why = terminal_read_key(given[i], key);
        for (size_t k = 0; why == NULL && k < sizeof key; k++) {
            printf("%02x", key[k]);
        }
        puts(why != NULL ? why : "");
    }
    return 0;
}
