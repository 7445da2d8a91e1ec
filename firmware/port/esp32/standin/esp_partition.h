/* SPDX-License-Identifier: Apache-2.0 */
/* A stand-in for ESP-IDF: what the port uses of it, so that it compiles and runs on this machine. Not ESP-IDF. */
#ifndef STANDIN_ESP_PARTITION_H
#define STANDIN_ESP_PARTITION_H

#include "esp_err.h"
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#ifdef __cplusplus
extern "C" {
#endif
typedef enum { ESP_PARTITION_TYPE_APP = 0x00, ESP_PARTITION_TYPE_DATA = 0x01 } esp_partition_type_t;
typedef enum { ESP_PARTITION_SUBTYPE_ANY = 0xFF } esp_partition_subtype_t;
typedef struct {
    uint32_t address, size;
    char label[17];
    bool encrypted;
} esp_partition_t;
const esp_partition_t *esp_partition_find_first(esp_partition_type_t type, esp_partition_subtype_t subtype,
                                                const char *label);
esp_err_t esp_partition_read(const esp_partition_t *partition, size_t at, void *out, size_t length);
esp_err_t esp_partition_write(const esp_partition_t *partition, size_t at, const void *octets, size_t length);
esp_err_t esp_partition_erase_range(const esp_partition_t *partition, size_t at, size_t length);
#ifdef __cplusplus
}
#endif

#endif
