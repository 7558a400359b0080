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

/* FNV-1a of the parameters' names: another firmware's values may mean something else. */
static uint32_t layout(void)
{
    uint32_t hash = 2166136261u;
    for (size_t i = 0; i < QUAD_PARAMETERS; i++) {
        for (size_t k = 0; k < QUAD_NAME_LENGTH; k++) {
            hash = (hash ^ (uint8_t)quad_parameters[i].name[k]) * 16777619u;
        }
    }
    return hash;
}

/* Whether it is whole; then its values are written. */
static bool read(words record, float values[QUAD_PARAMETERS])
{
    uint32_t bits[QUAD_PARAMETERS];
    for (size_t i = 0; i < QUAD_PARAMETERS; i++) {
        bits[i] = record[2 + i];
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

/* Where a record stands; of two with one number the first was cut off. */
typedef struct {
    uint32_t number; /* 0: no record */
    int page;
    size_t index;
} mark;

static bool later(mark a, mark b)
{
    if (a.number != b.number) {
        return a.number > b.number;
    }
    return a.page != b.page ? a.page > b.page : a.index > b.index;
}

/* The last record before `before` by its number alone: to compute a checksum of each would take a second. */
static mark last(const quad_flash *flash, mark before, uint32_t wanted)
{
    mark found = {0, 0, 0};
    for (int p = 0; p < 2; p++) {
        for (size_t i = 0; i < flash->records; i++) {
            words record = record_of(flash, p, i);
            const mark here = {record[0], p, i};
            if (record[1] == wanted && later(before, here) && later(here, found)) {
                found = here;
            }
        }
    }
    return found;
}

/* The newest whole record; its number and page are 0 where there is none. */
static mark newest(const quad_flash *flash, float values[QUAD_PARAMETERS])
{
    const uint32_t wanted = layout();
    mark found = last(flash, (mark){BLANK, 0, 0}, wanted); /* before all that is blank */
    while (found.number > 0 && !read(record_of(flash, found.page, found.index), values)) {
        found = last(flash, found, wanted);
    }
    return found;
}

bool quad_store_load(const quad_flash *flash, float values[QUAD_PARAMETERS])
{
    return newest(flash, values).number > 0;
}

bool quad_store_blank(const quad_flash *flash)
{
    return free_records(flash, 0) + free_records(flash, 1) == 2u * flash->records;
}

bool quad_store_save(const quad_flash *flash, const float values[QUAD_PARAMETERS])
{
    float written[QUAD_PARAMETERS];
    const mark before = newest(flash, written);
    const uint32_t number = before.number + 1;
    int page = before.page;
    size_t room = free_records(flash, page);
    if (room == 0) {
        page = 1 - page;
        room = free_records(flash, page);
    }
    if (room == 0) {
        return false;
    }
    words record = record_of(flash, page, flash->records - room);
    bool done = flash->program(&record[0], number) && flash->program(&record[1], layout());
    for (size_t i = 0; i < QUAD_PARAMETERS; i++) {
        uint32_t bits;
        memcpy(&bits, &values[i], sizeof bits);
        done = done && flash->program(&record[2 + i], bits);
    }
    done = done && flash->program(&record[QUAD_STORE_WORDS - 1], check(number, values));
    return done && read(record, written) && memcmp(written, values, sizeof written) == 0;
}

bool quad_store_prepare(const quad_flash *flash)
{
    float values[QUAD_PARAMETERS];
    const int page = newest(flash, values).page;
    if (free_records(flash, page) >= LITTLE || free_records(flash, 1 - page) == flash->records) {
        return true;
    }
    return flash->erase(1 - page);
}
