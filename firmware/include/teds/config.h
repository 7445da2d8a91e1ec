/* SPDX-License-Identifier: Apache-2.0 */
/** @file
 * Sizes and options of a node, set when it is compiled: `-DTEDS_STAGING=8192`, or a `teds_user_config.h` with
 * `-DTEDS_USER_CONFIG`. All of it is RAM in teds_node. Compile the library and the board with the same values:
 * teds_node_init compares them and returns #TEDS_E_BUILD if they differ.
 */
#ifndef TEDS_CONFIG_H
#define TEDS_CONFIG_H

#ifdef TEDS_USER_CONFIG
#include "teds_user_config.h"
#endif

#ifndef TEDS_MAX_MESSAGE
/** Longest whole command or reply frame, 512 to 4094 octets (maxMessage of the profile). */
#define TEDS_MAX_MESSAGE 1024
#endif

#ifndef TEDS_STAGING
/** Octets of the staging arena: all TEDS images between their first Write and the commit, and 4 octets for each. */
#define TEDS_STAGING 4096
#endif

#ifndef TEDS_SESSIONS
/** Sessions at once over all links, and as many half-open Opens: two or more. */
#define TEDS_SESSIONS 2
#endif

#ifndef TEDS_REPLIES
/** Stored replies: one for each session and one for every other station, so that a stranger's question finds room.
 * A board on CAN alone may save that one (`TEDS_REPLIES=TEDS_SESSIONS`): while each place belongs to a session, further
 * stations are refused with 17. */
#define TEDS_REPLIES (TEDS_SESSIONS + 1)
#endif

#ifndef TEDS_CAN_LINES
/** Stations (sources F1 to F7) that the node keeps ISO-TP state for at once. Each session keeps its own, and one more
 * than sessions serves all other stations; with seven, each station has one. */
#if TEDS_SESSIONS < 3
#define TEDS_CAN_LINES 4
#elif TEDS_SESSIONS < 6
#define TEDS_CAN_LINES (TEDS_SESSIONS + 1)
#else
#define TEDS_CAN_LINES 7
#endif
#endif

#ifndef TEDS_MANAGED
/** 1: takes firmware updates and the other packets of 128.23 (SMP), if the port has `manage`. 0: that command is unknown. */
#define TEDS_MANAGED 0
#endif

#ifndef TEDS_CAN_FD
/** 1: answers CAN FD in FD. 0: classic frames alone. */
#define TEDS_CAN_FD 1
#endif

#ifndef TEDS_CAN_BLOCK
/** Block size that flow control asks a station for, in frames; 0: no limit (ISO 15765-2). */
#define TEDS_CAN_BLOCK 16
#endif

#ifndef TEDS_CAN_STMIN
/** STmin that flow control asks a station for, as sent on the wire: 00 to 7F ms, or F1 to F9 (100 to 900 us). */
#define TEDS_CAN_STMIN 0
#endif

#ifndef TEDS_OPERATION
/** 1: measures and drives (docs/operation.md). 0: provisioning alone; each command of operation is refused with 1. */
#define TEDS_OPERATION 1
#endif

#ifndef TEDS_CHANNELS
/** TransducerChannels of the board, at most 32. */
#define TEDS_CHANNELS 8
#endif

#ifndef TEDS_STREAMS
/** Streams at once over all sessions, 1 to 127. */
#define TEDS_STREAMS 2
#endif

#ifndef TEDS_DRIVE_OCTETS
/** Octets of the data sets of all channels of one Drive, 1 to 200. */
#define TEDS_DRIVE_OCTETS 32
#endif

#ifndef TEDS_EVENT_CHANNELS
/** Event sensors of the board. */
#define TEDS_EVENT_CHANNELS 1
#endif

#ifndef TEDS_EVENTS
/** Events of each event sensor that may wait for the main loop, 1 to 254. */
#define TEDS_EVENTS 4
#endif

#ifndef TEDS_EVENT_OCTETS
/** Octets of the longest data set of an event sensor, 1 to 219. */
#define TEDS_EVENT_OCTETS 8
#endif

