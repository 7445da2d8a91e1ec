/* SPDX-License-Identifier: Apache-2.0 */
/* Flash of images in files: two slots, and the boot loader's records. Its steps are counted with those of the node's flash. */
#define _POSIX_C_SOURCE 200809L
#include "host.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static uint32_t octets_of_image(int area)
{
    return area == IMAGES_RECORDS ? IMAGES_RECORD_OCTETS : HOST_IMAGE;
}

static int erase_page(void *user, int area, uint32_t at)
{
    host_flash *flash = user;
    const bool cut = host_flash_fails(flash);
    uint8_t blank[IMAGES_PAGE];
    const size_t octets = cut ? IMAGES_PAGE / 2 : IMAGES_PAGE;
    if (at % IMAGES_PAGE != 0 || at >= octets_of_image(area)) {
        return -1;
    }
    if (cut && !flash->torn) {
        host_flash_end();
    }
    memset(blank, 0xFF, sizeof blank);
    if (pwrite(flash->images[area], blank, octets, (off_t)at) != (ssize_t)octets) {
        return -1;
    }
    if (cut) {
        host_flash_end();
    }
    return 0;
}

static int read_image(void *user, int area, uint32_t at, uint8_t *out, size_t length)
{
    const host_flash *flash = user;
    if (at > octets_of_image(area) || length > octets_of_image(area) - at) {
        return -1;
    }
    return pread(flash->images[area], out, length, (off_t)at) == (ssize_t)length ? 0 : -1;
}

static int write_image(void *user, int area, uint32_t at, const uint8_t *octets, size_t length)
{
    host_flash *flash = user;
    uint8_t there[IMAGES_PACKET + IMAGES_UNIT];
    const bool cut = host_flash_fails(flash);
    const size_t written = cut ? length / 2 : length;
    if (length > sizeof there || at % IMAGES_UNIT != 0 || length % IMAGES_UNIT != 0 ||
        read_image(user, area, at, there, length) != 0) {
        return -1;
    }
    for (size_t i = 0; i < length; i++) { /* a unit is written once after an erase */
        if (there[i] != 0xFF) {
            return -1;
        }
    }
    if (cut && !flash->torn) {
        host_flash_end();
    }
    if (pwrite(flash->images[area], octets, written, (off_t)at) != (ssize_t)written) {
        return -1;
    }
    if (cut) {
        host_flash_end();
    }
    return 0;
}

static int open_image(const char *folder, const char *name, uint32_t octets)
{
    char path[4096];
    uint8_t blank[IMAGES_PAGE];
    struct stat there;
    int file;
    if (snprintf(path, sizeof path, "%s/%s", folder, name) >= (int)sizeof path) {
        errno = ENAMETOOLONG;
        return -1;
    }
    file = open(path, O_RDWR | O_CREAT | O_CLOEXEC, S_IRUSR | S_IWUSR);
    if (file < 0 || fstat(file, &there) != 0) {
        return -1;
    }
    memset(blank, 0xFF, sizeof blank);
    for (uint32_t at = (uint32_t)there.st_size; at < octets; at += sizeof blank) {
        if (pwrite(file, blank, sizeof blank, (off_t)at) != (ssize_t)sizeof blank) {
            return -1;
        }
    }
    return file;
}

static int program(const host_flash *flash, const char *image)
{
    uint8_t piece[IMAGES_PAGE];
    ssize_t length;
    off_t at = 0;
    const int file = open(image, O_RDONLY | O_CLOEXEC);
    if (file < 0) {
        return -1;
    }
    while ((length = read(file, piece, sizeof piece)) > 0 && at + length <= (off_t)HOST_IMAGE) {
        if (pwrite(flash->images[IMAGES_FIRST], piece, (size_t)length, at) != length) {
            length = -1;
            break;
        }
        at += length;
    }
    (void)close(file);
    if (length > 0) {
        errno = EFBIG;
    }
    return length == 0 ? 0 : -1;
}

int host_flash_images(host_flash *flash, const char *folder, const char *image, images_flash *out)
{
    static const char *const names[] = {"slot-0.bin", "slot-1.bin", "boot.bin"};
    uint8_t first[2];
    (void)mkdir(folder, S_IRWXU);
    for (int area = 0; area < 3; area++) {
        flash->images[area] = open_image(folder, names[area], octets_of_image(area));
        if (flash->images[area] < 0) {
            return -1;
        }
    }
    *out = (images_flash){flash, erase_page, write_image, read_image, HOST_IMAGE};
    if (image == NULL) {
        return 0;
    }
    if (read_image(flash, IMAGES_FIRST, 0, first, 1) != 0 || read_image(flash, IMAGES_SECOND, 0, first + 1, 1) != 0) {
        return -1;
    }
    return first[0] == 0xFF && first[1] == 0xFF ? program(flash, image) : 0;
}
