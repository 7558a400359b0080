/* The board with the paper's chips (boards/stm32f405/flight.c and all under it) on this machine: memory lies at
 * its registers' addresses, and a model answers as RM0090 says. It runs what QEMU has not: DMA, flash controller,
 * independent watchdog, I2C with its chips, capture and PWM. x86-64 Linux.
 * The compiler announces each access to volatile memory by a call, as it does for a race detector; the calls are
 * answered below. */
#define _GNU_SOURCE
#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>

#define main flight_main
#include "../boards/stm32f405/flight.c"
#undef main

#define BYTE_NS 22500u /* on the bus */
#define BUS_BYTES 150u /* more than two cycles have */
#define KP QUAD_RATE_KP /* of roll */

static const struct {
    uint32_t at, bytes;
} regions[] = {{0x40000000, 0x30000}, {0xE000E000, 0x1000}, {0x1FFF7000, 0x1000}, {0x080C0000, 0x40000}};
#define REGIONS (sizeof regions / sizeof regions[0])
#define PAGES regions[3] /* of the gains in flash, which may be read at any time */
static uint8_t *const pages = (uint8_t *)0x080C0000u;

static uint64_t now_ns;
static jmp_buf cut;
static long accesses_left = -1;

static void fail(const char *what)
{
    printf("after %.3f s: %s\n", 1e-9 * (double)now_ns, what);
    exit(1);
}

/* What a register holds, to the model, whose accesses nobody announces. */
#define R(register_) (*(uint32_t *)(uintptr_t)&(register_))

/* The chips on the bus. */
static uint8_t mpu[256] = {[0x75] = 0x68}, hmc[256] = {[3] = 1, [10] = 'H', '4', '3'};
static uint16_t prom[8] = {7, 40127, 36924, 23317, 23282, 33464, 28312, 0};
static uint8_t fifo[1024];
static size_t fifo_count, popped, overflows;
static uint64_t sampled_ns, converts_ns;
static uint32_t converting;
static bool gyro_gone, moves, sways, flash_broken;

static void sample(void)
{
    for (; sampled_ns + 1000000 <= now_ns; sampled_ns += 1000000) {
        static const int16_t words[6] = {0, 0, 4096, 13, -26, 0};
        for (size_t i = 0; i < 6 && mpu[0x23] == 0x78 && fifo_count + 2 <= sizeof fifo; i++) {
            const double turn = sways ? 160.0 * sin(2e-9 * (double)sampled_ns) : 0.0; /* 2.4 deg/s, as in a hand */
            const int16_t word = (int16_t)(words[i] + (moves && i == 3 ? 1000 : 0) + (i == 3 ? (int)turn : 0));
            fifo[fifo_count++] = (uint8_t)((uint16_t)word >> 8);
            fifo[fifo_count++] = (uint8_t)word;
        }
        overflows += fifo_count + 12 > sizeof fifo;
    }
    mpu[0x72] = (uint8_t)(fifo_count >> 8);
    mpu[0x73] = (uint8_t)fifo_count;
}

static struct {
    uint8_t device, pointer;
    bool reads, first, receiving, held, latched, addressed;
    uint8_t data, shift;
    uint64_t since_ns;
} i2c;

static void chip_takes(uint8_t byte)
{
    if (i2c.device == 0x77) {
        converting = (byte & 0xE0) == 0x40 ? byte : converting;
        converts_ns = (byte & 0xE0) == 0x40 ? now_ns : converts_ns;
        i2c.pointer = byte;
    } else if (i2c.first) {
        i2c.pointer = byte;
    } else {
        (i2c.device == 0x68 ? mpu : hmc)[i2c.pointer++] = byte;
        fifo_count = i2c.device == 0x68 && i2c.pointer == 0x6B && (byte & 4) ? 0 : fifo_count;
    }
    i2c.first = false;
}

