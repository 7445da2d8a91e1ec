/* Cuts and failing disks for a program that does not know of them (LD_PRELOAD).
 *
 * Every change that the program makes below FAULT_ROOTS (colon-separated real paths) and every datagram that it sends is
 * counted: create, write, truncate, fsync, rename, link, unlink, mkdir, send. At number FAULT_AT the fault happens:
 *   FAULT_HOW=kill         the process gets SIGKILL before the call
 *   FAULT_HOW=torn         a write is done by half, then SIGKILL
 *   FAULT_HOW=ENOSPC, EIO, EROFS, EDQUOT   the call fails so; FAULT_STAYS=1: and every later one as well
 * FAULT_COUNT names a file of 8 octets that holds the count, also after SIGKILL.
 *
 * FAULT_SHADOW is a folder that holds the disk as it is at the last fsync: the content of a file changes there when the
 * file is fsynced, the entries of a folder when the folder is. FAULT_NOSYNC=1 is the control: no fsync reaches the shadow.
 */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static volatile uint64_t *count;
static uint64_t at;
static const char *how = "", *roots, *shadow;
static int stays, nosync, failing;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pid_t owner;

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static void key_of(const struct statx *s, char *to, size_t room)
{
	snprintf(to, room, "%llu-%lld-%u", (unsigned long long)s->stx_ino, (long long)s->stx_btime.tv_sec,
		 s->stx_btime.tv_nsec);
}

static int write_whole(const char *path, const void *octets, size_t size)
{
	char temporary[PATH_MAX];
	snprintf(temporary, sizeof temporary, "%s.%d.tmp", path, (int)syscall(SYS_gettid));
	int fd = (int)syscall(SYS_openat, AT_FDCWD, temporary, O_WRONLY | O_CREAT | O_TRUNC, 0600);
	if (fd < 0)
		return -1;
	size_t done = 0;
	while (done < size) {
		ssize_t n = syscall(SYS_write, fd, (const char *)octets + done, size - done);
		if (n <= 0)
			break;
		done += (size_t)n;
	}
	syscall(SYS_close, fd);
	return (int)syscall(SYS_rename, temporary, path);
}

/* The content of one file, or the entries of one folder, as they are now, into the shadow. */
static void remember(const char *path)
{
	struct statx s;
	char key[96], to[PATH_MAX];
	if (!shadow || statx(AT_FDCWD, path, AT_SYMLINK_NOFOLLOW, STATX_BASIC_STATS | STATX_BTIME, &s))
		return;
	key_of(&s, key, sizeof key);
	if (S_ISDIR(s.stx_mode)) {
		DIR *folder = opendir(path);
		size_t room = 1 << 20, used = 0;
		char *list = malloc(room);
		if (!folder || !list)
			return;
		for (struct dirent *entry; (entry = readdir(folder));) {
			char child[PATH_MAX], name[96];
			struct statx t;
			if (!strcmp(entry->d_name, ".") || !strcmp(entry->d_name, ".."))
				continue;
			snprintf(child, sizeof child, "%s/%s", path, entry->d_name);
			if (statx(AT_FDCWD, child, AT_SYMLINK_NOFOLLOW, STATX_BASIC_STATS | STATX_BTIME, &t))
				continue;
			key_of(&t, name, sizeof name);
			used += (size_t)snprintf(list + used, room - used, "%s\t%c\t%o\t%s\n", name,
						 S_ISDIR(t.stx_mode) ? 'd' : S_ISREG(t.stx_mode) ? 'f' : 'o',
						 t.stx_mode & 07777, entry->d_name);
		}
		closedir(folder);
		snprintf(to, sizeof to, "%s/d%s", shadow, key);
		write_whole(to, list, used);
		free(list);
	} else if (S_ISREG(s.stx_mode)) {
		int fd = (int)syscall(SYS_openat, AT_FDCWD, path, O_RDONLY);
		char *octets = malloc(s.stx_size + 1);
		size_t done = 0;
		while (fd >= 0 && octets && done < s.stx_size) {
			ssize_t n = syscall(SYS_read, fd, octets + done, s.stx_size - done);
			if (n <= 0)
				break;
			done += (size_t)n;
		}
		if (fd >= 0)
			syscall(SYS_close, fd);
		snprintf(to, sizeof to, "%s/f%s", shadow, key);
		write_whole(to, octets, done);
		free(octets);
	}
}

/* What stands on the disk at the start is durable. */
static void remember_all(const char *path)
{
	struct stat s;
	if (lstat(path, &s))
		return;
	remember(path);
	if (!S_ISDIR(s.st_mode))
		return;
	DIR *folder = opendir(path);
	if (!folder)
		return;
	for (struct dirent *entry; (entry = readdir(folder));) {
		char child[PATH_MAX];
		if (!strcmp(entry->d_name, ".") || !strcmp(entry->d_name, ".."))
			continue;
		snprintf(child, sizeof child, "%s/%s", path, entry->d_name);
		remember_all(child);
	}
	closedir(folder);
}

