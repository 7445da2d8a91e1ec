/* SPDX-License-Identifier: Apache-2.0 */
/* Devices of the stand-in: flash in a file, CAN over the host port's bus, a bridge behind an HX711, a servo with two
 * voltages. One JSON line when the bus is up, one for each change of the servo.
 *
 *   TEDS_FLASH  file of the flash      TEDS_CAN  bus, as --can
 *   SIGUSR1     turns the reset pad, SIGUSR2 the button (teds-button)
 *   TEDS_CHIP   number of the chip     TEDS_RAW  what the HX711 converts: 24 bits, two's complement
 */
#define _GNU_SOURCE
#include "host.h"

#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <zephyr/drivers/adc.h>
#include <zephyr/drivers/can.h>
#include <zephyr/drivers/gpio.h>
#include <zephyr/drivers/hwinfo.h>
#include <zephyr/drivers/pwm.h>
#include <zephyr/storage/flash_map.h>

const struct device standin_can = {"can"}, standin_gpio = {"gpio"}, standin_pwm = {"pwm"}, standin_adc = {"adc"};

bool device_is_ready(const struct device *device)
{
    return device != NULL;
}

ssize_t hwinfo_get_device_id(uint8_t *buffer, size_t length)
{
    static uint8_t id[12] = {0x00, 0x39, 0x00, 0x1A, 0x32, 0x34, 0x51, 0x0C, 0x36, 0x33, 0x34, 0x37};
    const int chip = getenv("TEDS_CHIP") != NULL ? atoi(getenv("TEDS_CHIP")) : 0;
    id[11] = (uint8_t)chip;
    id[0] = (uint8_t)(chip >> 8); /* another lot */
    memcpy(buffer, id, length < sizeof id ? length : sizeof id);
    return (ssize_t)(length < sizeof id ? length : sizeof id);
}

/* -- flash ---------------------------------------------------------------------------------------------------------------- */

static const struct flash_area partitions[3] = {
    {0, 0, HOST_IDENTITY}, {1, HOST_IDENTITY, HOST_SLOT}, {2, HOST_IDENTITY + HOST_SLOT, HOST_SLOT}};
static host_flash flash;

int flash_area_open(uint8_t id, const struct flash_area **fa)
{
    static bool opened;
    if (!opened && (getenv("TEDS_FLASH") == NULL || host_flash_open(&flash, getenv("TEDS_FLASH")) != 0)) {
        return -ENODEV;
    }
    opened = true;
    *fa = &partitions[id];
    return 0;
}

int flash_area_erase(const struct flash_area *fa, off_t off, size_t len)
{
    return off == 0 && len == fa->fa_size ? host_flash_erase(&flash, fa->fa_id) : -EINVAL;
}

int flash_area_write(const struct flash_area *fa, off_t off, const void *src, size_t len)
{
    return host_flash_write(&flash, fa->fa_id, (uint32_t)off, src, len);
}

int flash_area_read(const struct flash_area *fa, off_t off, void *dst, size_t len)
{
    return host_flash_read(&flash, fa->fa_id, (uint32_t)off, dst, len);
}

uint32_t flash_area_align(const struct flash_area *fa)
{
    (void)fa;
    return HOST_UNIT;
}

uint8_t flash_area_erased_val(const struct flash_area *fa)
{
    (void)fa;
    return 0xFF;
}

/* -- CAN -------------------------------------------------------------------------------------------------------------------- */

static host_bus bus;
static can_rx_callback_t on_frame;
static bool fd;

uint8_t can_dlc_to_bytes(uint8_t dlc)
{
    static const uint8_t octets[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64};
    return octets[dlc & 15];
}

uint8_t can_bytes_to_dlc(uint8_t num_bytes)
{
    uint8_t dlc = 0;
    while (dlc < 15 && can_dlc_to_bytes(dlc) < num_bytes) {
        dlc++;
    }
    return dlc;
}

