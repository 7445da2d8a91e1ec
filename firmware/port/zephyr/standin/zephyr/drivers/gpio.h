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
/* Pins by the names of node and property. */
enum {
    STANDIN_zephyr_user_hx711_data_gpios,
    STANDIN_zephyr_user_hx711_clock_gpios,
    STANDIN_zephyr_user_supply_gpios,
    STANDIN_zephyr_user_reset_gpios,
    STANDIN_teds_led_gpios,
    STANDIN_teds_button_gpios
};
#define STANDIN_PIN(node, property) {&standin_gpio, STANDIN_##node##_##property}
#define GPIO_DT_SPEC_GET(node, property) STANDIN_PIN(node, property)
bool gpio_is_ready_dt(const struct gpio_dt_spec *spec);
int gpio_pin_configure_dt(const struct gpio_dt_spec *spec, gpio_flags_t extra_flags);
int gpio_pin_get_dt(const struct gpio_dt_spec *spec);
int gpio_pin_toggle_dt(const struct gpio_dt_spec *spec);
typedef uint32_t gpio_port_pins_t;
struct gpio_callback;
typedef void (*gpio_callback_handler_t)(const struct device *port, struct gpio_callback *cb, gpio_port_pins_t pins);
struct gpio_callback {
    gpio_callback_handler_t handler;
};
#define GPIO_INT_EDGE_BOTH (BIT(21) | BIT(22))
void gpio_init_callback(struct gpio_callback *callback, gpio_callback_handler_t handler, gpio_port_pins_t pin_mask);
int gpio_add_callback_dt(const struct gpio_dt_spec *spec, struct gpio_callback *callback);
int gpio_pin_interrupt_configure_dt(const struct gpio_dt_spec *spec, gpio_flags_t flags);
int gpio_pin_set_dt(const struct gpio_dt_spec *spec, int value);

#endif
