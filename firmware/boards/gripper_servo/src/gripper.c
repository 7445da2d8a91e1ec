/* SPDX-License-Identifier: Apache-2.0 */
#include "gripper.h"

#include <string.h>
#include <zephyr/drivers/adc.h>
#include <zephyr/drivers/gpio.h>
#include <zephyr/drivers/pwm.h>
#include <zephyr/kernel.h>

#define PARTS DT_PATH(zephyr_user)
#define PERIOD 10000000u  /* ns: 100 Hz */
#define MOST 4095u        /* of a raw value (profiles/gripper.toml) */
#define CLOSED 1000000u   /* ns of the servo's pulse */
#define STROKE 1000000u
#define CONVERSION 5      /* ms between two conversions of both inputs */

static const teds_channel channels[] = {
    {.number = SET_POINT, .kind = TEDS_ACTUATOR, .model = 0, .octets = 2, .halt = 3, .shortest = PERIOD},
    {.number = OPENING, .kind = TEDS_SENSOR, .model = 0, .octets = 2, .halt = 0, .shortest = PERIOD},
    {.number = FORCE, .kind = TEDS_SENSOR, .model = 0, .octets = 2, .halt = 0, .shortest = PERIOD}};
static const struct adc_dt_spec inputs[2] = {ADC_DT_SPEC_GET_BY_IDX(PARTS, 0), ADC_DT_SPEC_GET_BY_IDX(PARTS, 1)};
static const struct pwm_dt_spec servo = PWM_DT_SPEC_GET(PARTS);
static const struct gpio_dt_spec supply = GPIO_DT_SPEC_GET(PARTS, supply_gpios);
static atomic_t converted[2] = {ATOMIC_INIT(-1), ATOMIC_INIT(-1)};
static atomic_t moving = ATOMIC_INIT(0);
static uint8_t set_point[2];
static uint16_t dead_man;

/* The system timer's interrupt, so neither a point multiplication nor an erase delays it. A pin alone: a PWM driver may
 * wait for its peripheral, and the servo lets go without power whatever its signal says. */
static void let_go(struct k_timer *timer)
{
    (void)timer;
    (void)gpio_pin_set_dt(&supply, 0);
    atomic_set(&moving, 0);
}

static K_TIMER_DEFINE(watch, let_go, NULL);

static void convert(void *one, void *two, void *three)
{
    (void)one;
    (void)two;
    (void)three;
    for (;;) {
        for (int i = 0; i < 2; i++) {
            uint16_t value = 0;
            struct adc_sequence sequence = {.buffer = &value, .buffer_size = sizeof value};
            const bool good = adc_sequence_init_dt(&inputs[i], &sequence) == 0 && adc_read_dt(&inputs[i], &sequence) == 0;
            atomic_set(&converted[i], good ? (atomic_val_t)value : -1);
        }
        k_msleep(CONVERSION);
    }
}

/* Above the node's thread: its cryptography must not hold up a conversion. */
K_THREAD_DEFINE(gripper_converts, 768, convert, NULL, NULL, NULL, 5, 0, SYS_FOREVER_MS);

int gripper_start(void)
{
    int failed;
    if (!gpio_is_ready_dt(&supply) || !pwm_is_ready_dt(&servo) || !adc_is_ready_dt(&inputs[0]) ||
        !adc_is_ready_dt(&inputs[1])) {
        return -ENODEV;
    }
    failed = gpio_pin_configure_dt(&supply, GPIO_OUTPUT_INACTIVE);
    for (int i = 0; i < 2 && failed == 0; i++) {
        failed = adc_channel_setup_dt(&inputs[i]);
    }
    if (failed == 0) {
        k_thread_start(gripper_converts);
    }
    return failed;
}

static bool sample(void *user, uint8_t channel, uint64_t tick, uint8_t *out)
{
    const atomic_val_t value = atomic_get(&converted[channel == FORCE]);
    (void)user;
    (void)tick;
    out[0] = (uint8_t)(value >> 8);
    out[1] = (uint8_t)value;
    return value >= 0;
}

static bool bears(void *user, uint8_t channel, const uint8_t *octets)
{
    (void)user;
    (void)channel;
    return ((uint32_t)octets[0] << 8 | octets[1]) <= MOST;
}

static void set(void *user, uint8_t channel, const uint8_t *octets)
{
    const uint32_t raw = (uint32_t)octets[0] << 8 | octets[1];
    (void)user;
    (void)channel;
    memcpy(set_point, octets, sizeof set_point);
    if (pwm_set_pulse_dt(&servo, CLOSED + raw * STROKE / MOST) == 0) {
        atomic_set(&moving, 1);
        (void)gpio_pin_set_dt(&supply, 1);
    }
}

static void tell_set_point(void *user, uint8_t channel, uint8_t *out)
{
    (void)user;
    (void)channel;
    memcpy(out, set_point, sizeof set_point);
}

static void safe(void *user, uint8_t channel)
{
    (void)user;
    (void)channel;
    k_timer_stop(&watch);
    let_go(NULL);
}

static void arm(void *user, uint8_t channel, uint16_t ms)
{
    (void)user;
    (void)channel;
    dead_man = ms;
    if (ms == 0) {
        k_timer_stop(&watch);
    } else {
        k_timer_start(&watch, K_MSEC(ms), K_NO_WAIT);
    }
}

static void kick(void *user, uint8_t channel)
{
    (void)user;
    (void)channel;
    if (dead_man != 0) {
        k_timer_start(&watch, K_MSEC(dead_man), K_NO_WAIT);
    }
}

void gripper_fill(teds_port *port)
{
    port->channels = channels;
    port->channel_count = ARRAY_SIZE(channels);
    port->sample = sample;
    port->bears = bears;
    port->set = set;
    port->set_point = tell_set_point;
    port->safe = safe;
    port->arm = arm;
    port->kick = kick;
}
