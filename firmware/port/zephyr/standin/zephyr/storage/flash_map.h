/* SPDX-License-Identifier: Apache-2.0 */
#ifndef STANDIN_FLASH_MAP_H
#define STANDIN_FLASH_MAP_H

#include <zephyr/kernel.h>

struct flash_area {
    uint8_t fa_id;
    off_t fa_off;
    size_t fa_size;
};
enum { STANDIN_teds_identity, STANDIN_teds_slot_a, STANDIN_teds_slot_b };
#define FIXED_PARTITION_ID(label) STANDIN_##label
#define FIXED_PARTITION_EXISTS(label) 0
#define FIXED_PARTITION_OFFSET(label) (STANDIN_##label * 0x10000)
#define FIXED_PARTITION_SIZE(label) 0x10000
#define BUILD_ASSERT(condition, text) typedef char build_assert[(condition) ? 1 : -1]
int flash_area_open(uint8_t id, const struct flash_area **fa);
int flash_area_erase(const struct flash_area *fa, off_t off, size_t len);
int flash_area_write(const struct flash_area *fa, off_t off, const void *src, size_t len);
int flash_area_read(const struct flash_area *fa, off_t off, void *dst, size_t len);
uint32_t flash_area_align(const struct flash_area *fa);
uint8_t flash_area_erased_val(const struct flash_area *fa);

#endif