static uint8_t chip_gives(void)
{
    static size_t place;
    place = i2c.first ? 0 : place + 1;
    i2c.first = false;
    if (i2c.device == 0x77) {
        const uint32_t value = now_ns - converts_ns < 9040000 ? 0 : converting == 0x48 ? 9085466 : 8569150;
        return i2c.pointer == 0 ? (uint8_t)(value >> (8 * (2 - place % 3)))
                                : (uint8_t)(prom[(i2c.pointer & 15) / 2] >> (8 * (1 - place % 2)));
    }
    if (i2c.device == 0x1E) {
        return hmc[i2c.pointer++];
    }
    if (i2c.pointer != 0x74) {
        return mpu[i2c.pointer++];
    }
    const uint8_t byte = fifo[0];
    popped++;
    memmove(fifo, &fifo[1], fifo_count > 0 ? --fifo_count : 0);
    return byte;
}

/* A chip that lost count: it holds SDA, no start condition is seen, until nine clocks by hand have come. */
static struct {
    long bytes_left; /* until it happens; negative: it does not */
    bool stuck;
    uint32_t clocks, freed;
} lost_count = {.bytes_left = -1};

static void one_byte_more(void)
{
    if (lost_count.bytes_left >= 0 && lost_count.bytes_left-- == 0) {
        lost_count.stuck = true;
        lost_count.clocks = 0;
        R(I2C2->SR1) = 0;
    }
}

/* 27.3.3: a byte that is in is acknowledged and the next one begins, or the clock stands while two wait. */
static void receive(void)
{
    if (!i2c.receiving || i2c.held || now_ns - i2c.since_ns < BYTE_NS) {
        return;
    }
    const uint8_t byte = chip_gives();
    one_byte_more();
    if (lost_count.stuck) {
        i2c.receiving = false;
        return;
    }
    const bool acknowledge = (R(I2C2->CR1) & I2C_CR1_ACK) != 0;
    i2c.receiving = ((R(I2C2->CR1) & I2C_CR1_POS) != 0 ? i2c.latched : acknowledge);
    i2c.latched = acknowledge;
    i2c.since_ns = now_ns;
    if ((R(I2C2->SR1) & I2C_SR1_RXNE) == 0) {
        i2c.data = byte;
        R(I2C2->SR1) |= I2C_SR1_RXNE;
    } else {
        i2c.shift = byte;
        i2c.held = true;
        R(I2C2->SR1) |= I2C_SR1_BTF;
    }
}

static void clock_by_hand(const volatile void *at, uint32_t value)
{
    const bool output = (R(GPIOB->MODER) >> 20 & 3u) == 1;
    if (lost_count.stuck && at == &GPIOB->BSRR && output && value == 1u << 10 && ++lost_count.clocks == 9) {
        lost_count.stuck = false;
        lost_count.freed++;
    }
}

static void i2c_written(const volatile void *at, uint32_t value)
{
    clock_by_hand(at, value);
    if (lost_count.stuck) {
        R(I2C2->CR1) &= ~(I2C_CR1_START | I2C_CR1_STOP);
        return;
    }
    if (at == &I2C2->DR) {
        one_byte_more();
    }
    if (lost_count.stuck) {
        return;
    }
    if (at == &I2C2->CR1 && (value & I2C_CR1_SWRST) != 0) {
        memset(&i2c, 0, sizeof i2c);
        R(I2C2->SR1) = 0;
    } else if (at == &I2C2->CR1) {
        if ((value & I2C_CR1_START) != 0) {
            R(I2C2->SR1) = I2C_SR1_SB;
        }
        if ((value & I2C_CR1_STOP) != 0) {
            i2c.addressed = false; /* after the byte under way */
        }
        R(I2C2->CR1) = value & ~(I2C_CR1_START | I2C_CR1_STOP);
    } else if (at == &I2C2->DR && (R(I2C2->SR1) & I2C_SR1_SB) != 0) {
        const uint8_t device = (uint8_t)(value >> 1);
        const bool there = (device == 0x68 && !gyro_gone) || device == 0x77 ||
                           (device == 0x1E && (mpu[0x37] & 2) != 0);
        R(I2C2->SR1) = there ? I2C_SR1_ADDR : I2C_SR1_AF;
        i2c.device = device;
        i2c.reads = (value & 1) != 0;
        i2c.first = i2c.addressed = true;
        i2c.latched = (R(I2C2->CR1) & I2C_CR1_ACK) != 0;
    } else if (at == &I2C2->DR) {
        if (!i2c.addressed || i2c.reads) {
            fail("a byte to nobody");
        }
        chip_takes((uint8_t)value);
        R(I2C2->SR1) = I2C_SR1_TXE | I2C_SR1_BTF;
    }
}

