/* SPDX-License-Identifier: Apache-2.0 */
#ifndef STANDIN_CAN_H
#define STANDIN_CAN_H

#include <zephyr/kernel.h>

#define CAN_MAX_DLEN 64U
#define CAN_MODE_FD BIT(2)
#define CAN_FRAME_IDE BIT(0)
#define CAN_FRAME_RTR BIT(1)
#define CAN_FRAME_FDF BIT(2)
#define CAN_FRAME_BRS BIT(3)
#define CAN_FILTER_IDE BIT(0)

typedef uint32_t can_mode_t;
enum can_state {
    CAN_STATE_ERROR_ACTIVE,
    CAN_STATE_ERROR_WARNING,
    CAN_STATE_ERROR_PASSIVE,
    CAN_STATE_BUS_OFF,
    CAN_STATE_STOPPED
};
struct can_bus_err_cnt {
    uint8_t tx_err_cnt, rx_err_cnt;
};
struct can_frame {
    uint32_t id;
    uint8_t dlc, flags;
    uint16_t reserved;
    uint8_t data[CAN_MAX_DLEN];
};
struct can_filter {
    uint32_t id, mask;
    uint8_t flags;
};
typedef void (*can_tx_callback_t)(const struct device *dev, int error, void *user_data);
typedef void (*can_rx_callback_t)(const struct device *dev, struct can_frame *frame, void *user_data);
typedef void (*can_state_change_callback_t)(const struct device *dev, enum can_state state,
                                            struct can_bus_err_cnt err_cnt, void *user_data);
int can_set_mode(const struct device *dev, can_mode_t mode);
int can_start(const struct device *dev);
int can_add_rx_filter(const struct device *dev, can_rx_callback_t callback, void *user_data,
                      const struct can_filter *filter);
void can_set_state_change_callback(const struct device *dev, can_state_change_callback_t callback, void *user_data);
int can_send(const struct device *dev, const struct can_frame *frame, k_timeout_t timeout, can_tx_callback_t callback,
             void *user_data);
uint8_t can_dlc_to_bytes(uint8_t dlc);
uint8_t can_bytes_to_dlc(uint8_t num_bytes);

#endif
