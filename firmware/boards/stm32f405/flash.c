/* Gains in the last two sectors of flash, 10 and 11. RM0090 3.6: unlock, erase, program by words. The core
 * stands still meanwhile, as its code is in the same flash: a word takes 16 us, an erasure up to 2 s. */
#include "board.h"
#include "quad_store.h"

#define SECTOR_BYTES 0x20000u
#define SPIN 50000000u
#define FLASH_SR_BSY (1u << 16)
#define FLASH_CR_PG (1u << 0)
#define FLASH_CR_SER (1u << 1)
#define FLASH_CR_STRT (1u << 16)
#define FLASH_CR_LOCK (1u << 31)
#define FLASH_CR_WORDS (2u << 8)

static bool idle(void)
{
    for (uint32_t i = 0; i < SPIN; i++) {
        if ((FLASH->SR & FLASH_SR_BSY) == 0) {
            return true;
        }
    }
    return false;
}

static bool unlock(void)
{
    FLASH->KEYR = 0x45670123u;
    FLASH->KEYR = 0xCDEF89ABu;
    FLASH->SR = 0xF2u; /* errors of before */
    return idle();
}

static bool erase(int page)
{
    if (!unlock()) {
        return false;
    }
    FLASH->CR = FLASH_CR_WORDS | FLASH_CR_SER | ((10u + (uint32_t)page) << 3);
    FLASH->CR |= FLASH_CR_STRT;
    const bool done = idle();
    FLASH->CR = FLASH_CR_LOCK;
    return done;
}

static bool program(const volatile uint32_t *word, uint32_t value)
{
    if (!unlock()) {
        return false;
    }
    FLASH->CR = FLASH_CR_WORDS | FLASH_CR_PG;
    *(volatile uint32_t *)(uintptr_t)word = value;
    const bool done = idle() && *word == value;
    FLASH->CR = FLASH_CR_LOCK;
    return done;
}

const quad_flash board_flash = {
    .page = {(const volatile uint32_t *)0x080C0000u, (const volatile uint32_t *)0x080E0000u},
    .records = SECTOR_BYTES / (4u * QUAD_STORE_WORDS),
    .erase = erase,
    .program = program,
};
