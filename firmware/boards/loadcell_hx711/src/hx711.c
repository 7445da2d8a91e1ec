/* SPDX-License-Identifier: Apache-2.0 */
#include "hx711.h"

#include <zephyr/drivers/gpio.h>
#include <zephyr/kernel.h>

#define PINS DT_PATH(zephyr_user)
#define PULSE 1 /* µs; the clock may be high for 50 µs at most, at 60 the chip powers down (HX711 datasheet, figure 2) */

static const struct gpio_dt_spec data = GPIO_DT_SPEC_GET(PINS, hx711_data_gpios);
static const struct gpio_dt_spec pulses = GPIO_DT_SPEC_GET(PINS, hx711_clock_gpios);

int hx711_start(void)
{
    int failed;
    if (!gpio_is_ready_dt(&data) || !gpio_is_ready_dt(&pulses)) {
        return -ENODEV;
    }
    failed = gpio_pin_configure_dt(&data, GPIO_INPUT);
    return failed != 0 ? failed : gpio_pin_configure_dt(&pulses, GPIO_OUTPUT_INACTIVE);
}

bool hx711_read(uint32_t *out)
{
    uint32_t bits = 0;
    if (gpio_pin_get_dt(&data) != 0) {
        return false; /* high until a conversion is there */
    }
    for (int i = 0; i < 25; i++) { /* the 25th pulse chooses channel A, gain 128, for the next one */
        const unsigned int key = irq_lock(); /* an interrupt while the clock is high would power the chip down */
        (void)gpio_pin_set_dt(&pulses, 1);
        k_busy_wait(PULSE);
        if (i < 24) {
            bits = bits << 1 | (gpio_pin_get_dt(&data) != 0 ? 1u : 0u);
        }
        (void)gpio_pin_set_dt(&pulses, 0);
        irq_unlock(key);
        k_busy_wait(PULSE);
    }
    *out = bits ^ 0x800000u; /* from two's complement to offset binary */
    return true;
}