int can_set_mode(const struct device *dev, can_mode_t mode)
{
    (void)dev;
    fd = (mode & CAN_MODE_FD) != 0;
    return 0;
}

void can_set_state_change_callback(const struct device *dev, can_state_change_callback_t callback, void *user_data)
{
    (void)dev;
    (void)callback; /* this bus never goes off */
    (void)user_data;
}

int can_add_rx_filter(const struct device *dev, can_rx_callback_t callback, void *user_data,
                      const struct can_filter *filter)
{
    (void)dev;
    (void)user_data;
    on_frame = callback;
    return filter->flags == CAN_FILTER_IDE && filter->mask == 0 ? 0 : -ENOTSUP;
}

static void *hear(void *none)
{
    (void)none;
    for (;;) {
        teds_can_frame came;
        struct can_frame frame;
        const int got = host_bus_receive(&bus, &came);
        if (got < 0) {
            exit(5);
        }
        if (got == 0) {
            (void)k_msleep(1);
            continue;
        }
        memset(&frame, 0, sizeof frame);
        frame.id = came.identifier;
        frame.dlc = can_bytes_to_dlc(came.length);
        frame.flags = (uint8_t)(CAN_FRAME_IDE | (came.fd ? CAN_FRAME_FDF : 0));
        memcpy(frame.data, came.data, came.length);
        on_frame(&standin_can, &frame, NULL);
    }
    return NULL;
}

int can_start(const struct device *dev)
{
    pthread_t thread;
    (void)dev;
    if (getenv("TEDS_CAN") == NULL || host_bus_open(&bus, getenv("TEDS_CAN"), fd, NULL, false) != 0 ||
        pthread_create(&thread, NULL, hear, NULL) != 0) {
        return -ENETDOWN;
    }
    (void)printf("{\"links\": [\"can\"], \"ready\": true}\n");
    (void)fflush(stdout);
    return 0;
}

int can_send(const struct device *dev, const struct can_frame *frame, k_timeout_t timeout, can_tx_callback_t callback,
             void *user_data)
{
    teds_can_frame out;
    (void)timeout;
    if (getenv("TEDS_CAN_DEAF") != NULL) { /* nobody acknowledges: the controller sends it again and again */
        return 0;
    }
    memset(&out, 0, sizeof out);
    out.identifier = frame->id;
    out.length = can_dlc_to_bytes(frame->dlc);
    out.fd = (frame->flags & CAN_FRAME_FDF) != 0;
    memcpy(out.data, frame->data, out.length);
    if (host_bus_send(&bus, &out) != 0) {
        return -ENETDOWN;
    }
    callback(dev, 0, user_data);
    return 0;
}

/* -- an HX711: data falls when a conversion is there, a bit for each pulse, the 25th ends it ---------------------------------- */

static unsigned pulses;
static bool clock_high;
static uint64_t converted_at;

static uint32_t raw(void)
{
    const char *text = getenv("TEDS_RAW");
    return text != NULL ? (uint32_t)strtoul(text, NULL, 0) : 0x123456u;
}

static int hx711_data(void)
{
    if (pulses == 0) {
        return k_cycle_get_64() < converted_at;
    }
    return pulses <= 24 ? (int)(raw() >> (24 - pulses) & 1u) : 1;
}

static void hx711_clock(bool high)
{
    pulses += high && !clock_high;
    clock_high = high;
    if (pulses == 25 && !high) {
        pulses = 0;
        converted_at = k_cycle_get_64() + 12500000u;
    }
}

/* -- a servo: it moves to its pulse while it has power, and closes on something at half of its way ---------------------------- */

static uint32_t pulse, at;
static bool powered;

static void tell(void)
{
    (void)printf("{\"servo\": \"%s\", \"pulse\": %u}\n", powered ? "on" : "off", (unsigned)pulse);
    (void)fflush(stdout);
}

bool gpio_is_ready_dt(const struct gpio_dt_spec *spec)
{
    return spec->port == &standin_gpio;
}

