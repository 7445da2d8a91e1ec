/* SPDX-License-Identifier: Apache-2.0 */
/* A load cell on an HX711: one sensor, 24 bits in 3 octets, 80 Hz (profiles/load-cell.toml). */
#include "hx711.h"
#include "teds_zephyr.h"

#include <string.h>
#include <zephyr/drivers/gpio.h>
#include <zephyr/kernel.h>

#define PERIOD 12500000u /* ns: 80 Hz */
#define STALE (8 * (uint64_t)PERIOD)
#define HELD 5000 /* ms that the reset pad is held, once it was seen let go: one that is stuck erases nothing */
#define FULL 0xFFFFFFu

static const teds_channel channels[] = {
    {.number = 1, .kind = TEDS_SENSOR, .model = 0, .octets = 3, .halt = 0, .shortest = PERIOD}};
static const struct gpio_dt_spec pad = GPIO_DT_SPEC_GET(DT_PATH(zephyr_user), reset_gpios);
static struct k_spinlock lock;
static struct {
    uint32_t raw;
    uint64_t at;
    bool seen;
} last;

/* The newest conversion; not valid where the bridge is torn off (either end of the range) or the chip says nothing. */
static bool sample(void *user, uint8_t channel, uint64_t tick, uint8_t *out)
{
    const k_spinlock_key_t key = k_spin_lock(&lock);
    const uint32_t raw = last.raw;
    const bool fresh = last.seen && tick < last.at + STALE;
    k_spin_unlock(&lock, key);
    (void)user;
    (void)channel;
    out[0] = (uint8_t)(raw >> 16);
    out[1] = (uint8_t)(raw >> 8);
    out[2] = (uint8_t)raw;
    return fresh && raw != 0 && raw != FULL;
}

static void convert(void)
{
    uint32_t raw;
    if (hx711_read(&raw)) {
        const k_spinlock_key_t key = k_spin_lock(&lock);
        last.raw = raw;
        last.at = teds_zephyr_now();
        last.seen = true;
        k_spin_unlock(&lock, key);
    }
}

int main(void)
{
    static teds_port port = {.channels = channels, .channel_count = 1, .sample = sample};
    static teds_config config = {.quick_points = false};
    const teds_zephyr_board board = {&port, &config};
    int held = -1, failed = hx711_start();
    if (failed == 0 && gpio_is_ready_dt(&pad)) {
        failed = gpio_pin_configure_dt(&pad, GPIO_INPUT);
    }
    if (failed == 0) {
        failed = teds_zephyr_start(&board);
    }
    if (failed != 0) {
        printk("The node does not start: %d\n", failed);
    }
    while (failed == 0) {
        convert();
        held = gpio_pin_get_dt(&pad) != 1 ? 0 : held < 0 ? held : held + 2;
        if (held == HELD) {
            teds_zephyr_reset_by_hand();
        }
        k_msleep(2);
    }
    return failed;
}
