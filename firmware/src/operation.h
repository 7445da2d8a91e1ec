/* SPDX-License-Identifier: Apache-2.0 */
/* Claims and leases, single values, dead-man. */
#ifndef TEDS_SRC_OPERATION_H
#define TEDS_SRC_OPERATION_H

#include "inside.h"

#if TEDS_OPERATION
bool teds_channels_good(const teds_port *port);
void teds_operation_start(teds_node *node);
teds_handler teds_operate, teds_idle, teds_read_data_set, teds_write_data_set, teds_self_test, teds_sample, teds_set,
    teds_clock, teds_power_state, teds_operation_state;
int teds_demand_configuration(teds_node *node, const teds_origin *origin, bool writes);
void teds_yield_sensors(teds_node *node, teds_session *session);
void teds_claims_end(teds_node *node, teds_session *session, uint32_t places, bool stopped);
void teds_everything_safe(teds_node *node);
uint64_t teds_operation_poll(teds_node *node, uint64_t now);
bool teds_actuator_claimed(const teds_node *node);
int teds_place_of(const teds_node *node, uint8_t channel);
bool teds_value(const teds_node *node, int place, uint64_t tick, uint8_t *out);
int teds_channel_fits(const teds_node *node, int place, uint64_t *period);
int teds_channel_list(const uint8_t *octets, size_t length, size_t most);

int teds_apply(teds_node *node, const uint8_t *pairs, size_t length);
bool teds_is_claimed(const teds_origin *origin, int place);
int teds_run_key(const teds_node *node, const teds_session *session, const char *label, size_t length, uint8_t out[16]);
#endif

#endif
