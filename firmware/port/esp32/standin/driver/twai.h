/* SPDX-License-Identifier: Apache-2.0 */
/* A stand-in for ESP-IDF: what the port uses of it, so that it compiles and runs on this machine. Not ESP-IDF. */
#ifndef STANDIN_DRIVER_TWAI_H
#define STANDIN_DRIVER_TWAI_H

#include "esp_err.h"
#include <stdint.h>
#ifdef __cplusplus
extern "C" {
#endif
typedef int gpio_num_t;
typedef uint32_t TickType_t;
typedef enum { TWAI_MODE_NORMAL, TWAI_MODE_NO_ACK, TWAI_MODE_LISTEN_ONLY } twai_mode_t;
typedef enum { TWAI_STATE_STOPPED, TWAI_STATE_RUNNING, TWAI_STATE_BUS_OFF, TWAI_STATE_RECOVERING } twai_state_t;
typedef struct {
    uint32_t bitrate;
} twai_timing_config_t;
typedef struct {
    uint32_t acceptance_code, acceptance_mask;
} twai_filter_config_t;
typedef struct {
    twai_mode_t mode;
    gpio_num_t tx_io, rx_io;
    uint32_t tx_queue_len, rx_queue_len;
} twai_general_config_t;
typedef struct {
    twai_state_t state;
    uint32_t msgs_to_tx, msgs_to_rx;
} twai_status_info_t;
typedef struct {
    uint32_t extd : 1, rtr : 1;
    uint32_t identifier;
    uint8_t data_length_code;
    uint8_t data[8];
} twai_message_t;
#define TWAI_GENERAL_CONFIG_DEFAULT(tx, rx, op) {op, tx, rx, 5, 5}
#define TWAI_TIMING_CONFIG_125KBITS() {125000}
#define TWAI_TIMING_CONFIG_250KBITS() {250000}
#define TWAI_TIMING_CONFIG_500KBITS() {500000}
#define TWAI_TIMING_CONFIG_1MBITS() {1000000}
#define TWAI_FILTER_CONFIG_ACCEPT_ALL() {0, 0xFFFFFFFFu}
esp_err_t twai_driver_install(const twai_general_config_t *general, const twai_timing_config_t *timing,
                              const twai_filter_config_t *filter);
esp_err_t twai_start(void);
esp_err_t twai_receive(twai_message_t *message, TickType_t ticks);
esp_err_t twai_transmit(const twai_message_t *message, TickType_t ticks);
esp_err_t twai_get_status_info(twai_status_info_t *status);
esp_err_t twai_initiate_recovery(void);
#ifdef __cplusplus
}
#endif

#endif
