/* SPDX-License-Identifier: Apache-2.0 */
/** @file
 * Version of the library, by semantic versioning. Before 1.0.0 the C interface may change with each minor version;
 * what changed is in firmware/CHANGELOG.md.
 */
#ifndef TEDS_VERSION_H
#define TEDS_VERSION_H

/** Changes if a board that compiled before may no longer compile or work. */
#define TEDS_VERSION_MAJOR 0
/** Changes with each new function or option; before 1.0.0 with each incompatible change, too. */
#define TEDS_VERSION_MINOR 3
/** Changes with each correction. */
#define TEDS_VERSION_PATCH 0
/** The version as a number that compares with <, for the preprocessor: 0x000300 is 0.3.0. */
#define TEDS_VERSION ((TEDS_VERSION_MAJOR << 16) | (TEDS_VERSION_MINOR << 8) | TEDS_VERSION_PATCH)
/** The version as text; "-dev" marks sources between two releases. */
#define TEDS_VERSION_STRING "0.3.0-dev"

#endif
