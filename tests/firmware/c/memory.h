/* SPDX-License-Identifier: Apache-2.0 */
/* A node over flash in memory, with a clock and randomness that a test gives: for C tests, fuzzers, and by ctypes. */
#ifndef TEDS_MEMORY_H
#define TEDS_MEMORY_H

#include "images.h"
#include "teds/node.h"
#include "teds_bearssl.h"

#define MEMORY_IDENTITY 256u
#define MEMORY_SLOT (TEDS_STAGING + 4096u)
#define MEMORY_IMAGE 16384u

/* `kind` n: octets for a nonce or counter; i, o: the scalar of an identity or one-time key. */
typedef int (*memory_random)(char kind, uint8_t *out, size_t length);

/* The channels, in a test's hands: `what` s sample, b bears, a set, g set point, f safe, m arm (argument: ms), k kick,
 * t self-test, T testing, F fault, p power (7 octets as the reply has them). */
typedef int (*memory_hook)(char what, uint8_t channel, uint64_t argument, uint8_t *octets, size_t length);

/* The firmware, in a test's hands: `what` a about (flags, major, minor, patch 2, build 4, image 32, text; returns the
 * length), l locate (argument: seconds), m manage (octets in, answer out; returns its length), r restart. */
typedef size_t (*memory_firmware_hook)(char what, unsigned argument, uint8_t *octets, size_t length, size_t room);

typedef struct memory_board {
    teds_bearssl crypto; /* first: the port of BearSSL looks here */
    teds_port port;
    teds_config config;
    teds_node node;
    uint8_t flash[MEMORY_IDENTITY + 2 * MEMORY_SLOT];
    uint32_t next[3]; /* where the next unit of an area may be written */
    long steps, cut;  /* the power fails at this step; 0: never */
    bool torn, dead, misused;
    uint64_t now;
    memory_random random;
    teds_channel channels[TEDS_CHANNELS + 1]; /* one more than a node takes */
    uint8_t values[TEDS_CHANNELS][8];
    teds_fixed fixed[8];
    bool fails;
    long written, garbled;  /* units; the one that is taken and reads back as something else, 0: none */
    long reads, unreadable; /* of flash; the one that fails, 0: none */
    memory_hook hook;
    memory_firmware_hook firmware;
    char text[64];
    bool has_images, restarts;
    images images;
    uint8_t image_flash[2 * MEMORY_IMAGE + IMAGES_RECORD_OCTETS];
    teds_port chip; /* its cryptography, behind what fails */
    long calls, failing; /* of the chip; the one that fails, 0: none */
    bool fd; /* how commands come */
#if TEDS_NFC
    teds_isodep card;
    teds_nfc_service services[2]; /* of the application */
    uint8_t power[2], air[6]; /* flags and level of its battery; its BLE address */
#endif
} memory_board;

memory_board *memory_new(const uint8_t uuid[10], uint8_t unit, uint8_t erased, memory_random random);
void memory_free(memory_board *board);
int memory_start(memory_board *board);
int memory_start_cut(memory_board *board, long step, bool torn);
void memory_channel(memory_board *board, uint8_t number, uint8_t kind, uint8_t model, uint8_t octets,
                    uint32_t shortest);
/* This unit from now on reads back as something else; 0: none. How many were written. */
void memory_garble(memory_board *board, long unit);
long memory_written(const memory_board *board);
bool memory_spare_slot_fails(const memory_board *board);
/* Its slots have so many octets; before the start. */
void memory_slot_octets(memory_board *board, uint32_t octets);
/* Data messages that it could not send. */
uint64_t memory_missed(const memory_board *board);
void memory_no_channels(memory_board *board);
void memory_halt(memory_board *board, uint8_t number, uint8_t halt);
void memory_hook_up(memory_board *board, memory_hook hook);
/* It reports its firmware, is located and managed; packets of at most so many octets, 0: what fits. Before the start. */
void memory_firmware(memory_board *board, memory_firmware_hook hook, uint16_t most);
void memory_pressed(memory_board *board);
/* It has two slots and a boot loader of this owner (port/posix/images.h); before the start, in place of memory_firmware.
 * False if that is no key. A start whose boot step fails returns MEMORY_NO_IMAGE. */
