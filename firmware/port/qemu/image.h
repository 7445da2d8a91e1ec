/* SPDX-License-Identifier: Apache-2.0 */
/* A bare Cortex-M under qemu: the start, the clock, the serial line. Machines: microbit (Cortex-M0, the instructions of
 * an M0+), mps2-an386 (Cortex-M4) and mps2-an505 (Cortex-M33). With -icount shift=0 an instruction takes a nanosecond, so
 * that the clock counts instructions. */
#ifndef TEDS_IMAGE_H
#define TEDS_IMAGE_H

#include <stddef.h>
#include <stdint.h>

/* Ticks of SysTick since the start, and ns in one. */
uint64_t image_ticks(void);
#if defined(TEDS_MICROBIT)
#define IMAGE_TICK_PICOSECONDS 62500u /* 16 MHz */
#elif defined(TEDS_AN505)
#define IMAGE_TICK_PICOSECONDS 50000u /* 20 MHz */
#else
#define IMAGE_TICK_PICOSECONDS 40000u /* 25 MHz */
#endif

/* Octets of stack that were ever used below the caller of image_paint. */
void image_paint(void);
uint32_t image_stack_used(void);

/* Semihosting: words to qemu's console, and the end. */
void image_say(const char *words);
void image_say_number(const char *words, uint32_t number);
void image_end(void);

#endif
