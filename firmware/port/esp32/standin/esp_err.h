/* SPDX-License-Identifier: Apache-2.0 */
/* A stand-in for ESP-IDF: what the port uses of it, so that it compiles and runs on this machine. Not ESP-IDF. */
#ifndef STANDIN_ESP_ERR_H
#define STANDIN_ESP_ERR_H

typedef int esp_err_t;
#define ESP_OK 0
#define ESP_FAIL (-1)
#define ESP_ERR_TIMEOUT 0x107

#endif
