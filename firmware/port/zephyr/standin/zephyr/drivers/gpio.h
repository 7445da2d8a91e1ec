/* SPDX-License-Identifier: Apache-2.0 */
#ifndef STANDIN_GPIO_H
#define STANDIN_GPIO_H

#include <zephyr/kernel.h>

typedef uint32_t gpio_flags_t;
#define GPIO_INPUT BIT(16)
#define GPIO_OUTPUT_INACTIVE (BIT(17) | BIT(18))
struct gpio_dt_spec {
    const struct device *port;
    uint8_t pin;
};
/* Pins by the names of their properties. */
enum { STANDIN_hx711_data_gpios, STANDIN_hx711_clock_gpios, STANDIN_supply_gpios, STANDIN_reset_gpios };
#define GPIO_DT_SPEC_GET(node, property) {&standin_gpio, STANDIN_##property}
bool gpio_is_ready_dt(const struct gpio_dt_spec *spec);
int gpio_pin_configure_dt(const struct gpio_dt_spec *spec, gpio_flags_t extra_flags);
int gpio_pin_get_dt(const struct gpio_dt_spec *spec);
int gpio_pin_set_dt(const struct gpio_dt_spec *spec, int value);

#endif
