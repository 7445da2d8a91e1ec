/* SPDX-License-Identifier: Apache-2.0 */
/* The controller of `chosen` zephyr,canbus: its callback fills a queue, the node's thread empties it.
 *
 * One frame is with the controller at a time. With several mailboxes some controllers send frames of one identifier in
 * another order than they were given, and a data message that is there can no longer be taken back.
 */
#include "teds_zephyr.h"

#include <string.h>
#include <zephyr/drivers/can.h>
#include <zephyr/kernel.h>

typedef struct arrived {
    uint64_t tick;
    teds_can_frame frame;
} arrived;

#define WAITING 24 /* frames: a request of 16 in a block, and what others ask meanwhile */

K_MSGQ_DEFINE(teds_arrivals, sizeof(arrived), WAITING, 8);
static K_SEM_DEFINE(controller, 1, 1);
static atomic_t off = ATOMIC_INIT(0), lost_bus = ATOMIC_INIT(0), back = ATOMIC_INIT(1), dropped = ATOMIC_INIT(0);
static const struct device *const bus = DEVICE_DT_GET(DT_CHOSEN(zephyr_canbus));

static void on_frame(const struct device *device, struct can_frame *frame, void *user)
{
    arrived one;
    const bool fd = (frame->flags & CAN_FRAME_FDF) != 0;
    const uint8_t length = !fd && frame->dlc > 8 ? 8 : can_dlc_to_bytes(frame->dlc); /* classic: 9 to 15 mean 8 too */
    (void)device;
    (void)user;
    if ((frame->flags & (CAN_FRAME_IDE | CAN_FRAME_RTR)) != CAN_FRAME_IDE || length > sizeof one.frame.data) {
        return;
    }
    one.tick = teds_zephyr_now();
    one.frame.identifier = frame->id;
    one.frame.length = length;
    one.frame.fd = fd;
    memcpy(one.frame.data, frame->data, length);
    if (k_msgq_put(&teds_arrivals, &one, K_NO_WAIT) != 0) {
        (void)atomic_inc(&dropped);
    }
    teds_zephyr_wake();
}

static void on_sent(const struct device *device, int error, void *user)
{
    (void)device;
    (void)error; /* a frame that did not leave is asked for again by the other side */
    (void)user;
    k_sem_give(&controller);
    teds_zephyr_wake();
}

static void on_state(const struct device *device, enum can_state state, struct can_bus_err_cnt count, void *user)
{
    (void)device;
    (void)count;
    (void)user;
    if (state == CAN_STATE_BUS_OFF) {
        atomic_set(&off, 1);
        atomic_set(&lost_bus, 1);
    } else if (state == CAN_STATE_ERROR_ACTIVE && atomic_cas(&off, 1, 0)) { /* from a warning, too, it comes back here */
        atomic_set(&back, 1);
    }
    teds_zephyr_wake();
}

uint32_t teds_zephyr_dropped(void)
{
    return (uint32_t)atomic_get(&dropped);
}

int teds_zephyr_can_start(void)
{
    /* All of them: which are the node's own depends on its address, which a station may change. */
    const struct can_filter all = {.id = 0, .mask = 0, .flags = CAN_FILTER_IDE};
    int failed;
    if (!device_is_ready(bus)) {
        return -ENODEV;
    }
#ifdef CONFIG_TEDS_NODE_CAN_FD
    failed = can_set_mode(bus, CAN_MODE_FD);
    if (failed != 0) {
        return failed;
    }
#endif
    can_set_state_change_callback(bus, on_state, NULL);
    failed = can_add_rx_filter(bus, on_frame, NULL, &all);
    return failed < 0 ? failed : can_start(bus);
}

bool teds_zephyr_can_busy(void)
{
    return k_sem_count_get(&controller) == 0;
}

static bool send_due(teds_node *node)
{
    bool moved = false;
    while (k_sem_take(&controller, K_NO_WAIT) == 0) {
        struct can_frame out;
        teds_can_frame frame;
        if (!teds_can_tx(node, &frame, teds_zephyr_now())) {
            k_sem_give(&controller);
            break;
        }
        memset(&out, 0, sizeof out);
        out.id = frame.identifier;
        out.dlc = can_bytes_to_dlc(frame.length);
        out.flags = CAN_FRAME_IDE;
        if (frame.fd) {
            out.flags |= CAN_FRAME_FDF | CAN_FRAME_BRS;
        }
        memcpy(out.data, frame.data, frame.length);
        if (can_send(bus, &out, K_NO_WAIT, on_sent, NULL) != 0) {
            k_sem_give(&controller); /* bus-off, or stopped: on_state tells the node */
            break;
        }
        moved = true;
    }
    return moved;
}

bool teds_zephyr_can_work(teds_node *node)
{
    arrived one;
    bool moved = false;
    if (atomic_cas(&lost_bus, 1, 0)) {
        teds_node_bus_off(node);
    }
    if (atomic_cas(&back, 1, 0)) {
        teds_can_start(node, teds_zephyr_now());
    }
    while (k_msgq_get(&teds_arrivals, &one, K_NO_WAIT) == 0) {
        teds_can_rx(node, &one.frame, one.tick);
        (void)send_due(node);
        moved = true;
    }
    return send_due(node) || moved;
}