static void i2c_read(const volatile void *at)
{
    if (at == &GPIOB->IDR) {
        R(GPIOB->IDR) = (R(GPIOB->IDR) & ~(1u << 11)) | (lost_count.stuck ? 0u : 1u << 11);
    }
    if (lost_count.stuck) {
        now_ns += at == &I2C2->SR1 ? 100 : 0;
        return;
    }
    if (at == &I2C2->SR1) {
        now_ns += 25000;
        receive();
    } else if (at == &I2C2->SR2) {
        R(I2C2->SR1) = i2c.reads ? 0 : I2C_SR1_TXE;
        i2c.receiving = i2c.reads;
        i2c.since_ns = now_ns;
    } else if (at == &I2C2->DR) {
        if ((R(I2C2->SR1) & I2C_SR1_RXNE) == 0) {
            fail("no byte has come");
        }
        R(I2C2->DR) = i2c.data;
        i2c.data = i2c.shift;
        R(I2C2->SR1) = i2c.held ? I2C_SR1_RXNE : 0;
        i2c.since_ns = i2c.held ? now_ns : i2c.since_ns;
        i2c.held = false;
    }
}

/* Watchdog (21.3), flash controller (3.6, 3.9) and timers (18.4). */
static uint64_t fed_ns, longest_unfed_ns, tim2_ns;
static uint32_t keys, programmed, tim2_prescaler;
static bool watched;

static void written(const volatile void *at, uint32_t value, uint32_t before)
{
    if (at == &IWDG->KR && value == 0xCCCC) {
        watched = R(IWDG->PR) == 2 && R(IWDG->RLR) == 200;
        fed_ns = now_ns;
    } else if (at == &IWDG->KR && value == 0xAAAA && watched) {
        longest_unfed_ns = now_ns - fed_ns > longest_unfed_ns ? now_ns - fed_ns : longest_unfed_ns;
        fed_ns = now_ns;
    } else if (at == &FLASH->KEYR) {
        keys = value == 0x45670123u ? 1 : (keys == 1 && value == 0xCDEF89ABu ? 2 : 0);
        R(FLASH->CR) &= keys == 2 ? ~(1u << 31) : ~0u;
    } else if (at == &FLASH->CR) {
        if ((before & (1u << 31)) != 0) {
            fail("the flash is locked");
        }
        if ((value & 2) != 0 && (value & (1u << 16)) != 0) {
            memset(&pages[0x20000 * (((value >> 3) & 15) - 10)], 0xFF, 0x20000);
        }
        R(FLASH->SR) = 1u << 16; /* busy, until it has been asked */
    } else if ((uintptr_t)at >= 0x080C0000u && (uintptr_t)at < 0x08100000u) {
        if ((R(FLASH->CR) & 1) == 0 || (R(FLASH->CR) & (3u << 8)) != 2u << 8) {
            fail("flash written without leave");
        }
        *(uint32_t *)(uintptr_t)at = flash_broken ? before : value & before;
        R(FLASH->SR) = 1u << 16;
        programmed++;
    } else if (at == &TIM2->EGR) {
        tim2_ns = now_ns;
        tim2_prescaler = R(TIM2->PSC);
    }
    i2c_written(at, value);
}

static void to_be_read(const volatile void *at)
{
    if (at == &TIM2->CNT) {
        now_ns += 40000;
        R(TIM2->CNT) = (uint32_t)((now_ns - tim2_ns) * 84 / 1000 / (tim2_prescaler + 1));
    } else if (at == &SYSTICK->CVR) {
        now_ns += 1000;
        R(SYSTICK->CVR) = (uint32_t)(0xFFFFFF - now_ns * 168 / 1000 % 0x1000000);
    } else if (at == &FLASH->SR) {
        static uint32_t asked;
        R(FLASH->SR) &= ++asked % 3 == 0 ? ~(1u << 16) : ~0u;
    } else if (at == &UART5->DR) {
        R(UART5->SR) = 0; /* 30.6.1: the last byte and an overrun are over */
    }
    i2c_read(at);
}

