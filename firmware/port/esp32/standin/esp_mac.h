/* SPDX-License-Identifier: Apache-2.0 */
/* A stand-in for ESP-IDF: what the port uses of it, so that it compiles and runs on this machine. Not ESP-IDF. */
#ifndef STANDIN_ESP_MAC_H
#define STANDIN_ESP_MAC_H

#include "esp_err.h"
#include <stdint.h>
#ifdef __cplusplus
extern "C" {
#endif
esp_err_t esp_efuse_mac_get_default(uint8_t *mac);
#ifdef __cplusplus
}
#endif

#endif
