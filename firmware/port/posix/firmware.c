/* SPDX-License-Identifier: Apache-2.0 */
/* The firmware of the host port: what it reports, its images and their boot step, a restart. */
#define _GNU_SOURCE
#include "host.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define STEPS "TEDS_NODE_STEPS" /* of flash before a restart: --cut counts on */

/* MAJOR.MINOR.PATCH[+BUILD][,TEXT] */
static int read_report(const char *words, teds_firmware *out)
{
    unsigned long major, minor, patch, build = 0;
    int end = 0;
    if (sscanf(words, "%lu.%lu.%lu%n", &major, &minor, &patch, &end) != 3) {
        return -1;
    }
    words += end;
    if (words[0] == '+') {
        char *behind;
        build = strtoul(words + 1, &behind, 10);
        words = behind;
    }
    if (major > 255 || minor > 255 || patch > 65535 || build > UINT32_MAX || (words[0] != '\0' && words[0] != ',')) {
        return -1;
    }
    out->major = (uint8_t)major;
    out->minor = (uint8_t)minor;
    out->patch = (uint16_t)patch;
    out->build = (uint32_t)build;
    if (words[0] == ',') {
        out->text = words + 1;
    }
    return out->text != NULL && strlen(out->text) > 48 ? -1 : 0;
}

static int read_owner(images *own, const char *path)
{
    uint8_t der[128];
    size_t length;
    FILE *file = path != NULL ? fopen(path, "rb") : NULL;
    if (file == NULL) {
        return -1;
    }
    length = fread(der, 1, sizeof der, file);
    (void)fclose(file);
    return images_owner(own, der, length);
}

static int boot(host_firmware *own, const host_firmware_options *given)
{
    if (host_flash_images(own->flash, given->images, given->image, &own->images.flash) != 0) {
        (void)fprintf(stderr, "The images in %s cannot be read or written: %s.\n", given->images, strerror(errno));
        return -1;
    }
    if (read_owner(&own->images, given->owner) != 0) {
        (void)fprintf(stderr, "--owner is no P-256 public key: imgtool getpub -k KEY -e raw writes one.\n");
        return -1;
    }
    own->images.keeps_counter = given->keeps_counter;
    if (images_boot(&own->images) != 0) {
        (void)fprintf(stderr, "No image in %s that the owner signed: --image FILE puts one into blank slots.\n", given->images);
        return -1;
    }
    own->has_images = true;
    return 0;
}

int host_firmware_start(host_firmware *own, const host_firmware_options *given, host_flash *flash, const teds_port *port)
{
    const char *steps = getenv(STEPS);
    own->flash = flash;
    own->images.port = port;
    own->report = (teds_firmware){.major = TEDS_VERSION_MAJOR, .minor = TEDS_VERSION_MINOR, .patch = TEDS_VERSION_PATCH, .text = "host/teds-node"};
    own->silent = given->about != NULL && strcmp(given->about, "none") == 0;
    flash->steps = steps != NULL ? atol(steps) : 0;
    if (given->about != NULL && !own->silent && read_report(given->about, &own->report) != 0) {
        (void)fprintf(stderr, "--about is none or MAJOR.MINOR.PATCH[+BUILD][,TEXT], TEXT of at most 48 characters.\n");
        return -1;
    }
    return given->images != NULL ? boot(own, given) : 0;
}

void host_firmware_about(const host_firmware *own, teds_firmware *out)
{
    *out = own->report;
    if (own->has_images) {
        images_about(&own->images, out);
    }
}

/* What an image of tests does instead of being a node. */
bool host_firmware_behaves(const host_firmware *own, const char *how)
{
    const char *own_way = own->images.running.behaviour;
    const size_t length = strlen(how);
    return own->has_images && strncmp(own_way, "#!", 2) == 0 && strncmp(own_way + 2, how, length) == 0 && own_way[2 + length] == '\n';
}

void host_restart(host_flash *flash, char **words)
{
    char steps[24];
    (void)snprintf(steps, sizeof steps, "%ld", flash->steps);
    (void)setenv(STEPS, steps, 1);
    for (int file = 3; file < 256; file++) {
        (void)fcntl(file, F_SETFD, FD_CLOEXEC);
    }
    (void)fflush(stdout);
    (void)execv("/proc/self/exe", words);
    (void)fprintf(stderr, "It cannot restart: %s.\n", strerror(errno));
}
