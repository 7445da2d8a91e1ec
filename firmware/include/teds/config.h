/* Sizes of a node, set when it is built (-DTEDS_STAGING=8192 or a teds_user_config.h). All of it is RAM in teds_node. */
#ifndef TEDS_CONFIG_H
#define TEDS_CONFIG_H

#ifdef TEDS_USER_CONFIG
#include "teds_user_config.h"
#endif

/* maxMessage of wire.md: the longest whole command or reply frame, 512 to 4094. */
#ifndef TEDS_MAX_MESSAGE
#define TEDS_MAX_MESSAGE 1024
#endif

/* The staging arena: all TEDS images between their first Write and the commit, 4 octets of bookkeeping each. */
#ifndef TEDS_STAGING
#define TEDS_STAGING 4096
#endif

/* Sessions, and half-open Opens, over all links; two or more. */
#ifndef TEDS_SESSIONS
#define TEDS_SESSIONS 2
#endif

/* Stored replies: one for each session and one for everyone else, so that a stranger's question meets room. A board on
 * CAN alone may save that one (TEDS_REPLIES=TEDS_SESSIONS): while every place is a session's, further stations get 17. */
#ifndef TEDS_REPLIES
#define TEDS_REPLIES (TEDS_SESSIONS + 1)
#endif

/* Stations that a node keeps ISO-TP state for at once (sources F1 to F7): each session keeps its own, and one more than
 * sessions is for everybody else. With all seven, every station has one. */
#ifndef TEDS_CAN_LINES
#if TEDS_SESSIONS < 3
#define TEDS_CAN_LINES 4
#elif TEDS_SESSIONS < 6
#define TEDS_CAN_LINES (TEDS_SESSIONS + 1)
#else
#define TEDS_CAN_LINES 7
#endif
#endif

/* 1: answers CAN FD in FD. 0: classic frames alone. */
#ifndef TEDS_CAN_FD
#define TEDS_CAN_FD 1
#endif

/* What flow control asks a station for: frames in a block (0: no limit), STmin as on the wire (ISO 15765-2). */
#ifndef TEDS_CAN_BLOCK
#define TEDS_CAN_BLOCK 16
#endif
#ifndef TEDS_CAN_STMIN
#define TEDS_CAN_STMIN 0
#endif

/* 1: measures (operation.md). 0: provisioning alone; every command of operation.md gets 1. */
#ifndef TEDS_OPERATION
#define TEDS_OPERATION 1
#endif

/* Channels of the board, at most 32. */
#ifndef TEDS_CHANNELS
#define TEDS_CHANNELS 8
#endif

/* Streams over all sessions, at least 1. */
#ifndef TEDS_STREAMS
#define TEDS_STREAMS 2
#endif

/* Data sets of all channels of one Drive, octets. */
#ifndef TEDS_DRIVE_OCTETS
#define TEDS_DRIVE_OCTETS 32
#endif

/* Event sensors of the board; events of each that wait for the main loop, and the longest data set of one. */
#ifndef TEDS_EVENT_CHANNELS
#define TEDS_EVENT_CHANNELS 1
#endif
#ifndef TEDS_EVENTS
#define TEDS_EVENTS 4
#endif
#ifndef TEDS_EVENT_OCTETS
#define TEDS_EVENT_OCTETS 8
#endif

/* Octets of the port's running SHA-256 (br_sha256_context 112, psa_hash_operation_t of Mbed TLS 2.28 232). */
#ifndef TEDS_SHA256_OCTETS
#define TEDS_SHA256_OCTETS 112
#endif

/* 1: with NFC (a Type 4 tag, TNEP); teds_config says whether this board has an antenna. 0: the wired bus counts as tapped
 * in factory state (security-teds.md, 2). */
#ifndef TEDS_NFC
#define TEDS_NFC 0
#endif

/* The longest NDEF message. With 64 octets more than a command frame no command goes in pieces; RAM, so less will do. */
#ifndef TEDS_MAX_NDEF
#define TEDS_MAX_NDEF (TEDS_MAX_MESSAGE + 64)
#endif

/* 1: Bluetooth LE, its framing. Connections at once: two or more, so that a stranger does not hold the only one. */
#ifndef TEDS_BLE
#define TEDS_BLE 0
#endif
#ifndef TEDS_BLE_CONNECTIONS
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
