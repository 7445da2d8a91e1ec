/* SPDX-License-Identifier: Apache-2.0 */
/* Three raw partitions. No file system and no NVS: none has a transaction over several keys (docs/internals). */
#include "teds_zephyr.h"

#include <zephyr/storage/flash_map.h>

#ifndef PARTITION_ID /* before Zephyr 4.4 */
#define PARTITION_ID FIXED_PARTITION_ID
#define PARTITION_EXISTS FIXED_PARTITION_EXISTS
#define PARTITION_OFFSET FIXED_PARTITION_OFFSET
#define PARTITION_SIZE FIXED_PARTITION_SIZE
#endif

#define APART(one, other)                                                    \
    (PARTITION_OFFSET(one) + PARTITION_SIZE(one) <= PARTITION_OFFSET(other) || \
     PARTITION_OFFSET(other) + PARTITION_SIZE(other) <= PARTITION_OFFSET(one))
BUILD_ASSERT(APART(teds_slot_a, teds_slot_b) && APART(teds_identity, teds_slot_a) && APART(teds_identity, teds_slot_b),
             "the node's partitions overlap");
#if PARTITION_EXISTS(storage_partition) /* the first erase of a slot would take PSA's keys away, the identity with them */
BUILD_ASSERT(APART(storage_partition, teds_identity) && APART(storage_partition, teds_slot_a) &&
                 APART(storage_partition, teds_slot_b),
             "the node's partitions overlap storage_partition");
#endif

/* A boot loader writes its slots and its scratch area as it likes: the first update would take the identity away. */
#define OF_THE_NODE_APART(other) (APART(other, teds_identity) && APART(other, teds_slot_a) && APART(other, teds_slot_b))
#if PARTITION_EXISTS(boot_partition)
BUILD_ASSERT(OF_THE_NODE_APART(boot_partition), "the node's partitions overlap boot_partition");
#endif
#if PARTITION_EXISTS(slot0_partition)
BUILD_ASSERT(OF_THE_NODE_APART(slot0_partition), "the node's partitions overlap slot0_partition");
#endif
#if PARTITION_EXISTS(slot1_partition)
BUILD_ASSERT(OF_THE_NODE_APART(slot1_partition), "the node's partitions overlap slot1_partition");
#endif
#if PARTITION_EXISTS(scratch_partition)
BUILD_ASSERT(OF_THE_NODE_APART(scratch_partition), "the node's partitions overlap scratch_partition");
#endif

static const struct flash_area *areas[3];

static int port_erase(void *user, int area)
{
    (void)user;
    return flash_area_erase(areas[area], 0, areas[area]->fa_size);
}

static int port_write(void *user, int area, uint32_t at, const uint8_t *octets, size_t length)
{
    (void)user;
    return flash_area_write(areas[area], (off_t)at, octets, length);
}

static int port_read(void *user, int area, uint32_t at, uint8_t *out, size_t length)
{
    (void)user;
    return flash_area_read(areas[area], (off_t)at, out, length);
}

int teds_zephyr_flash(teds_port *port)
{
    static const uint8_t ids[3] = {PARTITION_ID(teds_identity), PARTITION_ID(teds_slot_a), PARTITION_ID(teds_slot_b)};
    uint32_t unit = 1;
    size_t slot;
    for (size_t i = 0; i < 3; i++) {
        const int failed = flash_area_open(ids[i], &areas[i]);
        if (failed != 0) {
            return failed;
        }
        unit = flash_area_align(areas[i]) > unit ? flash_area_align(areas[i]) : unit;
    }
    slot = areas[1]->fa_size < areas[2]->fa_size ? areas[1]->fa_size : areas[2]->fa_size;
    if (unit > 32 || slot < TEDS_STAGING + 256 || areas[0]->fa_size < 256) {
        return TEDS_E_USAGE;
    }
    port->slot_octets = (uint32_t)slot;
    port->identity_octets = (uint32_t)areas[0]->fa_size;
    port->unit = (uint8_t)unit;
    port->erased = flash_area_erased_val(areas[0]);
    port->erase = port_erase;
    port->write = port_write;
    port->read = port_read;
    return 0;
}
