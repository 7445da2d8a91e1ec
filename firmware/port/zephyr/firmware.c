/* SPDX-License-Identifier: Apache-2.0 */
/* What runs on this board, an LED and a button that show which board it is, and updates by mcumgr's handlers over MCUboot.
 *
 * Devicetree: alias teds-led (a node with `gpios`) blinks for Locate; alias teds-button announces the board when it is
 * released after 50 ms to 2 s. Both may be absent.
 */
#include "teds_zephyr.h"

#include <string.h>
#include <zephyr/drivers/gpio.h>
#include <zephyr/kernel.h>
#include <zephyr/storage/flash_map.h>
#ifdef CONFIG_TEDS_MANAGE
#include <zephyr/dfu/mcuboot.h>
#include <zephyr/drivers/watchdog.h>
#include <zephyr/init.h>
#include <zephyr/mgmt/mcumgr/mgmt/mgmt.h>
#include <zephyr/mgmt/mcumgr/smp/smp.h>
#include <zephyr/mgmt/mcumgr/transport/smp.h>
#include <zephyr/sys/reboot.h>
#endif

/* -- which board ------------------------------------------------------------------------------------------------------- */

#define BLINK 250 /* ms */
#define SHORTEST UINT64_C(50000000) /* ns that a press lasts */
#define LONGEST UINT64_C(2000000000)

#if DT_NODE_EXISTS(DT_ALIAS(teds_led)) && defined(CONFIG_GPIO)
static const struct gpio_dt_spec led = GPIO_DT_SPEC_GET(DT_ALIAS(teds_led), gpios);

static void blink(struct k_timer *timer)
{
    (void)timer;
    (void)gpio_pin_toggle_dt(&led);
}

static K_TIMER_DEFINE(blinking, blink, NULL);

static void port_locate(void *user, uint8_t seconds)
{
    (void)user;
    (void)gpio_pin_set_dt(&led, seconds > 0);
    if (seconds > 0) {
        k_timer_start(&blinking, K_MSEC(BLINK), K_MSEC(BLINK));
    } else {
        k_timer_stop(&blinking);
    }
}

static void start_led(teds_port *port)
{
    if (gpio_is_ready_dt(&led) && gpio_pin_configure_dt(&led, GPIO_OUTPUT_INACTIVE) == 0) {
        port->locate = port_locate;
    }
}
#else
static void start_led(teds_port *port)
{
    (void)port;
}
#endif

#if DT_NODE_EXISTS(DT_ALIAS(teds_button)) && defined(CONFIG_GPIO)
static const struct gpio_dt_spec button = GPIO_DT_SPEC_GET(DT_ALIAS(teds_button), gpios);
static struct gpio_callback on_button;
static uint64_t down_at; /* of the interrupt alone; 0: it is up */

static void turned(const struct device *device, struct gpio_callback *callback, gpio_port_pins_t pins)
{
    const uint64_t now = teds_zephyr_now();
    (void)device;
    (void)callback;
    (void)pins;
    if (gpio_pin_get_dt(&button) == 1) {
        down_at = down_at == 0 ? now : down_at;
        return;
    }
    if (down_at != 0 && now - down_at >= SHORTEST && now - down_at <= LONGEST) {
        teds_zephyr_pressed();
    }
    down_at = 0;
}

static void start_button(void)
{
    if (gpio_is_ready_dt(&button) && gpio_pin_configure_dt(&button, GPIO_INPUT) == 0) {
        gpio_init_callback(&on_button, turned, BIT(button.pin));
        (void)gpio_add_callback_dt(&button, &on_button);
        (void)gpio_pin_interrupt_configure_dt(&button, GPIO_INT_EDGE_BOTH);
    }
}
#else
static void start_button(void)
{
}
#endif

/* -- what runs: header and TLVs of the image in the slot that runs (MCUboot; a swap brings it into slot 0) -------------- */

#ifdef CONFIG_BOOTLOADER_MCUBOOT
#ifndef PARTITION_ID /* before Zephyr 4.4 */
#define PARTITION_ID FIXED_PARTITION_ID
#endif
#define MAGIC 0x96F3B83Du
#define TLV_MAGIC 0x6907u
enum { TLV_SHA256 = 0x10, TLV_SHA384 = 0x11, TLV_SHA512 = 0x12 };

static uint16_t get16(const uint8_t *at)
{
    return (uint16_t)(at[0] | at[1] << 8);
}

