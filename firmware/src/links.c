/* SPDX-License-Identifier: Apache-2.0 */
/* Links to stations: actions after a reply was sent, the end of a lost link, and the move to another CAN address, which
 * ends every link on the bus. */
#include "links.h"
#include "agree.h"
#include "manage.h"
#include "session.h"
#include "session_life.h"
#include "stream.h"
#include "inside.h"

void teds_link_forget(teds_node *node, teds_link link)
{
    teds_half_open *half = teds_half_open_on(node, link);
    teds_session_end(node, teds_session_on(node, link));
    if (half != NULL) {
        teds_wipe(half, sizeof *half);
    }
    for (teds_stored_reply *each = node->replies; each < node->replies + TEDS_REPLIES; each++) {
        if (each->link == link) {
            each->used = false;
        }
    }
    if (node->pending.link == link) {
        teds_pending_forget(node);
    }
}

void teds_can_links_forget(teds_node *node)
{
    for (uint8_t source = TEDS_FIRST_STATION; source <= TEDS_LAST_STATION; source++) {
        teds_link_forget(node, source);
    }
    memset(node->lines, 0, sizeof node->lines);
    node->can.rx_line = NULL;
}

void teds_address_move(teds_node *node, uint8_t address)
{
    if (address != node->can.address) {
        node->can.address = address;
        node->can.gives_up = false; /* the conflict was about the old address */
        node->can.turned_away = 0;
        teds_can_links_forget(node);
    }
    node->can.moves_to = 0;
}

void teds_node_reply_left(teds_node *node, teds_link link)
{
#if TEDS_OPERATION
    teds_streams_ready(node, teds_session_on(node, link));
#endif
    if (node->can.moves_to != 0 && node->can.moves_link == link) {
        teds_address_move(node, node->can.moves_to);
    }
#if TEDS_MANAGED
    teds_restart_after(node, link);
#endif
}

void teds_node_link_lost(teds_node *node, teds_link link)
{
    teds_link_forget(node, link);
    if (node->can.moves_to != 0 && node->can.moves_link == link) {
        teds_address_move(node, node->can.moves_to); /* no station waits for the reply any more */
    }
#if TEDS_MANAGED
    teds_restart_after(node, link);
#endif
}