/* The reset pad: TEDS_PAD=1 holds it from the start, SIGUSR1 presses it or lets it go. */
static volatile sig_atomic_t pad;

static void turn_pad(int signal)
{
    (void)signal;
    pad = !pad;
}

/* The button: SIGUSR2 presses it or lets it go. */
static volatile sig_atomic_t button;
static struct gpio_callback *on_button;

static void turn_button(int signal)
{
    (void)signal;
    button = !button;
    on_button->handler(&standin_gpio, on_button, 1);
}

int gpio_pin_configure_dt(const struct gpio_dt_spec *spec, gpio_flags_t extra_flags)
{
    (void)extra_flags;
    if (spec->pin == STANDIN_zephyr_user_reset_gpios) {
        pad = getenv("TEDS_PAD") != NULL;
        (void)signal(SIGUSR1, turn_pad);
    }
    return 0;
}

int gpio_pin_get_dt(const struct gpio_dt_spec *spec)
{
    switch (spec->pin) {
    case STANDIN_zephyr_user_hx711_data_gpios: return hx711_data();
    case STANDIN_zephyr_user_reset_gpios: return (int)pad;
    case STANDIN_teds_button_gpios: return (int)button;
    default: return 0;
    }
}

void gpio_init_callback(struct gpio_callback *callback, gpio_callback_handler_t handler, gpio_port_pins_t pin_mask)
{
    (void)pin_mask;
    callback->handler = handler;
}

int gpio_add_callback_dt(const struct gpio_dt_spec *spec, struct gpio_callback *callback)
{
    (void)spec;
    on_button = callback;
    return 0;
}

int gpio_pin_interrupt_configure_dt(const struct gpio_dt_spec *spec, gpio_flags_t flags)
{
    (void)spec;
    (void)flags;
    (void)signal(SIGUSR2, turn_button);
    return 0;
}

/* The LED: a line when it goes on or off for Locate, none for each blink. */
int gpio_pin_toggle_dt(const struct gpio_dt_spec *spec)
{
    (void)spec;
    return 0;
}

int gpio_pin_set_dt(const struct gpio_dt_spec *spec, int value)
{
    if (spec->pin == STANDIN_zephyr_user_hx711_clock_gpios) {
        hx711_clock(value != 0);
    } else if (spec->pin == STANDIN_zephyr_user_supply_gpios && powered != (value != 0)) {
        powered = value != 0;
        tell();
    } else if (spec->pin == STANDIN_teds_led_gpios) {
        (void)printf("{\"led\": %s}\n", value != 0 ? "true" : "false");
        (void)fflush(stdout);
    }
    return 0;
}

bool pwm_is_ready_dt(const struct pwm_dt_spec *spec)
{
    return spec->dev == &standin_pwm;
}

int pwm_set_pulse_dt(const struct pwm_dt_spec *spec, uint32_t given)
{
    (void)spec;
    if (pulse != given) {
        pulse = given;
        if (powered) {
            tell();
        }
    }
    return 0;
}

bool adc_is_ready_dt(const struct adc_dt_spec *spec)
{
    return spec->dev == &standin_adc;
}

int adc_channel_setup_dt(const struct adc_dt_spec *spec)
{
    (void)spec;
    return 0;
}

int adc_sequence_init_dt(const struct adc_dt_spec *spec, struct adc_sequence *seq)
{
    seq->channels = 1u << spec->channel_id;
    return 0;
}

int adc_read_dt(const struct adc_dt_spec *spec, const struct adc_sequence *sequence)
{
    uint16_t value;
    at = powered && pulse >= 1000000u ? (uint32_t)((uint64_t)(pulse - 1000000u) * 4095u / 1000000u) : at;
    value = (uint16_t)(spec->channel_id == 0 ? at : at < 2048 ? 2048 - at : 0);
    memcpy(sequence->buffer, &value, sizeof value);
    return 0;
}
