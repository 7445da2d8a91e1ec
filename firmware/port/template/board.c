/* SPDX-License-Identifier: Apache-2.0 */
/* A blank port: copy this folder, and write each function as its comment asks. It compiles and links as it is, and the
 * node then does not start (TEDS_E_FLASH), because flash fails. Delete what the board does not have.
 */
#include "board.h"
#include "teds_bearssl.h"

#include <string.h>

/* Octets of each area: whole erase pages of the chip. */
#define IDENTITY_OCTETS 2048u
#define SLOT_OCTETS 6144u /* TEDS_STAGING + 256 or more */

/* What `user` points to. The crypto context is its first member; teds_bearssl_fill verifies that. */
typedef struct board {
    teds_bearssl crypto;
    uint16_t set_point;
} board;

static board own;

/* -- flash: three areas of whole pages at fixed addresses, outside of any file system, settings or boot loader slot - */

/* Erase all of an area (TEDS_IDENTITY, TEDS_SLOT_A, TEDS_SLOT_B), and return when that is done. -1 if the controller
 * reports an error. The node calls it rarely: a page is good for thousands of cycles. */
static int erase(void *user, int area)
{
    (void)user;
    (void)area;
    return -1;
}

/* Write at an offset in an area: whole units (port->unit), ascending, each unit once after an erase. Return only when the
 * octets are in flash: the node promises the station what it has written, and a power cut may follow at once. */
static int write_flash(void *user, int area, uint32_t at, const uint8_t *octets, size_t length)
{
    (void)user;
    (void)area;
    (void)at;
    (void)octets;
    (void)length;
    return -1;
}

/* Read from any offset. In memory-mapped flash this is memcpy; -1 for an uncorrectable ECC error. */
static int read_flash(void *user, int area, uint32_t at, uint8_t *out, size_t length)
{
    (void)user;
    (void)area;
    (void)at;
    (void)out;
    (void)length;
    return -1;
}

/* -- randomness ---------------------------------------------------------------------------------------------------- */

/* Fill `out` from the chip's true random generator. Wait until it is ready, check its error flags, and return -1 rather
 * than weak octets: every key comes from here. Never rand(), never a seed of the compiler, never the clock. */
static int draw(void *user, uint8_t *out, size_t length)
{
    (void)user;
    (void)out;
    (void)length;
    return -1;
}

/* -- the clock ----------------------------------------------------------------------------------------------------- */

/* ns since the start, from a timer that never goes back. A timer of 32 bits wants an interrupt that counts its wraps, and
 * here a look at whether one is pending: read the upper half, the timer, the pending flag, and the upper half again. */
uint64_t board_now(void)
{
    return 0;
}

static uint64_t now(void *user)
{
    (void)user;
    return board_now();
}

/* -- channels: what the hardware is; the TEDS only describes it ---------------------------------------------------- */

/* Number, kind, DatModel, octets of a value, ActHalt, shortest period in ns; ascending by number. */
static const teds_channel channels[] = {
    {1, TEDS_SENSOR, 0, 2, 0, 1000000},
    {2, TEDS_ACTUATOR, 0, 2, 0, 10000000},
};

/* Give the newest value of a sensor, most significant octet first, at once: a slow converter runs by itself, and this
 * returns its last result. False if the value is not valid: out of range, warming up, a broken wire. */
static bool sample(void *user, uint8_t channel, uint64_t tick, uint8_t *out)
{
    (void)user;
    (void)channel;
    (void)tick;
    memset(out, 0, 2);
    return false;
}

/* True if the hardware takes this raw value. The limits are the mechanism's: a value refused here never reaches `set`. */
static bool bears(void *user, uint8_t channel, const uint8_t *octets)
{
    (void)user;
    (void)channel;
    (void)octets;
    return false;
}

/* Apply a value: write the timer's compare register, or start the motion. */
static void set(void *user, uint8_t channel, const uint8_t *octets)
{
    (void)channel;
    ((board *)user)->set_point = (uint16_t)(octets[0] << 8 | octets[1]);
}

/* Return the set point that is in force. */
static void set_point(void *user, uint8_t channel, uint8_t *out)
{
    const uint16_t value = ((board *)user)->set_point;
    (void)channel;
    out[0] = (uint8_t)(value >> 8);
    out[1] = (uint8_t)value;
}

/* Bring the actuator to its safe state: power off, brake closed, whatever harms nobody. Also called from the dead-man. */
static void safe(void *user, uint8_t channel)
{
    (void)user;
    (void)channel;
}

