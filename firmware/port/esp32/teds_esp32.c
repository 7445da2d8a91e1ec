/* SPDX-License-Identifier: Apache-2.0 */
/* TWAI (the driver of ESP-IDF 5, driver/twai.h), partitions, random generator and clock of an ESP32. */
#ifdef ESP_PLATFORM
#include "teds_esp32.h"

#include "teds_bearssl.h"

#include <bootloader_random.h>
#include <driver/twai.h>
#include <esp_mac.h>
#include <esp_partition.h>
#include <esp_random.h>
#include <esp_timer.h>
#include <string.h>

#define NO_PARTITION (-100)
#define NO_CONTROLLER (-101)
#define RING 32   /* frames that may wait for the loop */
#define SECTOR 4096u

static struct {
    teds_bearssl crypto; /* first: teds_bearssl_fill verifies it */
    const esp_partition_t *areas[3];
    bool radio, off;
} own;
static teds_node node;

/* -- flash ------------------------------------------------------------------------------------------------------------- */

static int erase(void *user, int area)
{
    (void)user;
    return esp_partition_erase_range(own.areas[area], 0, own.areas[area]->size) == ESP_OK ? 0 : -1;
}

static int write_flash(void *user, int area, uint32_t at, const uint8_t *octets, size_t length)
{
    (void)user;
    return esp_partition_write(own.areas[area], at, octets, length) == ESP_OK ? 0 : -1;
}

static int read_flash(void *user, int area, uint32_t at, uint8_t *out, size_t length)
{
    (void)user;
    return esp_partition_read(own.areas[area], at, out, length) == ESP_OK ? 0 : -1;
}

static int find_areas(teds_port *port)
{
    static const char *const labels[3] = {"teds_identity", "teds_slot_a", "teds_slot_b"};
    port->unit = 4;
    for (int i = 0; i < 3; i++) {
        own.areas[i] = esp_partition_find_first(ESP_PARTITION_TYPE_DATA, ESP_PARTITION_SUBTYPE_ANY, labels[i]);
        if (own.areas[i] == NULL || own.areas[i]->size % SECTOR != 0) {
            return NO_PARTITION;
        }
        if (own.areas[i]->encrypted) {
            port->unit = 16;
        }
    }
    port->identity_octets = own.areas[0]->size;
    port->slot_octets = own.areas[1]->size < own.areas[2]->size ? own.areas[1]->size : own.areas[2]->size;
    port->erased = 0xFF;
    port->erase = erase;
    port->write = write_flash;
    port->read = read_flash;
    return port->slot_octets < TEDS_STAGING + 256u ? NO_PARTITION : 0;
}

/* -- randomness, clock, UUID ------------------------------------------------------------------------------------------- */

/* Without radio and without this source the generator gives pseudo-random numbers (ESP-IDF, "Random Number Generation"). */
static int draw(void *user, uint8_t *out, size_t length)
{
    (void)user;
    if (!own.radio) {
        bootloader_random_enable();
    }
    esp_fill_random(out, length);
    if (!own.radio) {
        bootloader_random_disable();
    }
    return 0;
}

uint64_t teds_esp32_now(void)
{
    return (uint64_t)esp_timer_get_time() * 1000u;
}

static uint64_t now(void *user)
{
    (void)user;
    return teds_esp32_now();
}

static int own_uuid(const teds_port *port, uint8_t out[10])
{
    static const uint8_t none[10] = {0};
    uint8_t address[8] = {0}, digest[32];
    teds_sha256 state;
    if (memcmp(out, none, 10) != 0) {
        return 0;
    }
    if (esp_efuse_mac_get_default(address) != ESP_OK) {
        return TEDS_E_USAGE;
    }
    port->sha256_start(port->user, &state);
    port->sha256_update(port->user, &state, address, 6);
    port->sha256_finish(port->user, &state, digest);
    memcpy(out, digest, 10);
    return 0;
}

/* -- CAN --------------------------------------------------------------------------------------------------------------- */