/* At the start of a process; a fork that is a trial of its own calls it again when its environment stands. */
__attribute__((constructor)) void faults_begin(void)
{
	roots = getenv("FAULT_ROOTS");
	if (!roots)
		return;
	owner = getpid();
	failing = 0;
	at = strtoull(getenv("FAULT_AT") ? getenv("FAULT_AT") : "0", NULL, 10);
	how = getenv("FAULT_HOW") ? getenv("FAULT_HOW") : "kill";
	stays = getenv("FAULT_STAYS") != NULL;
	nosync = getenv("FAULT_NOSYNC") != NULL;
	shadow = getenv("FAULT_SHADOW");
	static uint64_t local;
	count = &local;
	const char *file = getenv("FAULT_COUNT");
	if (file) {
		int fd = (int)syscall(SYS_openat, AT_FDCWD, file, O_RDWR | O_CREAT, 0600);
		if (fd >= 0 && !syscall(SYS_ftruncate, fd, 8)) {
			void *map = mmap(NULL, 8, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
			if (map != MAP_FAILED)
				count = map;
		}
		if (fd >= 0)
			syscall(SYS_close, fd);
	}
	*count = 0;
	if (shadow) {
		char seeded[PATH_MAX], copy[PATH_MAX * 4], *rest = copy;
		snprintf(seeded, sizeof seeded, "%s/seeded", shadow);
		if (access(seeded, F_OK)) {
			snprintf(copy, sizeof copy, "%s", roots);
			for (char *one; (one = strsep(&rest, ":"));)
				if (*one)
					remember_all(one);
			char list[PATH_MAX * 4] = "";
			size_t used = 0;
			snprintf(copy, sizeof copy, "%s", roots);
			rest = copy;
			for (char *one; (one = strsep(&rest, ":"));) {
				struct statx s;
				char key[96];
				if (!*one || statx(AT_FDCWD, one, 0, STATX_BASIC_STATS | STATX_BTIME, &s))
					continue;
				key_of(&s, key, sizeof key);
				used += (size_t)snprintf(list + used, sizeof list - used, "%s\t%s\n", key, one);
			}
			snprintf(copy, sizeof copy, "%s/roots", shadow);
			write_whole(copy, list, used);
			write_whole(seeded, "", 0);
		}
	}
}

static int below(const char *path)
{
	for (const char *one = roots; one && *one;) {
		size_t length = strcspn(one, ":");
		if (length && !strncmp(path, one, length) && (path[length] == '/' || !path[length]))
			return 1;
		one += length + (one[length] == ':');
	}
	return 0;
}

static int fd_path(int fd, char *to)
{
	char link[64];
	snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
	ssize_t n = readlink(link, to, PATH_MAX - 1);
	if (n <= 0)
		return 0;
	to[n] = 0;
	return below(to);
}

static int path_below(int dir, const char *path)
{
	char whole[2 * PATH_MAX], folder[PATH_MAX];
	if (!path)
		return 0;
	if (path[0] == '/')
		return below(path);
	if (dir == AT_FDCWD) {
		if (!getcwd(folder, sizeof folder))
			return 0;
	} else {
		char link[64];
		snprintf(link, sizeof link, "/proc/self/fd/%d", dir);
		ssize_t n = readlink(link, folder, sizeof folder - 1);
		if (n <= 0)
			return 0;
		folder[n] = 0;
	}
	snprintf(whole, sizeof whole, "%s/%s", folder, path);
	return below(whole);
}

/* Count one change; 0 lets it happen, else errno to fail with. ``half``: the caller may tear it before the kill. */
static int fault(int *tear)
{
	if (!count || getpid() != owner)
		return 0;
	pthread_mutex_lock(&lock);
	uint64_t number = ++*count;
	int hit = at && (number == at || (failing && stays));
	pthread_mutex_unlock(&lock);
	if (!hit)
		return 0;
	if (!strcmp(how, "torn") && tear) {
		*tear = 1;
		return 0;
	}
	if (!strcmp(how, "kill") || !strcmp(how, "torn")) {
		kill(getpid(), SIGKILL);
		for (;;)
			pause();
	}
	failing = 1;
	return !strcmp(how, "ENOSPC") ? ENOSPC : !strcmp(how, "EROFS") ? EROFS : !strcmp(how, "EDQUOT") ? EDQUOT : EIO;
}

#define MAY(condition)                     \
	do {                               \
		if (roots && (condition)) { \
			int e = fault(NULL); \
			if (e) {           \
				errno = e; \
				return -1; \
			}                  \
		}                          \
	} while (0)

__attribute__((noreturn)) static void torn(int fd, const void *octets, size_t size, off_t offset, int with_offset)
{
	if (with_offset)
		syscall(SYS_pwrite64, fd, octets, size / 2, offset);
	else
		syscall(SYS_write, fd, octets, size / 2);
	kill(getpid(), SIGKILL);
	for (;;)
		pause();
}

ssize_t write(int fd, const void *octets, size_t size)
{
	char path[PATH_MAX];
	if (roots && fd > 2 && fd_path(fd, path)) {
		int tear = 0, e = fault(&tear);
		if (tear)
			torn(fd, octets, size, 0, 0);
		if (e) {
			errno = e;
			return -1;
		}
	}
	return REAL(write)(fd, octets, size);
}

#define PWRITE(name, type)                                                           \
	ssize_t name(int fd, const void *octets, size_t size, type offset)           \
	{                                                                            \
		char path[PATH_MAX];                                                 \
		if (roots && fd_path(fd, path)) {                                    \
			int tear = 0, e = fault(&tear);                              \
			if (tear)                                                    \
				torn(fd, octets, size, (off_t)offset, 1);            \
			if (e) {                                                     \
				errno = e;                                           \
				return -1;                                           \
			}                                                            \
		}                                                                    \
		return REAL(name)(fd, octets, size, offset);                         \
	}
PWRITE(pwrite, off_t)
PWRITE(pwrite64, off64_t)

static int sync_of(int fd, int (*real)(int))
{
	char path[PATH_MAX];
	if (!roots || !fd_path(fd, path))
		return real(fd);
	int e = fault(NULL);
	if (e) {
		errno = e;
		return -1;
	}
	int result = shadow ? 0 : real(fd); /* with a shadow the real disk does not matter */
	if (!result && shadow && !nosync) {
		pthread_mutex_lock(&lock);
		remember(path);
		pthread_mutex_unlock(&lock);
	}
	return result;
}
int fsync(int fd) { return sync_of(fd, REAL(fsync)); }
int fdatasync(int fd) { return sync_of(fd, REAL(fdatasync)); }

int ftruncate(int fd, off_t size)
{
	char path[PATH_MAX];
	MAY(fd_path(fd, path));
	return REAL(ftruncate)(fd, size);
}
int ftruncate64(int fd, off64_t size)
{
	char path[PATH_MAX];
	MAY(fd_path(fd, path));
	return REAL(ftruncate64)(fd, size);
}
int rename(const char *from, const char *to)
{
	MAY(path_below(AT_FDCWD, to));
	return REAL(rename)(from, to);
}
int renameat(int a, const char *from, int b, const char *to)
{
	MAY(path_below(b, to));
	return REAL(renameat)(a, from, b, to);
}
int link(const char *from, const char *to)
{
	MAY(path_below(AT_FDCWD, to));
	return REAL(link)(from, to);
}
int linkat(int a, const char *from, int b, const char *to, int flags)
{
	MAY(path_below(b, to));
	return REAL(linkat)(a, from, b, to, flags);
}
int unlink(const char *path)
{
	MAY(path_below(AT_FDCWD, path));
	return REAL(unlink)(path);
}
int unlinkat(int dir, const char *path, int flags)
{
	MAY(path_below(dir, path));
	return REAL(unlinkat)(dir, path, flags);
}
int mkdir(const char *path, mode_t mode)
{
	MAY(path_below(AT_FDCWD, path));
	return REAL(mkdir)(path, mode);
}

#define OPEN(name, call)                                                                         \
	int name(const char *path, int flags, ...)                                               \
	{                                                                                        \
		mode_t mode = 0;                                                                 \
		if (flags & (O_CREAT | O_TMPFILE)) {                                             \
			va_list more;                                                            \
			va_start(more, flags);                                                   \
			mode = va_arg(more, mode_t);                                             \
			va_end(more);                                                            \
			MAY(path_below(AT_FDCWD, path) && ((flags & O_EXCL) || access(path, F_OK))); \
		}                                                                                \
		return REAL(name)(path, flags, mode);                                            \
	}
OPEN(open, open)
OPEN(open64, open64)
int openat(int dir, const char *path, int flags, ...)
{
	mode_t mode = 0;
	if (flags & (O_CREAT | O_TMPFILE)) {
		va_list more;
		va_start(more, flags);
		mode = va_arg(more, mode_t);
		va_end(more);
		MAY(path_below(dir, path) && ((flags & O_EXCL) || faccessat(dir, path, F_OK, 0)));
	}
	return REAL(openat)(dir, path, flags, mode);
}

static int inet(int fd)
{
	int domain = 0;
	socklen_t size = sizeof domain;
	return !getsockopt(fd, SOL_SOCKET, SO_DOMAIN, &domain, &size) && domain == AF_INET;
}
/* A datagram is sent or it is lost with the process: an error of the disk does not touch it. */
static void sending(int fd)
{
	if (roots && inet(fd) && (!strcmp(how, "kill") || !strcmp(how, "torn")))
		fault(NULL);
}
ssize_t sendto(int fd, const void *octets, size_t size, int flags, const struct sockaddr *to, socklen_t length)
{
	sending(fd);
	return REAL(sendto)(fd, octets, size, flags, to, length);
}
ssize_t send(int fd, const void *octets, size_t size, int flags)
{
	sending(fd);
	return REAL(send)(fd, octets, size, flags);
}
ssize_t sendmsg(int fd, const struct msghdr *message, int flags)
{
	sending(fd);
	return REAL(sendmsg)(fd, message, flags);
}
