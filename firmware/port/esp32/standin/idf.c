/* SPDX-License-Identifier: Apache-2.0 */
/* The stand-in for ESP-IDF on this machine: partitions are a file (TEDS_FLASH), TWAI is a bus of python-can (TEDS_CAN). After
 * SIGUSR2 the controller is off the bus, as after many errors.
 */
#define _DEFAULT_SOURCE
#include "bootloader_random.h"
#include "driver/twai.h"
#include "esp_mac.h"
#include "esp_partition.h"
#include "esp_random.h"
#include "esp_timer.h"
#include "host.h"

#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#define FLASH 0x5000

static const esp_partition_t table[] = {
    {0, 0x1000, "teds_identity", false}, {0x1000, 0x2000, "teds_slot_a", false}, {0x3000, 0x2000, "teds_slot_b", false}};
static host_bus bus;
static host_pace pace;
static twai_state_t state = TWAI_STATE_STOPPED;
static volatile sig_atomic_t errors;
static bool entropy;

static int flash_file(void)
{
    static int file = -1;
    if (file < 0) {
        struct stat facts;
        file = open(getenv("TEDS_FLASH"), O_RDWR | O_CREAT, 0600);
        if (file < 0 || fstat(file, &facts) != 0) {
            perror("TEDS_FLASH");
            exit(2);
        }
        for (off_t at = facts.st_size; at < FLASH; at++) {
            (void)!pwrite(file, "\xff", 1, at);
        }
    }
    return file;
}

const esp_partition_t *esp_partition_find_first(esp_partition_type_t type, esp_partition_subtype_t subtype,
                                                const char *label)
{
    (void)type;
    (void)subtype;
    for (size_t i = 0; i < sizeof table / sizeof table[0]; i++) {
        if (strcmp(table[i].label, label) == 0) {
            return &table[i];
        }
    }
    return NULL;
}

esp_err_t esp_partition_read(const esp_partition_t *partition, size_t at, void *out, size_t length)
{
    return pread(flash_file(), out, length, (off_t)(partition->address + at)) == (ssize_t)length ? ESP_OK : ESP_FAIL;
}

/* As NOR flash: bits go from 1 to 0 alone. */
esp_err_t esp_partition_write(const esp_partition_t *partition, size_t at, const void *octets, size_t length)
{
    uint8_t there[64];
    const uint8_t *from = octets;
    for (size_t done = 0; done < length; done += sizeof there) {
        const size_t now = length - done < sizeof there ? length - done : sizeof there;
        if (at % 4 != 0 || now % 4 != 0 || esp_partition_read(partition, at + done, there, now) != ESP_OK) {
            return ESP_FAIL;
        }
        for (size_t i = 0; i < now; i++) {
            there[i] &= from[done + i];
        }
        if (pwrite(flash_file(), there, now, (off_t)(partition->address + at + done)) != (ssize_t)now) {
            return ESP_FAIL;
        }
    }
    return ESP_OK;
}

esp_err_t esp_partition_erase_range(const esp_partition_t *partition, size_t at, size_t length)
{
    for (size_t done = 0; done < length; done++) {
        if (pwrite(flash_file(), "\xff", 1, (off_t)(partition->address + at + done)) != 1) {
            return ESP_FAIL;
        }
    }
    return at % 4096 == 0 && length % 4096 == 0 ? ESP_OK : ESP_FAIL;
}

void bootloader_random_enable(void)
{
    entropy = true;
}

void bootloader_random_disable(void)
{
    entropy = false;
}

/* Without a source of entropy the chip gives pseudo-random numbers: here that ends the program. */
void esp_fill_random(void *out, size_t length)
{
    if (!entropy || getrandom(out, length, 0) != (ssize_t)length) {
        abort();
    }
}

int64_t esp_timer_get_time(void)
{
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000 + now.tv_nsec / 1000;
}

esp_err_t esp_efuse_mac_get_default(uint8_t *mac)
{
    memcpy(mac, "\x24\x0a\xc4\x01\x02\x03", 6);
    return ESP_OK;
}

static void on_errors(int number)
{
    (void)number;
    errors = 1;
}

esp_err_t twai_driver_install(const twai_general_config_t *general, const twai_timing_config_t *timing,
                              const twai_filter_config_t *filter)
{
    (void)filter;
    (void)signal(SIGUSR2, on_errors);
    return general->tx_queue_len == 1 && timing->bitrate == 500000 &&
                   host_bus_open(&bus, getenv("TEDS_CAN"), false, &pace, false) == 0
               ? ESP_OK
               : ESP_FAIL;
}

esp_err_t twai_start(void)
{
    if (state != TWAI_STATE_STOPPED) {
        return ESP_FAIL;
    }
    state = TWAI_STATE_RUNNING;
    return ESP_OK;
}

esp_err_t twai_initiate_recovery(void)
{
    if (state != TWAI_STATE_BUS_OFF) {
        return ESP_FAIL;
    }
    state = TWAI_STATE_STOPPED; /* at once: the bus is quiet */
    return ESP_OK;
}

esp_err_t twai_get_status_info(twai_status_info_t *status)
{
    if (errors) {
        errors = 0;
        state = TWAI_STATE_BUS_OFF;
    }
    memset(status, 0, sizeof *status);
    status->state = state;
    return ESP_OK;
}

esp_err_t twai_receive(twai_message_t *message, TickType_t ticks)
{
    teds_can_frame frame;
    (void)ticks;
    if (host_bus_receive(&bus, &frame) != 1 || state != TWAI_STATE_RUNNING) {
        return ESP_ERR_TIMEOUT;
    }
    memset(message, 0, sizeof *message);
    message->extd = 1;
    message->identifier = frame.identifier;
    message->data_length_code = frame.length;
    memcpy(message->data, frame.data, frame.length);
    return ESP_OK;
}

esp_err_t twai_transmit(const twai_message_t *message, TickType_t ticks)
{
    teds_can_frame frame;
    (void)ticks;
    memset(&frame, 0, sizeof frame);
    frame.identifier = message->identifier;
    frame.length = message->data_length_code;
    memcpy(frame.data, message->data, frame.length);
    return state == TWAI_STATE_RUNNING && host_bus_send(&bus, &frame) == 0 ? ESP_OK : ESP_FAIL;
}
