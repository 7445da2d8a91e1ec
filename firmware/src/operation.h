/* SPDX-License-Identifier: Apache-2.0 */
/* Measurement operation: claims with their leases and dead-men, single values. A session claims channels; an actuator
 * has at most one claim, and goes to its safe state when the claim ends. */
#ifndef TEDS_SRC_OPERATION_H
#define TEDS_SRC_OPERATION_H

#include "inside.h"

#if TEDS_OPERATION
teds_handler teds_operate, teds_idle, teds_read_data_set, teds_write_data_set, teds_self_test, teds_sample, teds_set,
    teds_clock, teds_power_state, teds_operation_state;

/* Bring all actuators to their safe state at a start. */
void teds_operation_start(teds_node *node);

/* End expired leases and dead-men, and claims of a board whose power is too low. Take the samples that are due. Return
 * the time of the next action. */
uint64_t teds_operation_poll(teds_node *node, uint64_t now);

/* End a session's claims on these places. `stopped`: Operation state reports those of actuators as stopped. */
void teds_claims_end(teds_node *node, teds_session *session, uint32_t places, bool stopped);

/* End the sensor claims of all other sessions: a Write over NFC has precedence. */
void teds_yield_sensors(teds_node *node, teds_session *session);

/* End every claim, and bring each actuator to its safe state. */
void teds_make_all_safe(teds_node *node);

/* Return 0 if Write (`writes`), Update or a new CAN address is permitted now; or a reason negated, if this session or
 * another has claims. */
int teds_demand_configuration(teds_node *node, const teds_origin *origin, bool writes);

bool teds_actuator_claimed(const teds_node *node);

/* True if the command's session claims this place. */
bool teds_is_claimed(const teds_origin *origin, int place);

/* Set actuators: `pairs` of channel and data set, all claimed. 0, or a reason negated: then none was set. */
int teds_set_actuators(teds_node *node, const uint8_t *pairs, size_t length);
#endif

#endif
