/* SPDX-License-Identifier: Apache-2.0 */
/* The thread that owns the node. Everything else wakes it: the CAN callback, a reader, a connection, an event. */
#include "teds_psa.h"
#include "teds_zephyr.h"

#include <string.h>
#include <zephyr/drivers/hwinfo.h>
#include <zephyr/kernel.h>

#ifdef CONFIG_TEST_RANDOM_GENERATOR
#error "CONFIG_TEST_RANDOM_GENERATOR: keys from a clock are no keys; the board needs an entropy driver"
#endif

/* P-256 by Mbed TLS wants 3 to 4 KiB beside the node's own (firmware/docs/figures.md). */
static K_THREAD_STACK_DEFINE(stack, CONFIG_TEDS_NODE_STACK);
static struct k_thread thread;
static K_SEM_DEFINE(woken, 0, 1);
static K_SEM_DEFINE(begun, 0, 1);
static int begin_failed;
static atomic_t by_hand = ATOMIC_INIT(0), pressed = ATOMIC_INIT(0);
static teds_node node;

#define SECOND 1000000000u
#define IDLE 1000000u /* ns: a key for the next Request is made where nothing is due before */
#define LONGEST 500   /* ms between two looks: advertising, connections to drop */
#define TAKEN 200     /* us between two looks while what is due waits for the controller: its plug may be out */

/* Seconds and the rest apart: cycles × 10^9 would be more than 64 bits after five minutes at 64 MHz. */
uint64_t teds_zephyr_now(void)
{
#ifdef CONFIG_TIMER_HAS_64BIT_CYCLE_COUNTER
    const uint64_t count = k_cycle_get_64(), rate = (uint64_t)sys_clock_hw_cycles_per_sec();
#else
    const uint64_t count = (uint64_t)k_uptime_ticks(), rate = CONFIG_SYS_CLOCK_TICKS_PER_SEC;
#endif
    return count / rate * SECOND + count % rate * SECOND / rate;
}

static uint64_t port_now(void *user)
{
    (void)user;
    return teds_zephyr_now();
}

void teds_zephyr_wake(void)
{
    k_sem_give(&woken);
}

void teds_zephyr_reset_by_hand(void)
{
    atomic_set(&by_hand, 1);
    teds_zephyr_wake();
}

void teds_zephyr_pressed(void)
{
    atomic_set(&pressed, 1);
    teds_zephyr_wake();
}

void teds_zephyr_event(uint8_t channel, uint64_t tick, const uint8_t *octets, bool valid)
{
    teds_sensor_event(&node, channel, tick, octets, valid);
    teds_zephyr_wake();
}

static bool bus_is_taken(void)
{
#ifdef CONFIG_TEDS_NODE_CAN
    return teds_zephyr_can_busy();
#else
    return false;
#endif
}

static void wait_until(uint64_t due)
{
    const uint64_t now = teds_zephyr_now();
    uint64_t ns = due <= now ? 0 : due - now;
    if (ns == 0) {
        if (bus_is_taken()) {
            (void)k_sem_take(&woken, K_USEC(TAKEN));
        }
        return;
    }
    ns = ns < (uint64_t)LONGEST * 1000000u ? ns : (uint64_t)LONGEST * 1000000u;
    (void)k_sem_take(&woken, K_USEC((ns + 999u) / 1000u));
}

static bool bus_work(void)
{
#ifdef CONFIG_TEDS_NODE_CAN
    return teds_zephyr_can_work(&node);
#else
    return false;
#endif
}

/* Of the chip's own number, so the same after every erase, which one drawn at random would not be. Of all of it: twelve
 * octets of an STM32 are place on the wafer, wafer and lot, and no ten of them tell chips of two lots apart.
 */
