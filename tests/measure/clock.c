/* The system's clock, set for one program alone (LD_PRELOAD): CLOCK_OFFSET names a file with an int64 of nanoseconds. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static volatile int64_t *offset;

__attribute__((constructor)) static void begin(void)
{
	const char *path = getenv("CLOCK_OFFSET");
	int fd = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
	if (fd < 0)
		return;
	void *map = mmap(NULL, sizeof *offset, PROT_READ, MAP_SHARED, fd, 0);
	offset = map == MAP_FAILED ? NULL : map;
	close(fd);
}

int clock_gettime(clockid_t which, struct timespec *to)
{
	int done = (int)syscall(SYS_clock_gettime, which, to);
	if (done == 0 && which == CLOCK_REALTIME && offset) {
		int64_t at = (int64_t)to->tv_sec * 1000000000 + to->tv_nsec + *offset;
		to->tv_sec = at / 1000000000;
		to->tv_nsec = at % 1000000000;
	}
	return done;
}