static uint32_t get32(const uint8_t *at)
{
    return (uint32_t)get16(at + 2) << 16 | get16(at);
}

static void digest_of(const struct flash_area *area, uint32_t at, uint8_t out[32])
{
    uint8_t head[4];
    uint32_t end;
    if (flash_area_read(area, (off_t)at, head, 4) != 0 || get16(head) != TLV_MAGIC) {
        return;
    }
    end = at + get16(head + 2);
    for (at += 4; at + 4 <= end && flash_area_read(area, (off_t)at, head, 4) == 0; at += 4u + get16(head + 2)) {
        if (get16(head) >= TLV_SHA256 && get16(head) <= TLV_SHA512 && get16(head + 2) >= 32) {
            (void)flash_area_read(area, (off_t)at + 4, out, 32);
            return;
        }
    }
}

static void read_image(teds_firmware *out)
{
    const struct flash_area *area;
    uint8_t head[32];
    if (flash_area_open(PARTITION_ID(slot0_partition), &area) != 0) {
        return;
    }
    if (flash_area_read(area, 0, head, sizeof head) == 0 && get32(head) == MAGIC) {
        out->major = head[20];
        out->minor = head[21];
        out->patch = get16(head + 22);
        out->build = get32(head + 24);
        digest_of(area, (uint32_t)get16(head + 8) + get32(head + 12) + get16(head + 10), out->image);
    }
    flash_area_close(area);
}
#else
static void read_image(teds_firmware *out)
{
    (void)out;
}
#endif

#define TEXT CONFIG_BOARD_TARGET "/" CONFIG_TEDS_NODE_APPLICATION
BUILD_ASSERT(sizeof TEXT - 1 <= 48, "board and application (CONFIG_TEDS_NODE_APPLICATION) have more than 48 characters");

static void port_about(void *user, teds_firmware *out)
{
    (void)user;
    read_image(out);
    out->text = TEXT;
#ifdef CONFIG_TEDS_MANAGE
    out->flags = TEDS_FIRMWARE_SIGNED;
#ifdef CONFIG_TEDS_MANAGE_SECURITY_COUNTER
    out->flags |= TEDS_FIRMWARE_COUNTER;
#endif
    switch (mcuboot_swap_type()) {
    case BOOT_SWAP_TYPE_REVERT: out->flags |= TEDS_FIRMWARE_ON_TRIAL; break;
    case BOOT_SWAP_TYPE_TEST:
    case BOOT_SWAP_TYPE_PERM: out->flags |= TEDS_FIRMWARE_PENDING; break;
    default: break;
    }
#endif
}

/* -- updates --------------------------------------------------------------------------------------------------------------- */

#ifdef CONFIG_TEDS_MANAGE

/* One way in, which asks who it is. */
#if defined(CONFIG_MCUMGR_TRANSPORT_BT) || defined(CONFIG_MCUMGR_TRANSPORT_UART) || defined(CONFIG_MCUMGR_TRANSPORT_UDP) || \
    defined(CONFIG_MCUMGR_TRANSPORT_SHELL) || defined(CONFIG_MCUMGR_TRANSPORT_LORAWAN) || \
    defined(CONFIG_MCUMGR_TRANSPORT_DUMMY)
#error "CONFIG_TEDS_MANAGE: another transport of mcumgr would take updates from anybody; turn CONFIG_MCUMGR_TRANSPORT_... off"
#endif
#if defined(CONFIG_MCUMGR_GRP_FS) || defined(CONFIG_MCUMGR_GRP_SETTINGS) || defined(CONFIG_MCUMGR_GRP_STAT) || \
    defined(CONFIG_MCUMGR_GRP_SHELL) || defined(CONFIG_MCUMGR_GRP_ZBASIC) || defined(CONFIG_MCUMGR_GRP_ENUM)
#error "CONFIG_TEDS_MANAGE: only the groups OS and IMG of mcumgr may be built"
#endif
#if defined(CONFIG_MCUMGR_GRP_OS_RESET_BOOT_MODE) || defined(CONFIG_MCUMGR_GRP_IMG_DIRECT_UPLOAD) || \
    defined(CONFIG_MCUMGR_GRP_IMG_ALLOW_CONFIRM_NON_ACTIVE_IMAGE_SECONDARY) || \
    defined(CONFIG_MCUMGR_GRP_IMG_ALLOW_CONFIRM_NON_ACTIVE_IMAGE_ANY)
