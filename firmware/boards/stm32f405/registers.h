/* Registers of the STM32F405 that this board uses, by the sections of its reference manual (RM0090
 * rev. 19) and, for the core, of the ARMv7-M Architecture Reference Manual. */
#ifndef REGISTERS_H
#define REGISTERS_H

#include <stdint.h>

typedef volatile uint32_t reg;

/* RM0090 7.3: reset and clock control */
typedef struct {
    reg CR, PLLCFGR, CFGR, CIR, AHB1RSTR, AHB2RSTR, AHB3RSTR, RESERVED0, APB1RSTR, APB2RSTR,
        RESERVED1[2], AHB1ENR, AHB2ENR, AHB3ENR, RESERVED2, APB1ENR, APB2ENR;
} rcc_registers;
#define RCC ((rcc_registers *)0x40023800u)
#define RCC_CR_HSION (1u << 0)
#define RCC_CR_HSEON (1u << 16)
#define RCC_CR_HSERDY (1u << 17)
#define RCC_CR_PLLON (1u << 24)
#define RCC_CR_PLLRDY (1u << 25)

/* RM0090 3.9: flash interface */
typedef struct {
    reg ACR, KEYR, OPTKEYR, SR, CR;
} flash_registers;
#define FLASH ((flash_registers *)0x40023C00u)

/* RM0090 8.4: general-purpose I/O */
typedef struct {
    reg MODER, OTYPER, OSPEEDR, PUPDR, IDR, ODR, BSRR, LCKR, AFRL, AFRH;
} gpio_registers;
#define GPIOA ((gpio_registers *)0x40020000u)
#define GPIOB ((gpio_registers *)0x40020400u)
#define GPIOC ((gpio_registers *)0x40020800u)
#define GPIOD ((gpio_registers *)0x40020C00u)

/* RM0090 30.6: USART */
typedef struct {
    reg SR, DR, BRR, CR1, CR2, CR3, GTPR;
} usart_registers;
#define USART1 ((usart_registers *)0x40011000u)
#define USART2 ((usart_registers *)0x40004400u)
#define UART5 ((usart_registers *)0x40005000u)
#define USART_SR_RXNE (1u << 5)
#define USART_SR_TXE (1u << 7)

/* RM0090 10.5: DMA */
typedef struct {
    reg CR, NDTR, PAR, M0AR, M1AR, FCR;
} dma_stream;
typedef struct {
    reg LISR, HISR, LIFCR, HIFCR;
    dma_stream S[8];
} dma_registers;
#define DMA1 ((dma_registers *)0x40026000u)
#define DMA2 ((dma_registers *)0x40026400u)
#define DMA_CR_EN (1u << 0)

/* RM0090 18.4: general-purpose timers TIM2 to TIM5 */
typedef struct {
    reg CR1, CR2, SMCR, DIER, SR, EGR, CCMR1, CCMR2, CCER, CNT, PSC, ARR, RCR, CCR1, CCR2, CCR3,
        CCR4;
} timer_registers;
#define TIM2 ((timer_registers *)0x40000000u)
#define TIM3 ((timer_registers *)0x40000400u)
#define TIM4 ((timer_registers *)0x40000800u)
#define TIM5 ((timer_registers *)0x40000C00u)

/* RM0090 21.4: independent watchdog */
typedef struct {
    reg KR, PR, RLR, SR;
} iwdg_registers;
#define IWDG ((iwdg_registers *)0x40003000u)

/* RM0090 27.6: I2C */
typedef struct {
    reg CR1, CR2, OAR1, OAR2, DR, SR1, SR2, CCR, TRISE, FLTR;
} i2c_registers;
#define I2C2 ((i2c_registers *)0x40005800u)
#define I2C_CR1_PE (1u << 0)
#define I2C_CR1_START (1u << 8)
#define I2C_CR1_STOP (1u << 9)
#define I2C_CR1_ACK (1u << 10)
#define I2C_CR1_POS (1u << 11)
#define I2C_CR1_SWRST (1u << 15)
#define I2C_SR1_SB (1u << 0)
#define I2C_SR1_ADDR (1u << 1)
#define I2C_SR1_BTF (1u << 2)
#define I2C_SR1_RXNE (1u << 6)
#define I2C_SR1_TXE (1u << 7)
#define I2C_SR1_AF (1u << 10)

/* RM0090 13.13: ADC */
typedef struct {
    reg SR, CR1, CR2, SMPR1, SMPR2, JOFR[4], HTR, LTR, SQR1, SQR2, SQR3, JSQR, JDR[4], DR;
} adc_registers;
#define ADC1 ((adc_registers *)0x40012000u)
#define ADC_CCR (*(reg *)0x40012304u)

/* RM0090 39.1: unique device id, 96 bits */
#define UNIQUE_ID ((const volatile uint32_t *)0x1FFF7A10u)

/* ARMv7-M B3.3: SysTick; B3.2: application interrupt, vector and coprocessor control; B3.4: NVIC */
typedef struct {
    reg CSR, RVR, CVR, CALIB;
} systick_registers;
#define SYSTICK ((systick_registers *)0xE000E010u)
#define AIRCR (*(reg *)0xE000ED0Cu)
#define AIRCR_RESET 0x05FA0004u
#define CPACR (*(reg *)0xE000ED88u)
#define NVIC_ISER ((reg *)0xE000E100u)
#define USART1_IRQ 37u
#define USART2_IRQ 38u
#define TIM4_IRQ 30u
#define TIM5_IRQ 50u
#define UART5_IRQ 53u

#endif
