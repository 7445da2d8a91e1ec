/* SPDX-License-Identifier: Apache-2.0 */
/* A gripper: one actuator with a dead-man, two sensors (profiles/gripper.toml). */
#include "gripper.h"
#include "teds_zephyr.h"

#include <zephyr/drivers/gpio.h>
#include <zephyr/kernel.h>

#define HELD 5000 /* ms that the reset pad is held, once it was seen let go: one that is stuck erases nothing */

static const struct gpio_dt_spec pad = GPIO_DT_SPEC_GET(DT_PATH(zephyr_user), reset_gpios);

int main(void)
{
    static teds_port port;
    static teds_config config = {.quick_points = false};
    const teds_zephyr_board board = {&port, &config};
    int held = -1, failed = gripper_start();
    gripper_fill(&port);
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
        held = gpio_pin_get_dt(&pad) != 1 ? 0 : held < 0 ? held : held + 10;
        if (held == HELD) {
            teds_zephyr_reset_by_hand();
        }
        k_msleep(10);
    }
    return failed;
}
