/* See quad_store.h. */
#include "quad_store.h"

#include <string.h>

#include "quad_gains.h"

#define BLANK 0xFFFFFFFFu
#define LITTLE 8u /* records that must be free at the start of a flight */

typedef const volatile uint32_t *words;

static words record_of(const quad_flash *flash, int page, size_t number)
{
    return &flash->page[page][number * QUAD_STORE_WORDS];
}

static uint32_t check(uint32_t number, const float values[QUAD_PARAMETERS])
{
    return quad_gains_checksum(values) ^ (number * 2654435761u);
}

/* Whether it is whole; then its values are written. */
static bool read(words record, float values[QUAD_PARAMETERS])
{
    uint32_t bits[QUAD_PARAMETERS];
    for (size_t i = 0; i < QUAD_PARAMETERS; i++) {
        bits[i] = record[1 + i];
    }
    memcpy(values, bits, sizeof bits);
    return record[QUAD_STORE_WORDS - 1] == check(record[0], values);
}

static bool blank(words record)
{
    bool is = true;
    for (size_t i = 0; i < QUAD_STORE_WORDS; i++) {
        is = is && record[i] == BLANK;
    }
    return is;
}

static size_t free_records(const quad_flash *flash, int page)
{
    size_t count = 0;
    while (count < flash->records && blank(record_of(flash, page, flash->records - 1 - count))) {
        count++;
    }
    return count;
}

/* Page and number of the newest record, 0 and number 0 where there is none. */
static uint32_t newest(const quad_flash *flash, int *page, float values[QUAD_PARAMETERS])
{
    uint32_t found = 0;
    float read_values[QUAD_PARAMETERS];
    *page = 0;
    for (int p = 0; p < 2; p++) {
        for (size_t i = 0; i < flash->records; i++) {
            words record = record_of(flash, p, i);
            if (record[0] != BLANK && record[0] > found && read(record, read_values)) {
                found = record[0];
                *page = p;
                memcpy(values, read_values, sizeof read_values);
            }
        }
    }
    return found;
}

bool quad_store_load(const quad_flash *flash, float values[QUAD_PARAMETERS])
{
    int page;
    return newest(flash, &page, values) > 0;
}

bool quad_store_save(const quad_flash *flash, const float values[QUAD_PARAMETERS])
{
    float written[QUAD_PARAMETERS];
    int page;
    const uint32_t number = newest(flash, &page, written) + 1;
    size_t room = free_records(flash, page);
    if (room == 0) {
        page = 1 - page;
        room = free_records(flash, page);
    }
    if (room == 0) {
        return false;
    }
    words record = record_of(flash, page, flash->records - room);
    bool done = flash->program(&record[0], number);
    for (size_t i = 0; i < QUAD_PARAMETERS; i++) {
        uint32_t bits;
        memcpy(&bits, &values[i], sizeof bits);
        done = done && flash->program(&record[1 + i], bits);
    }
    done = done && flash->program(&record[QUAD_STORE_WORDS - 1], check(number, values));
    return done && read(record, written) && memcmp(written, values, sizeof written) == 0;
}

bool quad_store_prepare(const quad_flash *flash)
{
    float values[QUAD_PARAMETERS];
    int page;
    newest(flash, &page, values);
    if (free_records(flash, page) >= LITTLE || free_records(flash, 1 - page) == flash->records) {
        return true;
    }
    return flash->erase(1 - page);
}
