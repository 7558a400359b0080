/* Confirmed gains in flash: a log of records in two pages, so that a cut at any moment leaves the old
 * set or the new one. The flash itself is the board's. */
#ifndef QUAD_STORE_H
#define QUAD_STORE_H

#include "quad_parameters.h"

#include <stdint.h>

#define QUAD_STORE_WORDS (QUAD_PARAMETERS + 3) /* size of a record: number, layout, values, CRC-32 */

/* A page is words that are all ones when erased; a word is programmed once. Both calls say whether it
 * worked. */
typedef struct {
    const volatile uint32_t *page[2];
    size_t records; /* records in a page */
    bool (*erase)(int page);
    bool (*program)(const volatile uint32_t *word, uint32_t value);
} quad_flash;

/* The values of the newest whole record that a table with the same names in the same order has written; false where
 * there is none. It checks that record and no older one. */
bool quad_store_load(const quad_flash *flash, float values[QUAD_PARAMETERS]);

/* Whether nothing is in it. Where that is not so and nothing can be loaded, it holds what another firmware wrote. */
bool quad_store_blank(const quad_flash *flash);

/* Append a record; false where there is no room before quad_store_prepare, or it cannot be read back. */
bool quad_store_save(const quad_flash *flash, const float values[QUAD_PARAMETERS]);

/* Before the first cycle: make room where little is left. Erasing takes seconds on some chips. */
bool quad_store_prepare(const quad_flash *flash);

#endif
