/* Power cut at every byte of a write, and of an erasure: what is loaded is the old set or the new one. */
#include <setjmp.h>
#include <stdio.h>
#include <string.h>

#include "quad_store.h"

#define RECORDS 9

static uint32_t pages[2][RECORDS * QUAD_STORE_WORDS];
static long bytes_left;
static jmp_buf cut;

static void power(void)
{
    if (bytes_left-- == 0) {
        longjmp(cut, 1);
    }
}

static bool erase(int page)
{
    uint8_t *bytes = (uint8_t *)pages[page];
    for (size_t i = 0; i < sizeof pages[page]; i++) {
        power();
        bytes[i] = 0xFF;
    }
    return true;
}

static bool program(const volatile uint32_t *word, uint32_t value)
{
    const int page = word >= pages[1] && word < pages[1] + RECORDS * QUAD_STORE_WORDS ? 1 : 0;
    uint8_t *bytes = (uint8_t *)&pages[page][word - pages[page]], wanted[4];
    memcpy(wanted, &value, sizeof wanted);
    for (size_t i = 0; i < 4; i++) {
        power();
        bytes[i] &= wanted[i];
    }
    return true;
}

static const quad_flash flash = {{pages[0], pages[1]}, RECORDS, erase, program};

/* Whether it holds something that cannot be loaded. */
static bool strange(void)
{
    float values[QUAD_PARAMETERS];
    return !quad_store_load(&flash, values) && !quad_store_blank(&flash);
}

static void fill(float *set, float value)
{
    for (size_t i = 0; i < QUAD_PARAMETERS; i++) {
        set[i] = value + (float)i;
    }
}

int main(void)
{
    static uint32_t before[2][RECORDS * QUAD_STORE_WORDS];
    float old[QUAD_PARAMETERS], new[QUAD_PARAMETERS], found[QUAD_PARAMETERS];
    static volatile long cuts;
    memset(pages, 0xFF, sizeof pages);
    if (quad_store_load(&flash, found)) {
        return printf("erased flash has gains\n"), 1;
    }
    pages[1][3] = 7u; /* of another firmware */
    if (!strange()) {
        return printf("strange values are taken for none\n"), 1;
    }
    pages[1][3] = 0xFFFFFFFFu;
    if (strange()) {
        return printf("erased flash is strange\n"), 1;
    }
    for (int round = 0; round < 4 * RECORDS; round++) {
        bytes_left = -1;
        fill(old, (float)round);
        fill(new, (float)round + 0.5f);
        if (!quad_store_prepare(&flash) || !quad_store_save(&flash, old) ||
            !quad_store_load(&flash, found) || memcmp(found, old, sizeof old) != 0) {
            return printf("round %d is lost\n", round), 1;
        }
        memcpy(before, pages, sizeof pages);
        for (volatile long at = 0, whole = 0; whole == 0; at++) {
            memcpy(pages, before, sizeof pages);
            bytes_left = at;
            if (setjmp(cut) == 0) {
                quad_store_prepare(&flash);
                whole = quad_store_save(&flash, new);
            }
            bytes_left = -1;
            if (!quad_store_load(&flash, found) || (memcmp(found, old, sizeof old) != 0 &&
                                                    memcmp(found, new, sizeof new) != 0)) {
                return printf("cut at byte %ld of round %d: neither\n", at, round), 1;
            }
            if (!quad_store_prepare(&flash) || !quad_store_save(&flash, new)) {
                return printf("cut at byte %ld of round %d: no room\n", at, round), 1;
            }
            cuts++;
        }
    }
    bytes_left = -1;
    memset(pages, 0xFF, sizeof pages);
    quad_store_save(&flash, old);
    quad_store_save(&flash, new);
    for (size_t word = 0; word < QUAD_STORE_WORDS; word++) { /* 1: of a table in another order */
        pages[0][QUAD_STORE_WORDS + word] ^= 1u;
        if (!quad_store_load(&flash, found) || memcmp(found, old, sizeof old) != 0) {
            return printf("word %zu of the newest is wrong: the one before is not found\n", word), 1;
        }
        pages[0][QUAD_STORE_WORDS + word] ^= 1u;
    }
    if (strange()) {
        return printf("its own records are strange\n"), 1;
    }
    printf("%ld cuts\n", cuts);
    return 0;
}
