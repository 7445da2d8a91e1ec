/* SPDX-License-Identifier: Apache-2.0 */
#include "image.h"

#include <stdbool.h>

extern uint32_t image_stack_top, image_stack_bottom, image_data_from, image_data, image_data_end, image_bss,
    image_bss_end;
int main(void);

#define REGISTER(at) (*(volatile uint32_t *)(uintptr_t)(at))
#define SYSTICK_CONTROL REGISTER(0xE000E010u)
#define SYSTICK_RELOAD REGISTER(0xE000E014u)
#define SYSTICK_VALUE REGISTER(0xE000E018u)
#define PENDING REGISTER(0xE000ED04u)
#define SYSTICK_PENDS (1u << 26)
#define RELOAD 0xFFFFFFu

static volatile uint32_t wraps;

void image_reset(void);
void image_systick(void);
void image_fault(void);

void image_reset(void)
{
    uint32_t *from = &image_data_from, *to = &image_data;
    while (to < &image_data_end) {
        *to++ = *from++;
    }
    for (to = &image_bss; to < &image_bss_end; to++) {
        *to = 0;
    }
    SYSTICK_RELOAD = RELOAD;
    SYSTICK_VALUE = 0;
    SYSTICK_CONTROL = 7;
    (void)main();
    image_end();
    for (;;) {
    }
}

void image_systick(void)
{
    wraps++;
}

void image_fault(void)
{
    image_say("fault\n");
    image_end();
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    &image_stack_top,   (void *)image_reset, (void *)image_fault, (void *)image_fault, (void *)image_fault,
    (void *)image_fault, (void *)image_fault, 0, 0, 0, 0, (void *)image_fault, 0, 0, (void *)image_fault,
    (void *)image_systick};

uint64_t image_ticks(void)
{
    uint32_t before, value, pends;
    do {
        before = wraps;
        value = SYSTICK_VALUE;
        pends = PENDING & SYSTICK_PENDS;
    } while (before != wraps);
    /* It has run over and its interrupt has not been taken yet: without this the clock would go back by 0.7 s, and a
     * session would seem to be older than the node. */
    before += pends != 0 && value > RELOAD / 2 ? 1u : 0u;
    return (uint64_t)before * (RELOAD + 1u) + (RELOAD - value);
}

#define PAINT 0xA5A5A5A5u

static volatile uint32_t *here(void)
{
    volatile uint32_t *at;
    __asm__ volatile("mov %0, sp" : "=r"(at));
    return at;
}

static volatile uint32_t *painted_from;

void image_paint(void)
{
    painted_from = here();
    for (volatile uint32_t *at = &image_stack_bottom; at < painted_from; at++) {
        *at = PAINT;
    }
}

uint32_t image_stack_used(void)
{
    const volatile uint32_t *at = &image_stack_bottom;
    while (at < painted_from && *at == PAINT) {
        at++;
    }
    return (uint32_t)((uintptr_t)painted_from - (uintptr_t)at);
}

static void semihost(uint32_t operation, const void *argument)
{
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
}

void image_say(const char *words)
{
    semihost(4, words);
}

void image_say_number(const char *words, uint32_t number)
{
    char digits[12];
    size_t at = sizeof digits - 2;
    digits[at + 1] = '\0';
    digits[at] = '\n';
    do {
        digits[--at] = (char)('0' + number % 10);
        number /= 10;
    } while (number > 0);
    image_say(words);
    image_say(digits + at);
}

void image_end(void)
{
    semihost(0x18, (const void *)(uintptr_t)0x20026u);
}