static int own_uuid(const teds_port *port, uint8_t out[10])
{
    uint8_t id[16], digest[32];
    teds_sha256 state;
    ssize_t length;
    bool zero = true;
    for (size_t i = 0; i < 10; i++) {
        zero = zero && out[i] == 0;
    }
    if (!zero) {
        return 0;
    }
    length = hwinfo_get_device_id(id, sizeof id);
    if (length < 8) { /* the chip has no number, or one that is no longer than a lot of boards: native_sim, too */
        return port->random(port->user, out, 10) == 0 ? 0 : TEDS_E_RANDOM; /* counts at the very first start only */
    }
    port->sha256_start(port->user, &state);
    port->sha256_update(port->user, &state, id, (size_t)length);
    port->sha256_finish(port->user, &state, digest);
    memcpy(out, digest, 10);
    return 0;
}

static int begin(const teds_zephyr_board *board)
{
    teds_port *port = board->port;
    int failed = teds_zephyr_flash(port);
    port->now = port_now;
#ifdef CONFIG_TIMER_HAS_64BIT_CYCLE_COUNTER
    port->step = (uint32_t)(SECOND / (uint32_t)sys_clock_hw_cycles_per_sec()) + 1u;
#else
    port->step = SECOND / CONFIG_SYS_CLOCK_TICKS_PER_SEC;
#endif
    port->drift = CONFIG_TEDS_NODE_DRIFT;
    teds_zephyr_firmware(port);
    if (failed == 0 && teds_psa_fill(port, true) != 0) {
        failed = TEDS_E_CRYPTO;
    }
    if (failed == 0) {
        failed = own_uuid(port, board->config->uuid);
    }
    if (failed == 0) {
        failed = teds_node_init(&node, board->config, port);
    }
#ifdef CONFIG_TEDS_NODE_CAN
    if (failed == 0) {
        failed = teds_zephyr_can_start();
    }
#endif
#ifdef CONFIG_TEDS_NODE_NFC_T4T
    if (failed == 0) {
        failed = teds_zephyr_nfc_start();
    }
#endif
#ifdef CONFIG_TEDS_NODE_BLE
    if (failed == 0) {
        failed = teds_zephyr_ble_start(board->config);
    }
#endif
    return failed;
}

static void run(void *board, void *two, void *three)
{
    (void)two;
    (void)three;
    begin_failed = begin(board);
#ifdef CONFIG_TEDS_MANAGE
    if (begin_failed != 0 && teds_zephyr_on_trial()) {
        teds_zephyr_restart(); /* which reverts it */
    }
#endif
    k_sem_give(&begun);
    while (begin_failed == 0) {
        bool moved = bus_work();
        uint64_t due;
#ifdef CONFIG_TEDS_NODE_NFC_T4T
        moved = teds_zephyr_nfc_work(&node) || moved;
#endif
#ifdef CONFIG_TEDS_NODE_BLE
        moved = teds_zephyr_ble_work(&node) || moved;
#endif
        if (atomic_cas(&by_hand, 1, 0)) {
            (void)teds_node_reset_by_hand(&node);
        }
        if (atomic_cas(&pressed, 1, 0)) {
            teds_can_pressed(&node, teds_zephyr_now());
        }
#ifdef CONFIG_TEDS_MANAGE
        teds_zephyr_feed();
#endif
        due = teds_node_poll(&node, teds_zephyr_now());
        moved = bus_work() || moved;
        if (moved || (due > teds_zephyr_now() + IDLE && teds_idle_work(&node))) {
            continue;
        }
        wait_until(due);
    }
}

/* The first start makes the identity key, which wants the stack of the node's thread and not that of the caller's. */
int teds_zephyr_start(const teds_zephyr_board *board)
{
    (void)k_thread_create(&thread, stack, K_THREAD_STACK_SIZEOF(stack), run, (void *)board, NULL, NULL,
                          CONFIG_TEDS_NODE_PRIORITY, 0, K_NO_WAIT);
    (void)k_sem_take(&begun, K_FOREVER);
    return begin_failed;
}