#error "CONFIG_TEDS_MANAGE: turn RESET_BOOT_MODE, DIRECT_UPLOAD and ALLOW_CONFIRM_NON_ACTIVE_IMAGE_... of mcumgr off"
#endif
/* Else an image may reach into the trailer of its slot, and the boot loader cannot swap it. */
#if !defined(CONFIG_MCUMGR_GRP_IMG_TOO_LARGE_SYSBUILD) && !defined(CONFIG_MCUMGR_GRP_IMG_TOO_LARGE_BOOTLOADER_INFO)
#error "CONFIG_TEDS_MANAGE: set CONFIG_MCUMGR_GRP_IMG_TOO_LARGE_SYSBUILD=y (or _BOOTLOADER_INFO): leave the slot's trailer free"
#endif
#if CONFIG_UPDATEABLE_IMAGE_NUMBER != 1
#error "CONFIG_TEDS_MANAGE: one image (CONFIG_UPDATEABLE_IMAGE_NUMBER=1)"
#endif
#if !DT_NODE_HAS_STATUS(DT_ALIAS(watchdog0), okay)
#error "CONFIG_TEDS_MANAGE: an image on trial needs a watchdog, devicetree alias watchdog0"
#endif

/* The answer, from the manager's callback to the node's thread, which is the one that asked. */
static struct {
    uint8_t *octets;
    size_t room, length;
} answer;

static int take_answer(struct net_buf *packet)
{
    answer.length = packet->len <= answer.room ? packet->len : 0;
    memcpy(answer.octets, packet->data, answer.length);
    smp_packet_free(packet);
    return 0;
}

static uint16_t packet_octets(const struct net_buf *packet)
{
    (void)packet;
    return CONFIG_MCUMGR_TRANSPORT_NETBUF_SIZE;
}

static size_t port_manage(void *user, const uint8_t *packet, size_t length, uint8_t *out, size_t room)
{
    static struct cbor_nb_reader reader;
    static struct cbor_nb_writer writer;
    static struct smp_transport transport = {.functions = {.output = take_answer, .get_mtu = packet_octets}};
    struct smp_streamer streamer = {.smpt = &transport, .reader = &reader, .writer = &writer};
    struct net_buf *asked = smp_packet_alloc();
    (void)user;
    if (asked == NULL || length > net_buf_tailroom(asked)) {
        if (asked != NULL) {
            smp_packet_free(asked);
        }
        return 0;
    }
    (void)net_buf_add_mem(asked, packet, length); /* the answer takes the packet's place */
    answer.octets = out;
    answer.room = room;
    answer.length = 0;
    (void)smp_process_request_packet(&streamer, asked); /* calls take_answer before it returns, for errors too */
    return answer.length;
}

static void port_restart(void *user)
{
    (void)user;
    sys_reboot(SYS_REBOOT_WARM);
}

/* Before anything of the application runs: an image on trial that hangs is reverted. It cannot be stopped again, so it is
 * fed from the node's thread for good. */
static const struct device *const watchdog = DEVICE_DT_GET(DT_ALIAS(watchdog0));
static int channel = -1;

static int start_watchdog(void)
{
    const struct wdt_timeout_cfg timeout = {.window = {.min = 0, .max = CONFIG_TEDS_MANAGE_WATCHDOG_MS},
                                            .flags = WDT_FLAG_RESET_SOC};
    if (mcuboot_swap_type() != BOOT_SWAP_TYPE_REVERT || !device_is_ready(watchdog)) {
        return 0;
    }
    channel = wdt_install_timeout(watchdog, &timeout);
    if (channel >= 0) {
        (void)wdt_setup(watchdog, 0);
    }
    return 0;
}

SYS_INIT(start_watchdog, APPLICATION, 0);

void teds_zephyr_feed(void)
{
    if (channel >= 0) {
        (void)wdt_feed(watchdog, channel);
    }
}

bool teds_zephyr_on_trial(void)
{
    return mcuboot_swap_type() == BOOT_SWAP_TYPE_REVERT;
}

static void start_manager(teds_port *port)
{
    port->manage = port_manage;
    port->manage_octets = CONFIG_MCUMGR_TRANSPORT_NETBUF_SIZE;
    port->restart = port_restart;
}

void teds_zephyr_restart(void)
{
    sys_reboot(SYS_REBOOT_WARM);
}
#else
static void start_manager(teds_port *port)
{
    (void)port;
}
#endif

void teds_zephyr_firmware(teds_port *port)
{
    port->about = port_about;
    start_led(port);
    start_button();
    start_manager(port);
}
