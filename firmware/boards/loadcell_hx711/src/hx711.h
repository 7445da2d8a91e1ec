/* SPDX-License-Identifier: Apache-2.0 */
/* An HX711 by two pins: 24 bits of a bridge, 80 times a second (RATE high). */
#ifndef HX711_H
#define HX711_H

#include <stdbool.h>
#include <stdint.h>

/* 0, or a negative errno where its pins are not there. */
int hx711_start(void);

/* Read once, if it has a conversion: 24 bits offset binary, so that no load is 800000; false where it has none yet. */
bool hx711_read(uint32_t *out);

#endif
