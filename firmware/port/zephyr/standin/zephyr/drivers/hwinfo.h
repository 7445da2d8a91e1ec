/* SPDX-License-Identifier: Apache-2.0 */
#ifndef STANDIN_HWINFO_H
#define STANDIN_HWINFO_H

#include <zephyr/kernel.h>

ssize_t hwinfo_get_device_id(uint8_t *buffer, size_t length);

#endif
