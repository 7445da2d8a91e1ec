/* SPDX-License-Identifier: Apache-2.0 */
/* What a test says: a line for each thing that is wrong, and how many there were. */
#ifndef TEDS_CHECK_H
#define TEDS_CHECK_H

#include <stdio.h>

static int wrong, checked;

#define CHECK(holds, ...)                             \
    do {                                              \
        checked++;                                    \
        if (!(holds)) {                               \
            wrong++;                                  \
            (void)printf("%s:%d: ", __FILE__, __LINE__); \
            (void)printf(__VA_ARGS__);                \
            (void)printf("\n");                       \
        }                                             \
    } while (0)

#define ENDED(name) ((void)printf("%s: %d checked, %d wrong\n", (name), checked, wrong), wrong != 0)

#endif