/* A write is announced before it is done: it takes effect with what comes next. */
static struct {
    const volatile uint32_t *at;
    uint32_t before;
} last_write;

static void settle(void)
{
    const volatile uint32_t *at = last_write.at;
    if (at != NULL) {
        last_write.at = NULL;
        written(at, R(*at), last_write.before);
    }
    if (accesses_left > 0 && --accesses_left == 0) {
        longjmp(cut, 1);
    }
}

static void on_access(const volatile void *address, bool writes)
{
    const uintptr_t at = (uintptr_t)address & ~(uintptr_t)3;
    bool known = false;
    for (size_t i = 0; i < REGIONS; i++) {
        known = known || (at >= regions[i].at && at - regions[i].at < regions[i].bytes);
    }
    if (!known) {
        if (at >= 0x1FFF0000u && at <= 0xFFFFFFFFu) {
            fail("an access beyond all registers");
        }
        return; /* a variable */
    }
    if (!writes && at >= PAGES.at && at - PAGES.at < PAGES.bytes) {
        return;
    }
    settle();
    now_ns += 100;
    sample();
    if (writes) {
        last_write.at = (const volatile uint32_t *)at;
        last_write.before = R(*last_write.at);
    } else {
        to_be_read((const volatile void *)at);
    }
}

/* The race detector's names. */
#define ANNOUNCED(bytes) \
    void __tsan_volatile_read##bytes(const volatile void *at); \
    void __tsan_volatile_write##bytes(const volatile void *at); \
    void __tsan_volatile_read##bytes(const volatile void *at) \
    { \
        on_access(at, false); \
    } \
    void __tsan_volatile_write##bytes(const volatile void *at) \
    { \
        on_access(at, true); \
    } \
    NOTHING(__tsan_read##bytes) \
    NOTHING(__tsan_write##bytes)
#define NOTHING(name) \
    void name(void); \
    void name(void) \
    { \
    }

ANNOUNCED(1)
ANNOUNCED(2)
ANNOUNCED(4)
ANNOUNCED(8)
ANNOUNCED(16)
NOTHING(__tsan_read_range)
NOTHING(__tsan_write_range)
NOTHING(__tsan_init)

static void open_registers(void)
{
    for (size_t i = 0; i < REGIONS; i++) {
        void *const at = (void *)(uintptr_t)regions[i].at;
        if (mmap(at, regions[i].bytes, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED_NOREPLACE,
                 -1, 0) != at) {
            fail("the registers' addresses are taken here");
        }
    }
    memset(pages, 0xFF, PAGES.bytes);
    R(RCC->CR) = RCC_CR_HSION | RCC_CR_HSERDY | RCC_CR_PLLRDY;
    R(FLASH->CR) = 1u << 31;
}

/* The flight: what a loop's turn finds on the lines, and what came of it. */
uint32_t board_stack_used(void);
static uint64_t pulse_ns;
static size_t pulse, sent_cycles, told_of_flash;
static uint16_t pulses_us[9] = {1500, 1500, 1000, 1500, 1000, 1000, 1000, 1000, 1000};
static mavlink_message_t heard, whole;
static mavlink_status_t line;

uint32_t board_stack_used(void)
{
    return 0;
}

/* The receiver's next rising edge, as TIM4 captures it. */
static void capture(void)
{
    if (now_ns < pulse_ns) {
        return;
    }
    R(TIM4->CCR1) = (uint32_t)(pulse_ns / 1000) & 0xFFFFu;
    R(TIM4->SR) = 2;
    R(GPIOB->IDR) = 1u << 6;
    receiver_4_interrupt();
    pulse_ns += 1000ull * (pulse < 9 ? pulses_us[pulse] : 6000);
    pulse = (pulse + 1) % 10;
}

/* DMA2's stream 7 has sent its piece: its bytes are on the line. */
static void transmit(void)
{
    dma_stream *tx = &DMA2->S[7];
    if ((R(tx->CR) & DMA_CR_EN) == 0) {
        return;
    }
    const uint8_t *bytes = (const uint8_t *)(uintptr_t)R(tx->M0AR);
    for (uint32_t i = 0; i < R(tx->NDTR); i++) {
        mavlink_status_t status;
        if (mavlink_frame_char_buffer(&heard, &line, bytes[i], &whole, &status) == MAVLINK_FRAMING_OK) {
            char text[51] = "";
            sent_cycles += whole.msgid == MAVLINK_MSG_ID_QUAD_CYCLE;
            if (whole.msgid == MAVLINK_MSG_ID_STATUSTEXT) {
                mavlink_msg_statustext_get_text(&whole, text);
                told_of_flash += strncmp(text, "flash:", 6) == 0;
            }
        }
    }
    R(tx->CR) &= ~DMA_CR_EN;
}

/* DMA2's stream 2 puts what arrives into the ring. */
static void arrive(const uint8_t *bytes, size_t count)
{
    dma_stream *rx = &DMA2->S[2];
    static uint32_t length;
    length = length == 0 ? R(rx->NDTR) : length;
    for (size_t i = 0; i < count; i++) {
        ((uint8_t *)(uintptr_t)R(rx->M0AR))[length - R(rx->NDTR)] = bytes[i];
        R(rx->NDTR) = R(rx->NDTR) == 1 ? length : R(rx->NDTR) - 1;
    }
}

static void command_gains(void)
{
    static const char name[16] = "ROLL_RATE_KP";
    static uint8_t number;
    mavlink_message_t m;
    uint8_t bytes[300];
    mavlink_msg_quad_gains_pack(1, 191, &m, 0, 0, 1, 1, ++number, QUAD_GAINS_ACTION_OPEN);
    arrive(bytes, mavlink_msg_to_send_buffer(bytes, &m));
    mavlink_msg_param_set_pack(1, 191, &m, 1, 1, name, 0.05f + 0.01f * (float)number, 9);
    arrive(bytes, mavlink_msg_to_send_buffer(bytes, &m));
}

static void fly_on(double seconds);

static void agree_on_gains(void)
{
    quad_gains *gains = &flight.firmware.endpoint.gains;
    mavlink_message_t m;
    uint8_t bytes[300];
    mavlink_msg_quad_gains_pack(1, 191, &m, quad_gains_checksum(gains->copy), 5000, 1, 1,
                                gains->transaction, QUAD_GAINS_ACTION_COMMIT);
    arrive(bytes, mavlink_msg_to_send_buffer(bytes, &m));
    fly_on(0.02);
    gains->flown_us = gains->watch_us / 2u; /* as if it had flown for so long */
    mavlink_msg_quad_gains_pack(1, 191, &m, 0, 0, 1, 1, gains->transaction, QUAD_GAINS_ACTION_CONFIRM);
    for (size_t lost_answers = 0; lost_answers < 3; lost_answers++) {
        arrive(bytes, mavlink_msg_to_send_buffer(bytes, &m));
        fly_on(0.02);
    }
}

static void power(void) /* on, or off and on again */
{
    memset(&flight, 0, sizeof flight);
    now_ns += 1000000000;
    watched = false;
    R(ADC1->DR) = 1252; /* 11.1 V */
    pulse_ns = now_ns;
    begin();
    settle();
}

static void fly_on(double seconds)
{
    const uint64_t end_ns = now_ns + (uint64_t)(1e9 * seconds);
    while (now_ns < end_ns) {
        capture();
        transmit();
        turn();
        settle();
    }
}

#define CHECK(holds) \
    do { \
        if (!(holds)) { \
            fail("not so: " #holds); \
        } \
    } while (0)

/* At every byte of two cycles' transfers a chip loses count; then the gyro loses its settings. */
static void test_faults_of_the_bus_in_flight(void)
{
    uint32_t most_silent = 0;
    const uint32_t freed = lost_count.freed;
    for (uint32_t k = 0; k < BUS_BYTES; k++) {
        lost_count.bytes_left = (long)k;
        for (int turns = 0; turns < 20; turns++) {
            fly_on(0.001);
            const uint32_t silent = flight.firmware.attitude.silent;
            most_silent = silent > most_silent ? silent : most_silent;
        }
        CHECK(lost_count.freed == freed + k + 1 && !lost_count.stuck);
        CHECK(flight.firmware.endpoint.armed && flight.firmware.attitude.silent < 2);
        CHECK(fabsf(flight.firmware.record.accel[2] + 9.80665f) < 1e-2f); /* records are whole */
    }
    CHECK(most_silent < 5);
    mpu[0x23] = mpu[0x6A] = 0;
    hmc[2] = 1; /* the compass as well: it is idle, and its last measurement stays */
    fly_on(0.09);
    CHECK(hmc[2] == 0);
    CHECK(flight.firmware.endpoint.armed && mpu[0x23] == 0x78 && flight.firmware.attitude.silent < 2);
    printf("%u faults of the bus, at most %u cycles without the gyro\n", BUS_BYTES, most_silent);
}

static void test_flight(void)
{
    const quad_cycle *record = &flight.firmware.record;
    const float level = (float)(13.0 / 65.5 * 3.141592653589793 / 180.0);
    moves = true;
    fly_on(0.7);
    CHECK(flight.gyro_is);
    CHECK(flight.compass_is);
    CHECK(flight.barometer_is);
    CHECK(!flight.rested);
    moves = false; /* the jolt begins its second of rest anew */
    sways = true;
    fly_on(7.0);
    CHECK(!flight.rested);
    sways = false;
    fly_on(1.6);
    CHECK(flight.rested && fabsf(record->gyro[0]) < 1e-4f && fabsf(record->gyro[1]) < 1e-4f);
    CHECK(fabsf(flight.firmware.settings.mounting.gyro_bias[0] - level) < 1e-5f);
    CHECK(fabsf(record->accel[2] + 9.80665f) < 1e-3f && fabsf(record->attitude[0]) < 1e-3f);
    CHECK(fabsf(flight.inputs.sensors.slow.pressure_hpa - 1000.09f) < 1e-2f);
    CHECK(flight.gauss[0] > 0.2f && popped % 12 == 0 && overflows == 0 && popped > 12 * 1900);
    CHECK(!flight.firmware.endpoint.armed && R(TIM3->CCR1) == 1000);
    CHECK(R(TIM3->PSC) == 83 && R(TIM3->ARR) == 2499 && R(TIM3->CCER) == 0x1111);
    pulses_us[5] = 2000; /* the pilot's switch */
    fly_on(0.2);
    CHECK(flight.firmware.endpoint.armed);
    pulses_us[2] = 1400;
    fly_on(0.3);
    CHECK(fabsf(record->control[0] - 0.4f) < 0.02f && R(TIM3->CCR2) > 1350 && R(TIM3->CCR2) < 1450);
    test_faults_of_the_bus_in_flight();
    gyro_gone = true;
    fly_on(0.2);
    CHECK(!flight.firmware.endpoint.armed && R(TIM3->CCR4) == 1000);
    gyro_gone = false;
    pulses_us[5] = 1000;
    fly_on(0.3);
    CHECK(flight.gyro_is && flight.firmware.attitude.silent == 0);
    mpu[0x23] = mpu[0x6A] = 0; /* a dip of its supply: it answers, and measures nothing */
    hmc[0] = 0x10;
    hmc[2] = 1;
    fly_on(1.0);
    CHECK(hmc[0] == 0x78 && hmc[2] == 0);
    CHECK(flight.gyro_is && mpu[0x23] == 0x78 && flight.firmware.attitude.silent == 0);
    const uint32_t cycles = flight.firmware.timing.cycles;
    CHECK(cycles > 800 && sent_cycles + 2 >= cycles);
    CHECK(watched && longest_unfed_ns < 20000000 && now_ns - fed_ns < 20000000);
    printf("%u cycles flown, %zu sent\n", cycles, sent_cycles);
}

/* The cycle has read its chips for 2 ms before it hears what has come since it began. */
static void test_bytes_that_come_while_chips_are_read(void)
{
    static serial_radio r;
    static const uint8_t sbus[25] = {0x0F};
    serial_radio_start(&r, SERIAL_SBUS);
    for (size_t frame = 0; frame < 10; frame++) {
        now_ns += 6000000;
        const uint64_t began_us = board_now_us();
        for (size_t i = 0; i < sizeof sbus; i++) {
            if (i == 18) {
                receiver_hear(&r, began_us);
            }
            now_ns += 80000; /* and what the interrupt's access takes */
            R(UART5->SR) = USART_SR_RXNE;
            R(UART5->DR) = sbus[i];
            receiver_interrupt();
            settle();
        }
        receiver_hear(&r, board_now_us());
        R(UART5->SR) = 1u << 3; /* an overrun alone interrupts for ever until it is read */
        receiver_interrupt();
        CHECK(R(UART5->SR) == 0);
    }
    CHECK(r.frames == 10 && r.bad == 0);
}

static void test_gains_outlive_the_power(void)
{
    float found[QUAD_PARAMETERS];
    command_gains();
    fly_on(0.05);
    agree_on_gains();
    fly_on(0.05);
    CHECK(flight.firmware.endpoint.gains.confirmations == 1 && flight.kept == 1);
    CHECK(programmed == QUAD_STORE_WORDS && quad_store_load(&board_flash, found));
    CHECK(fabsf(found[KP] - 0.06f) < 1e-6f);
    power();
    fly_on(0.1);
    CHECK(flight.firmware.endpoint.gains.active[KP] == found[KP]);
}

static void test_a_broken_flash_is_told_of_once(void)
{
    flash_broken = true;
    command_gains();
    fly_on(0.05);
    agree_on_gains();
    fly_on(0.5);
    CHECK(flight.firmware.endpoint.gains.confirmations == 1 && told_of_flash == 1);
    flash_broken = false;
}

static void test_cut_at_every_access(void)
{
    static uint8_t before[0x40000];
    float old[QUAD_PARAMETERS], new[QUAD_PARAMETERS], found[QUAD_PARAMETERS];
    quad_store_load(&board_flash, old);
    memcpy(new, old, sizeof new);
    new[KP] = 0.07f;
    memcpy(before, pages, sizeof before);
    long cuts = 0;
    for (volatile bool whole_ = false; !whole_; cuts++) {
        memcpy(pages, before, sizeof before);
        if (setjmp(cut) == 0) {
            accesses_left = cuts + 1;
            whole_ = quad_store_save(&board_flash, new);
            accesses_left = -1;
            settle();
        }
        accesses_left = -1;
        R(FLASH->CR) = 1u << 31; /* as after a reset */
        R(FLASH->SR) = keys = 0;
        CHECK(quad_store_load(&board_flash, found));
        CHECK(memcmp(found, old, sizeof old) == 0 || memcmp(found, new, sizeof new) == 0);
    }
    CHECK(memcmp(found, new, sizeof new) == 0);
    printf("%ld cuts between accesses to the flash\n", cuts - 1);
}

/* Records of this firmware of which none is whole. */
static void test_a_set_up_that_cannot_be_read(void)
{
    uint32_t *word = (uint32_t *)(uintptr_t)pages;
    const uint32_t layout = word[1];
    memset(pages, 0, PAGES.bytes);
    for (uint32_t i = 0; i < 2 * board_flash.records; i++) {
        const size_t page = i < board_flash.records ? 0 : 0x8000 - board_flash.records * QUAD_STORE_WORDS;
        word[page + i * QUAD_STORE_WORDS] = i + 1;
        word[page + i * QUAD_STORE_WORDS + 1] = layout;
    }
    power();
    fly_on(0.1);
    CHECK(flight.firmware.endpoint.unfit != NULL);
    memset(pages, 0xFF, PAGES.bytes);
    power();
    fly_on(0.1);
    CHECK(flight.firmware.endpoint.unfit == NULL);
}

int main(void)
{
    prom[7] = ms5611_crc(prom);
    open_registers();
    power();
    test_flight();
    test_bytes_that_come_while_chips_are_read();
    test_gains_outlive_the_power();
    test_a_broken_flash_is_told_of_once();
    test_cut_at_every_access();
    test_a_set_up_that_cannot_be_read();
    return 0;
}