#define MEMORY_NO_IMAGE (-100)
bool memory_images(memory_board *board, const uint8_t *owner, size_t length, bool counter);
/* All of their flash: out, and in again. */
size_t memory_image_flash(const memory_board *board, uint8_t *out);
void memory_put_image_flash(memory_board *board, const uint8_t *octets);
/* True once after the node asked for a restart; and the restart, in which steps of flash count on. */
bool memory_restarts(memory_board *board);
int memory_restart(memory_board *board);
/* A board that has none of this: a word of memory_hook. After hook_up. */
void memory_without(memory_board *board, char what);
void memory_slow(memory_board *board, bool slow);
/* This call of the chip's random source or cryptography from now on fails, it alone; 0: none. How many there were. */
void memory_chip_fails(memory_board *board, long call);
long memory_chip_calls(const memory_board *board);
void memory_read_fails(memory_board *board, long read_of_flash);
long memory_reads(const memory_board *board);
void memory_clock(memory_board *board, uint32_t step, uint16_t drift);
void memory_by_fd(memory_board *board, bool fd);
bool memory_acts(const memory_board *board);
bool memory_streams(const memory_board *board);
/* What takes a station too long: the last run of a link, the next counter of the one stream and when it began. */
void memory_set_run(memory_board *board, uint8_t link, uint16_t run);
void memory_set_counter(memory_board *board, uint32_t counter, uint64_t start);
void memory_at(memory_board *board, uint64_t now);
void memory_cut(memory_board *board, long step, bool torn);
void memory_fails(memory_board *board, bool fails);
long memory_steps(const memory_board *board);
bool memory_dead(const memory_board *board);
bool memory_misused(const memory_board *board);
/* The whole flash: out, and in again. */
size_t memory_flash(const memory_board *board, uint8_t *out);
void memory_put_flash(memory_board *board, const uint8_t *octets);
size_t memory_handle(memory_board *board, uint8_t link, uint8_t kind, bool tapped, const uint8_t *frame,
                     size_t length, uint8_t *reply);
uint64_t memory_poll(memory_board *board);
void memory_reply_left(memory_board *board, uint8_t link);
/* Put a state and TEDS (id 2, length 2, octets; one after another) into flash as if they had been committed. */
int memory_put(memory_board *board, uint8_t flags, uint8_t address, uint32_t epoch, uint32_t sequence,
               const uint8_t key[16], const uint8_t station[65], const uint8_t ca[65], const uint8_t *teds,
               size_t length);
/* A TEDS of the firmware, from the next start on; `octets` stay where they are. */
void memory_fixed(memory_board *board, uint8_t channel, uint8_t code, const uint8_t *octets, uint16_t length);
/* Its controller is on the bus; after a start. */
void memory_can_start(memory_board *board);
void memory_lost(memory_board *board, uint8_t link);
/* Its CAN controller is off the bus, and comes back. */
void memory_bus_off(memory_board *board);
void memory_move(memory_board *board, uint8_t address);
int memory_by_hand(memory_board *board);
void memory_can_rx(memory_board *board, uint32_t identifier, const uint8_t *data, uint8_t length, bool fd);
void memory_can_rx_at(memory_board *board, uint32_t identifier, const uint8_t *data, uint8_t length, bool fd,
                      uint64_t tick);
/* Length of the frame, -1: none. */
int memory_can_tx(memory_board *board, uint32_t *identifier, uint8_t *data, bool *fd);
void memory_event(memory_board *board, uint8_t channel, uint64_t tick, const uint8_t *octets, bool valid);
/* What an actuator does. */
void memory_set_point(const memory_board *board, uint8_t channel, uint8_t *out);
size_t memory_node_octets(void);
#if TEDS_NFC
/* Before the start: an antenna, and what the tag says of itself. */
/* A service of the application on the tag; `name` outlives the board. Before the start. */
void memory_nfc_service(memory_board *board, const char *name,
                        int (*answer)(void *, const uint8_t *, size_t, uint8_t *, size_t));
void memory_nfc(memory_board *board, uint8_t wt_int, uint8_t n_wait, uint16_t max_ndef);
/* It has a battery with these flags and this level; an address in the air. Before the start. */
void memory_battery(memory_board *board, uint8_t flags, uint8_t level);
void memory_in_the_air(memory_board *board, const uint8_t address[6]);
void memory_nfc_field(memory_board *board, bool present);
bool memory_nfc_written(memory_board *board, const uint8_t *message, size_t length);
size_t memory_nfc_message(const memory_board *board, uint8_t *out);
/* A frame of the reader, RATS included; 0: silence. */
size_t memory_nfc_frame(memory_board *board, const uint8_t *frame, size_t length, uint8_t out[256]);
#endif
#if TEDS_BLE
void memory_ble_connected(memory_board *board, uint8_t connection, uint16_t mtu);
void memory_ble_mtu(memory_board *board, uint8_t connection, uint16_t mtu);
void memory_ble_disconnected(memory_board *board, uint8_t connection);
void memory_ble_written(memory_board *board, uint8_t connection, const uint8_t *value, size_t length);
size_t memory_ble_notify(memory_board *board, uint8_t connection, uint8_t out[512]);
void memory_ble_hears(memory_board *board, uint8_t connection, bool hears);
size_t memory_ble_data(memory_board *board, uint8_t *connection, uint8_t out[TEDS_BLE_DATA]);
void memory_ble_driven(memory_board *board, uint8_t connection, const uint8_t *value, size_t length);
bool memory_ble_advertises(const memory_board *board);
bool memory_ble_drops(memory_board *board, uint8_t connection);
bool memory_in_session(memory_board *board, uint8_t link);
#endif

#endif