/* Arm the dead-man for `ms`, or disarm it (0). It is a hardware timer whose interrupt calls `safe` by itself: the main
 * loop may be busy with a P-256 multiplication or an erase for a second. */
static void arm(void *user, uint8_t channel, uint16_t ms)
{
    (void)user;
    (void)channel;
    (void)ms;
}

/* A good value came: start that timer from the beginning. */
static void kick(void *user, uint8_t channel)
{
    (void)user;
    (void)channel;
}

/* -- CAN: 29-bit identifiers. A filter passes 18DAxxxx, 18DBFFxx, 18EFxxxx, 18FFxxxx and 1CFFxxxx; begin without one -- */

/* The receive interrupt puts frames with their time into a ring of 20 or more; this takes the oldest. */
bool board_frame_came(teds_can_frame *frame, uint64_t *tick)
{
    (void)frame;
    (void)tick;
    return false;
}

/* True if the one mailbox that this port uses is free. */
bool board_may_send(void)
{
    return false;
}

/* Put a frame into that mailbox. frame->fd: an FD frame, with bit rate switching as the bus has it. */
void board_send(const teds_can_frame *frame)
{
    (void)frame;
}

/* Restart the controller after bus-off (128 × 11 recessive bits), and return true once for each time. */
bool board_was_bus_off(void)
{
    return false;
}

/* -- button and sleep ---------------------------------------------------------------------------------------------- */

/* True once when the button, pad or magnet was held for 5 s. Count only a press that began after the start. */
bool board_reset_was_held(void)
{
    return false;
}

/* WFI until the timer reaches `until`, or an interrupt of the controller. See board.h for a time that is past. */
void board_sleep(uint64_t until)
{
    (void)until;
}

/* -- firmware: each of these may be left out (NULL) ----------------------------------------------------------------- */

/* Describe what runs. With MCUboot: version and SHA256 TLV from the header and TLVs of the running slot, on trial if its
 * image-ok flag is not set, TEDS_FIRMWARE_SIGNED only if the boot loader checks a signature. `text` is board/application. */
static void about(void *user, teds_firmware *out)
{
    (void)user;
    out->major = 1;
    out->text = "template/blank";
}

/* Blink an LED from a timer while `seconds` is not 0; the node calls it with 0 when the time is over. */
static void locate(void *user, uint8_t seconds)
{
    (void)user;
    (void)seconds;
}

/* Answer one SMP packet: hand it to an SMP server over two slots of flash. Read all of `packet` before you write to `out`,
 * which shares its memory. Called only if TEDS_MANAGED is 1 and `about` says TEDS_FIRMWARE_SIGNED. */
static size_t manage(void *user, const uint8_t *packet, size_t length, uint8_t *out, size_t room)
{
    (void)user;
    (void)packet;
    (void)length;
    (void)out;
    (void)room;
    return 0;
}

/* Reset the chip: NVIC_SystemReset(). */
static void restart(void *user)
{
    (void)user;
}

/* True once when a button was released that was held for 50 ms to 2 s. */
bool board_was_pressed(void)
{
    return false;
}

/* -- start --------------------------------------------------------------------------------------------------------- */

/* Start clocks and peripherals, then fill in port and configuration. */
int board_start(teds_port *port, teds_config *config)
{
    memset(config, 0, sizeof *config);
    /* UUID: ten octets that no other board has; used at the first start only. From the chip's unique number, say. */
    memset(config->uuid, 0x5A, sizeof config->uuid);

    memset(port, 0, sizeof *port);
    port->user = &own;
    port->slot_octets = SLOT_OCTETS;
    port->identity_octets = IDENTITY_OCTETS;
    port->unit = 8;      /* what the flash writes at once: 2, 4, 8, 16 or 32 octets */
    port->erased = 0xFF; /* 00 on a few chips (STM32L0, L1) */
    port->erase = erase;
    port->write = write_flash;
    port->read = read_flash;
    port->random = draw;
    port->now = now;
    port->step = 1000; /* ns of one tick of the timer */
    port->drift = 50;  /* ppm of its crystal */
    port->channels = channels;
    port->channel_count = sizeof channels / sizeof channels[0];
    port->sample = sample;
    port->bears = bears;
    port->set = set;
    port->set_point = set_point;
    port->safe = safe;
    port->arm = arm;
    port->kick = kick;
    port->about = about;
    port->locate = locate;
    port->manage = manage;
    port->manage_octets = 0; /* as long as a sealed command holds; or what the SMP server's buffer holds */
    port->restart = restart;
    own.crypto.random = draw;
    return teds_bearssl_fill(port, &own.crypto);
}
