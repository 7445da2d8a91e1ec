/* SPDX-License-Identifier: Apache-2.0 */
/* Manage: which SMP packets the port's manager gets, and when; images on trial. */
#ifndef TEDS_SRC_MANAGE_H
#define TEDS_SRC_MANAGE_H

#include "inside.h"

#if TEDS_MANAGED
teds_handler teds_manage;

/* Return 17 for a command that must not run during the present trial or upload, otherwise 0. */
int teds_demand_no_image(teds_node *node, const teds_command *command);

/* End the upload of a session that has ended. */
void teds_upload_end(teds_node *node, const teds_session *session);

/* Do the pending restart: the last frame of the reply was sent, or its link is lost. */
void teds_restart_after(teds_node *node, teds_link link);

/* Restart if a trial has lasted too long; return the time of the next check. */
uint64_t teds_trial_poll(teds_node *node, uint64_t now);
#endif

#endif
