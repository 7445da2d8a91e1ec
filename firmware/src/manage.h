/* SPDX-License-Identifier: Apache-2.0 */
/* Manage: which SMP packets reach the port, and when; images on trial. */
#ifndef TEDS_SRC_MANAGE_H
#define TEDS_SRC_MANAGE_H

#include "inside.h"

#if TEDS_MANAGED
teds_handler teds_manage;

/* 17 for a command that the running trial or an upload keeps out, else 0. */
int teds_demand_no_image(teds_node *node, const teds_command *command);

/* An upload's session has ended. */
void teds_upload_end(teds_node *node, const teds_session *session);

/* The last frame of the reply has left, or its link is lost: the restart that waited for it. */
void teds_restart_after(teds_node *node, teds_link link);

/* Restart when a trial lasted too long; return when it is due. */
uint64_t teds_trial_poll(teds_node *node, uint64_t now);
#endif

#endif