static int open_controller(const teds_esp32_board *board)
{
    static const struct {
        uint32_t bitrate;
        twai_timing_config_t timing;
    } rates[] = {{125000, TWAI_TIMING_CONFIG_125KBITS()},
                 {250000, TWAI_TIMING_CONFIG_250KBITS()},
                 {500000, TWAI_TIMING_CONFIG_500KBITS()},
                 {1000000, TWAI_TIMING_CONFIG_1MBITS()}};
    const twai_filter_config_t all = TWAI_FILTER_CONFIG_ACCEPT_ALL();
    twai_general_config_t general =
        TWAI_GENERAL_CONFIG_DEFAULT((gpio_num_t)board->tx, (gpio_num_t)board->rx, TWAI_MODE_NORMAL);
    general.rx_queue_len = RING;
    general.tx_queue_len = 1; /* what is still in the node can be taken back */
    for (size_t i = 0; i < sizeof rates / sizeof rates[0]; i++) {
        if (rates[i].bitrate == board->bitrate) {
            return twai_driver_install(&general, &rates[i].timing, &all) == ESP_OK && twai_start() == ESP_OK ? 0 : NO_CONTROLLER;
        }
    }
    return TEDS_E_USAGE;
}

/* After bus-off the driver recovers, is then stopped, and is started again. */
static void look_after_the_bus(const twai_status_info_t *status)
{
    if (status->state == TWAI_STATE_BUS_OFF && !own.off) {
        own.off = true;
        teds_node_bus_off(&node);
        (void)twai_initiate_recovery();
    } else if (status->state == TWAI_STATE_STOPPED && own.off && twai_start() == ESP_OK) {
        own.off = false;
        teds_can_start(&node, teds_esp32_now());
    }
}

static bool receive(void)
{
    twai_message_t came;
    bool any = false;
    while (twai_receive(&came, 0) == ESP_OK) {
        teds_can_frame frame = {0};
        if (!came.extd || came.rtr || came.data_length_code > 8) {
            continue;
        }
        frame.identifier = came.identifier;
        frame.length = came.data_length_code;
        memcpy(frame.data, came.data, frame.length);
        teds_can_rx(&node, &frame, teds_esp32_now()); /* the driver takes no time of its own */
        any = true;
    }
    return any;
}

static bool send_due(void)
{
    twai_status_info_t status;
    bool any = false;
    for (;;) {
        teds_can_frame frame;
        twai_message_t leaves = {0};
        if (twai_get_status_info(&status) != ESP_OK) {
            return any;
        }
        look_after_the_bus(&status);
        if (status.state != TWAI_STATE_RUNNING || status.msgs_to_tx != 0 || !teds_can_tx(&node, &frame, teds_esp32_now())) {
            return any;
        }
        leaves.extd = 1;
        leaves.identifier = frame.identifier;
        leaves.data_length_code = frame.length;
        memcpy(leaves.data, frame.data, frame.length);
        if (twai_transmit(&leaves, 0) != ESP_OK) {
            return any;
        }
        any = true;
    }
}

/* -- start and loop ---------------------------------------------------------------------------------------------------- */

int teds_esp32_start(const teds_esp32_board *board)
{
    teds_port *port = board->port;
    int failed;
    own.radio = board->radio;
    own.crypto.random = draw;
    port->user = &own;
    port->random = draw;
    port->now = now;
    port->step = 1000;
    port->drift = 50;
    failed = find_areas(port);
    if (failed == 0 && teds_bearssl_fill(port, &own.crypto) != 0) {
        failed = TEDS_E_USAGE;
    }
    if (failed == 0) {
        failed = own_uuid(port, board->config->uuid);
    }
    if (failed == 0) {
        failed = teds_node_init(&node, board->config, port);
    }
    if (failed == 0) {
        failed = open_controller(board);
    }
    if (failed == 0) {
        teds_can_start(&node, teds_esp32_now());
    }
    return failed;
}

void teds_esp32_work(void)
{
    bool any = receive();
    (void)teds_node_poll(&node, teds_esp32_now());
    any = send_due() || any;
    if (!any) {
        (void)teds_idle_work(&node);
    }
}

teds_node *teds_esp32_node(void)
{
    return &node;
}
#else
typedef int teds_esp32_is_empty_elsewhere; /* C99 wants a declaration in each file */
#endif
