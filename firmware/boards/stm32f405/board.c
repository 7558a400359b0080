/* Clock, time and watchdog of the STM32F405. See board.h. */
#include "board.h"

#define CORE_MHZ 168u
#define HSE_MHZ 8u
#define SPIN 200000u /* turns of a bounded wait: some ms */
#define BITTEN 0xB17E4D06u

__attribute__((section(".noinit"))) static uint32_t bitten;
static volatile uint32_t unheard_ms;
static uint32_t last_count;
static uint64_t base_us;

/* An emulator without this block reads 0. */
static bool emulated(void)
{
    return (RCC->CR & RCC_CR_HSION) == 0;
}

static bool waited(const reg *from, uint32_t bit)
{
    for (uint32_t i = 0; i < SPIN; i++) {
        if ((*from & bit) != 0) {
            return true;
        }
    }
    return false;
}

/* RM0090 7.2.3, 3.5.1: 168 MHz from the crystal, or from the internal oscillator where there is none;
 * APB1 at 42 MHz, APB2 at 84 MHz. */
static void start_clock(void)
{
    if (emulated()) {
        return;
    }
    RCC->CR |= RCC_CR_HSEON;
    const bool crystal = waited(&RCC->CR, RCC_CR_HSERDY);
    const uint32_t in_mhz = crystal ? HSE_MHZ : 16u;
    RCC->PLLCFGR = in_mhz | (336u << 6) | (0u << 16) | (crystal ? 1u << 22 : 0u) | (7u << 24);
    RCC->CR |= RCC_CR_PLLON;
    FLASH->ACR = (1u << 10) | (1u << 9) | (1u << 8) | 5u; /* caches, prefetch, 5 wait states */
    if (waited(&RCC->CR, RCC_CR_PLLRDY)) {
        RCC->CFGR = (5u << 10) | (4u << 13) | 2u;
    }
}

/* TIM2 counts us. Its clock is 84 MHz on the chip; an emulator's may be another one, so it is measured
 * against the core's. */
static void start_time(void)
{
    RCC->APB1ENR |= 1u << 0;
    TIM2->ARR = 0xFFFFFFFFu;
    TIM2->PSC = 0;
    TIM2->EGR = 1;
    TIM2->CR1 = 1;
    SYSTICK->RVR = 0xFFFFFFu;
    SYSTICK->CVR = 0;
    SYSTICK->CSR = 5;
    const uint32_t first = TIM2->CNT, start = SYSTICK->CVR;
    uint32_t gone = 0;
    for (uint32_t i = 0; i < 100u * SPIN && gone < 2000u * CORE_MHZ; i++) {
        gone = (start - SYSTICK->CVR) & 0xFFFFFFu;
    }
    const uint32_t mhz = (TIM2->CNT - first) / 2000u;
    TIM2->PSC = (mhz > 500u ? 1000u : 84u) - 1u;
    TIM2->EGR = 1; /* RM0090 18.4.6: takes over the prescaler, clears the counter */
    last_count = TIM2->CNT;
}

uint64_t board_now_us(void)
{
    const uint32_t count = TIM2->CNT;
    base_us += (uint32_t)(count - last_count);
    last_count = count;
    return base_us;
}

void board_alive(void)
{
    unheard_ms = 0;
    IWDG->KR = 0xAAAAu;
}

/* The chip's own watchdog needs nobody's help. This one is for where it is not there, and leaves word
 * that it has bitten. */
void board_tick(void)
{
    if (++unheard_ms > (emulated() ? EMULATED_HUNG_MS : BOARD_HUNG_MS)) {
        bitten = BITTEN;
        AIRCR = AIRCR_RESET;
    }
}

uint64_t board_id(void)
{
    if (emulated()) { /* nothing is at that address */
        return 0;
    }
    const uint64_t low = UNIQUE_ID[0], high = UNIQUE_ID[1];
    return (high << 32 | low) ^ UNIQUE_ID[2];
}

bool board_start(void)
{
    const bool was_bitten = bitten == BITTEN;
    bitten = 0;
    start_clock();
    start_time();
    SYSTICK->RVR = CORE_MHZ * 1000u - 1u;
    SYSTICK->CVR = 0;
    SYSTICK->CSR = 7;
    IWDG->KR = 0x5555u; /* RM0090 21.3: 32 kHz / 16, 100 ms */
    IWDG->PR = 2;
    IWDG->RLR = 200;
    IWDG->KR = 0xCCCCu;
    board_alive();
    return was_bitten;
}
