/* I2C2 as bus master, polled: RM0090 27.3.3. NOT YET RUN ON A BOARD. See board.h. */
#include "board.h"

#define APB1_MHZ 42u
#define SPIN 2000u      /* turns of a bounded wait: some 200 us, nine bytes */
#define HALF_BIT 200u   /* turns of 5 us by hand */
#define PIN_SCL (1u << 10)
#define PIN_SDA (1u << 11)
#define PINS(mode) (((mode) << 20) | ((mode) << 22))

static bool waited(uint32_t bit)
{
    for (uint32_t i = 0; i < SPIN; i++) {
        const uint32_t status = I2C2->SR1;
        if ((status & I2C_SR1_AF) != 0) {
            return false;
        }
        if ((status & bit) != 0) {
            return true;
        }
    }
    return false;
}

static void pause(void)
{
    for (volatile uint32_t i = 0; i < HALF_BIT; i++) {
    }
}

/* 27.6: 400 kHz, duty 1 : 2; rise time 300 ns */
static void set_up(void)
{
    I2C2->CR1 = I2C_CR1_SWRST;
    I2C2->CR1 = 0;
    I2C2->CR2 = APB1_MHZ;
    I2C2->CCR = (1u << 15) | (APB1_MHZ * 10u / (3u * 4u));
    I2C2->TRISE = APB1_MHZ * 3u / 10u + 1u;
    I2C2->CR1 = I2C_CR1_PE;
}

/* A chip that lost count in the middle of a byte holds SDA: nine clocks by hand, some 100 us, set it free
 * (I2C-bus specification UM10204, 3.1.16). */
static void set_free(void)
{
    I2C2->CR1 = 0;
    GPIOB->BSRR = PIN_SCL | PIN_SDA;
    GPIOB->MODER = (GPIOB->MODER & ~PINS(3u)) | PINS(1u); /* outputs, open drain */
    for (uint32_t i = 0; i < 9; i++) {
        GPIOB->BSRR = PIN_SCL << 16;
        pause();
        GPIOB->BSRR = PIN_SCL;
        pause();
    }
    GPIOB->MODER = (GPIOB->MODER & ~PINS(3u)) | PINS(2u); /* the bus drives them again */
}

void i2c_start(void)
{
    RCC->AHB1ENR |= 1u << 1;  /* GPIOB */
    RCC->APB1ENR |= 1u << 22; /* I2C2 */
    GPIOB->OTYPER |= PIN_SCL | PIN_SDA;
    GPIOB->PUPDR |= PINS(1u);
    GPIOB->AFRH |= (4u << 8) | (4u << 12);
    set_free();
    set_up();
}

/* Start condition and address; the last bit of the address says whether we read. */
static bool address(uint8_t byte)
{
    I2C2->CR1 |= I2C_CR1_START;
    if (!waited(I2C_SR1_SB)) {
        return false;
    }
    I2C2->DR = byte;
    return waited(I2C_SR1_ADDR);
}

/* Reading both status registers goes on after the address. */
static void go_on(void)
{
    (void)I2C2->SR1;
    (void)I2C2->SR2;
}

static bool put(uint8_t device, const uint8_t *bytes, size_t count)
{
    if (!address((uint8_t)(device << 1))) {
        return false;
    }
    go_on();
    for (size_t i = 0; i < count; i++) {
        I2C2->DR = bytes[i];
        if (!waited(i + 1 < count ? I2C_SR1_TXE : I2C_SR1_BTF)) {
            return false;
        }
    }
    return true;
}

/* The last two bytes wait in the shift and the data register while the clock stands, so that no
 * interrupt makes us take one too many. */
static bool take(uint8_t device, uint8_t *bytes, size_t count)
{
    I2C2->CR1 |= I2C_CR1_ACK | (count == 2 ? I2C_CR1_POS : 0u);
    if (!address((uint8_t)((device << 1) | 1u))) {
        return false;
    }
    if (count <= 2) {
        I2C2->CR1 &= ~I2C_CR1_ACK;
    }
    go_on();
    if (count == 1) {
        I2C2->CR1 |= I2C_CR1_STOP;
    }
    for (size_t left = count; left > 0; left--) {
        if (!waited(left == 2 || left == 3 ? I2C_SR1_BTF : I2C_SR1_RXNE)) {
            return false;
        }
        if (left == 3) {
            I2C2->CR1 &= ~I2C_CR1_ACK;
        } else if (left == 2) {
            I2C2->CR1 |= I2C_CR1_STOP;
        }
        *bytes++ = (uint8_t)I2C2->DR;
    }
    I2C2->CR1 &= ~I2C_CR1_POS;
    return true;
}

/* 27.6.1: no new start condition before the stop is out. */
static bool done(bool well)
{
    for (uint32_t i = 0; well && i < SPIN; i++) {
        if ((I2C2->CR1 & I2C_CR1_STOP) == 0) {
            return true;
        }
    }
    I2C2->CR1 |= I2C_CR1_STOP;
    pause();
    if ((GPIOB->IDR & PIN_SDA) == 0) {
        set_free();
    }
    set_up();
    return false;
}

static bool write(uint8_t device, const uint8_t *bytes, size_t count)
{
    const bool well = put(device, bytes, count);
    if (well) {
        I2C2->CR1 |= I2C_CR1_STOP;
    }
    return done(well);
}

static bool read(uint8_t device, uint8_t reg_, uint8_t *bytes, size_t count)
{
    return done(put(device, &reg_, 1) && take(device, bytes, count));
}

const quad_bus board_bus = {write, read};