#ifndef TEDS_SHA256_OCTETS
/** Octets of the port's running SHA-256: 112 for br_sha256_context, 232 for psa_hash_operation_t of Mbed TLS 2.28. */
#define TEDS_SHA256_OCTETS 112
#endif

#ifndef TEDS_NFC
/** 1: NFC (a Type 4 tag, TNEP); teds_config states if this board has an antenna. 0: no NFC, and the wired bus counts as
 * tapped in factory state. */
#define TEDS_NFC 0
#endif

#ifndef TEDS_MAX_NDEF
/** Longest NDEF message, 160 to 32000 octets. With 64 octets more than a command frame, no command is sent in pieces;
 * it is RAM, so less will do. */
#define TEDS_MAX_NDEF (TEDS_MAX_MESSAGE + 64)
#endif

#ifndef TEDS_BLE
/** 1: Bluetooth LE, its framing. */
#define TEDS_BLE 0
#endif

#ifndef TEDS_BLE_CONNECTIONS
/** Bluetooth LE connections at once, 2 to 20: two or more, so that a stranger cannot hold the only one. */
#define TEDS_BLE_CONNECTIONS 2
#endif

#if TEDS_MAX_MESSAGE < 512 || TEDS_MAX_MESSAGE > 4094
#error "TEDS_MAX_MESSAGE is 512 to 4094"
#endif
#if TEDS_BLE_CONNECTIONS < 2 || TEDS_BLE_CONNECTIONS > 20
#error "two to twenty connections"
#endif
#if TEDS_MAX_NDEF < 160 || TEDS_MAX_NDEF > 32000
#error "TEDS_MAX_NDEF is 160 to 32000"
#endif
#if TEDS_SESSIONS < 2 || TEDS_SESSIONS > 127 || TEDS_REPLIES > 127
#error "two sessions at least; sessions and stored replies at most 127"
#endif
#if TEDS_REPLIES < TEDS_SESSIONS || (TEDS_REPLIES == TEDS_SESSIONS && (TEDS_NFC || TEDS_BLE))
#error "a stored reply more than sessions, on CAN alone at least as many"
#endif
#if TEDS_STAGING < 512 || TEDS_STAGING > 60000
#error "TEDS_STAGING is 512 to 60000"
#endif
#if TEDS_CAN_LINES < 1 || TEDS_CAN_LINES > 7
#error "one to seven lines: there are no more stations"
#endif
#if TEDS_CAN_LINES < 7 && TEDS_CAN_LINES <= TEDS_SESSIONS
#error "a line more than sessions, or all seven: a stranger's question takes no line that a session needs"
#endif
#if TEDS_CAN_BLOCK < 0 || TEDS_CAN_BLOCK > 255
#error "TEDS_CAN_BLOCK is 0 to 255"
#endif
#if TEDS_CAN_STMIN < 0 || (TEDS_CAN_STMIN > 0x7F && TEDS_CAN_STMIN < 0xF1) || TEDS_CAN_STMIN > 0xF9
#error "TEDS_CAN_STMIN is 00 to 7F or F1 to F9"
#endif
#if TEDS_CHANNELS < 1 || TEDS_CHANNELS > 32 || TEDS_STREAMS < 1 || TEDS_STREAMS > 127
#error "one to 32 channels, one to 127 streams"
#endif
#if TEDS_DRIVE_OCTETS < 1 || TEDS_DRIVE_OCTETS > 200
#error "TEDS_DRIVE_OCTETS is 1 to 200"
#endif
#if TEDS_EVENT_CHANNELS < 1 || TEDS_EVENT_CHANNELS > TEDS_CHANNELS || TEDS_EVENTS < 1 || TEDS_EVENTS > 254
#error "one event sensor at least and no more than channels, 1 to 254 events"
#endif
#if TEDS_EVENT_OCTETS < 1 || TEDS_EVENT_OCTETS > 219
#error "TEDS_EVENT_OCTETS is 1 to 219: more fits no data message"
#endif

#endif
