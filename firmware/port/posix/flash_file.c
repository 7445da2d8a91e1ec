/* SPDX-License-Identifier: Apache-2.0 */
#define _POSIX_C_SOURCE 200809L
#include "host.h"

#include <fcntl.h>
#include <signal.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static uint32_t start_of(int area)
{
    return area == TEDS_IDENTITY ? 0 : area == TEDS_SLOT_A ? HOST_IDENTITY : HOST_IDENTITY + HOST_SLOT;
}

static uint32_t octets_of(int area)
{
    return area == TEDS_IDENTITY ? HOST_IDENTITY : HOST_SLOT;
}

static int put(host_flash *flash, uint32_t at, size_t length)
{
    return pwrite(flash->file, flash->image + at, length, (off_t)at) == (ssize_t)length ? 0 : -1;
}

int host_flash_open(host_flash *flash, const char *path)
{
    struct stat there;
    flash->file = open(path, O_RDWR | O_CREAT | O_CLOEXEC, S_IRUSR | S_IWUSR);
    if (flash->file < 0 || fstat(flash->file, &there) != 0) {
        return -1;
    }
    memset(flash->image, 0xFF, sizeof flash->image);
    if (there.st_size == 0) {
        return put(flash, 0, sizeof flash->image);
    }
    return pread(flash->file, flash->image, sizeof flash->image, 0) == (ssize_t)sizeof flash->image ? 0 : -1;
}

bool host_flash_fails(host_flash *flash)
{
    flash->steps++;
    return flash->cut != 0 && flash->steps == flash->cut;
}

void host_flash_end(void)
{
    (void)raise(SIGKILL);
}

int host_flash_erase(host_flash *flash, int area)
{
    const bool cut = host_flash_fails(flash);
    if (cut && !flash->torn) {
        host_flash_end();
    }
    memset(flash->image + start_of(area), 0xFF, cut ? octets_of(area) / 2 : octets_of(area));
    if (put(flash, start_of(area), octets_of(area)) != 0) {
        return -1;
    }
    if (cut) {
        host_flash_end();
    }
    return 0;
}

int host_flash_write(host_flash *flash, int area, uint32_t at, const uint8_t *octets, size_t length)
{
    const uint32_t start = start_of(area) + at;
    const bool cut = host_flash_fails(flash);
    if (at + length > octets_of(area) || at % HOST_UNIT != 0 || length % HOST_UNIT != 0) {
        return -1;
    }
    for (size_t i = 0; i < length; i++) { /* a unit is written once after an erase */
        if (flash->image[start + i] != 0xFF) {
            return -1;
        }
    }
    if (cut && !flash->torn) {
        host_flash_end();
    }
    memcpy(flash->image + start, octets, cut ? length / 2 : length);
    if (put(flash, start, length) != 0) {
        return -1;
    }
    if (cut) {
        host_flash_end();
    }
    return 0;
}

int host_flash_read(const host_flash *flash, int area, uint32_t at, uint8_t *out, size_t length)
{
    if (at + length > octets_of(area)) {
        return -1;
    }
    memcpy(out, flash->image + start_of(area) + at, length);
    return 0;
}
