/* SPDX-License-Identifier: Apache-2.0 */
/* About and Locate (profile.md, "Firmware"): the firmware on this board, and finding it among others. */
#include "about.h"
#include "clock.h"
#include "inside.h"

#define FORM 1u
#define HEAD_OCTETS 42u
#define TEXT_OCTETS 48u
#define LONGEST_SECONDS 60u
#define OF_THE_PORT (TEDS_FIRMWARE_ON_TRIAL | TEDS_FIRMWARE_PENDING | TEDS_FIRMWARE_SIGNED | TEDS_FIRMWARE_COUNTER)

bool teds_firmware_read(teds_node *node, teds_firmware *out)
{
    const teds_port *port = node->port;
    node->firmware = 0;
    if (port->about == NULL) {
        return false;
    }
    memset(out, 0, sizeof *out);
    port->about(port->user, out);
    node->firmware = (uint8_t)(out->flags & OF_THE_PORT);
    if (port->locate != NULL) {
        node->firmware |= TEDS_FIRMWARE_LOCATES;
    }
    if (TEDS_MANAGED && port->manage != NULL && port->restart != NULL && (out->flags & TEDS_FIRMWARE_SIGNED) != 0) {
        node->firmware |= TEDS_FIRMWARE_MANAGES;
    }
    return true;
}

int teds_about(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    teds_firmware own;
    int length = (int)HEAD_OCTETS;
    (void)origin;
    if (!teds_firmware_read(node, &own)) {
        return -TEDS_UNKNOWN_COMMAND;
    }
    if (command->length != 0) {
        return -TEDS_BAD_FORM;
    }
    out[0] = FORM;
    out[1] = node->firmware;
    out[2] = own.major;
    out[3] = own.minor;
    teds_put16(out + 4, own.patch);
    teds_put32(out + 6, own.build);
    memcpy(out + 10, own.image, 32);
    for (const char *at = own.text; at != NULL && *at != '\0' && length < (int)(HEAD_OCTETS + TEXT_OCTETS); at++) {
        out[length++] = (uint8_t)*at;
    }
    return length;
}

/* Needs no claim and writes no flash; a new request replaces the previous one. */
int teds_locate(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const teds_port *port = node->port;
    (void)origin;
    (void)out;
    if ((node->firmware & TEDS_FIRMWARE_LOCATES) == 0) {
        return -TEDS_UNKNOWN_COMMAND;
    }
    if (command->length != 1 || command->payload[0] > LONGEST_SECONDS) {
        return -TEDS_BAD_FORM;
    }
    node->locate_until = command->payload[0] == 0 ? 0 : teds_now(node) + command->payload[0] * TEDS_SECOND;
    port->locate(port->user, command->payload[0]);
    return 0;
}

uint64_t teds_locate_poll(teds_node *node, uint64_t now)
{
    if (node->locate_until == 0) {
        return TEDS_NEVER;
    }
    if (now >= node->locate_until) {
        node->locate_until = 0;
        node->port->locate(node->port->user, 0);
        return TEDS_NEVER;
    }
    return node->locate_until;
}
