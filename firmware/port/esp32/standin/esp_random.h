/* SPDX-License-Identifier: Apache-2.0 */
/* A stand-in for ESP-IDF: what the port uses of it, so that it compiles and runs on this machine. Not ESP-IDF. */
#ifndef STANDIN_ESP_RANDOM_H
#define STANDIN_ESP_RANDOM_H

#include <stddef.h>
#ifdef __cplusplus
extern "C" {
#endif
void esp_fill_random(void *out, size_t length);
#ifdef __cplusplus
}
#endif

#endif
