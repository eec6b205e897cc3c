/* A disk that is watched, and that can fail: preloaded into a process, it stands between it and the C library.

   From a call of disk_watch on, every call that changes a file or a directory below a root is an event, numbered from 1.
   Build: cc -shared -fPIC -o disk.so disk.c -ldl */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

static char root[PATH_MAX];
static int log_fd = -1;
static long number, fail_first, fail_last, kill_at;
static int fail_errno;

/* Watch what is below `at`. `log`, if not empty, is a file that every event is appended to: a line
   "kind offset length path\tsecond path", then the bytes written. The events from `first` to `last` fail with `error`;
   before the event `kill_before` the process kills itself. */
void disk_watch(const char *at, const char *log, long first, long last, int error, long kill_before) {
    if (!realpath(at, root)) root[0] = 0;
    if (*log) log_fd = syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
    fail_first = first, fail_last = last, fail_errno = error, kill_at = kill_before;
}

static int is_below(const char *path) {
    size_t length = strlen(root);
    return length && !strncmp(path, root, length) && (path[length] == '/' || !path[length]);
}

/* The path of an open file or directory; empty if it has none. */
static void path_of(int fd, char *path) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, PATH_MAX - 1);
    path[length > 0 ? length : 0] = 0;
}

static void absolute(int folder, const char *name, char *path) {
    char base[PATH_MAX];
    if (name[0] == '/') {
        snprintf(path, PATH_MAX, "%s", name);
        return;
    }
    if (folder != AT_FDCWD) path_of(folder, base);
    else if (!getcwd(base, sizeof base)) base[0] = 0;
    snprintf(path, PATH_MAX, "%.2000s/%.2000s", base, name);
}

/* Whether this event is to fail. */
static int fails(const char *kind, const char *path, const char *second, long offset, const void *bytes, size_t length) {
    if (!is_below(path) || strstr(path, " (deleted)")) return 0;
    number++;
    if (number == kill_at) kill(getpid(), SIGKILL);
    if (number >= fail_first && number <= fail_last) {
        errno = fail_errno;
        return 1;
    }
    if (log_fd >= 0) {
        char line[2 * PATH_MAX + 100];
        int size = snprintf(line, sizeof line, "%s %ld %zu %s\t%s\n", kind, offset, bytes ? length : 0, path, second);
        syscall(SYS_write, log_fd, line, size);
        if (bytes) syscall(SYS_write, log_fd, bytes, length);
    }
    return 0;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static int fails_open(int folder, const char *name, int flags) {
    char path[PATH_MAX];
    absolute(folder, name, path);
    if (!(flags & (O_CREAT | O_TRUNC))) return 0;
    int exists = !faccessat(AT_FDCWD, path, F_OK, AT_SYMLINK_NOFOLLOW);
    if (!exists && (flags & O_CREAT)) return fails("create", path, "", 0, NULL, 0);
    return (flags & O_TRUNC) ? fails("truncate", path, "", 0, NULL, 0) : 0;
}

#define OPEN(name)                                                \
    int name(const char *path, int flags, ...) {                  \
        va_list rest;                                             \
        va_start(rest, flags);                                    \
        mode_t mode = va_arg(rest, mode_t);                       \
        va_end(rest);                                             \
        return fails_open(AT_FDCWD, path, flags) ? -1 : REAL(name)(path, flags, mode); \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                              \
    int name(int folder, const char *path, int flags, ...) {      \
        va_list rest;                                             \
        va_start(rest, flags);                                    \
        mode_t mode = va_arg(rest, mode_t);                       \
        va_end(rest);                                             \
        return fails_open(folder, path, flags) ? -1 : REAL(name)(folder, path, flags, mode); \
    }
OPENAT(openat)
OPENAT(openat64)

static int fails_write(int fd, long offset, const void *bytes, size_t length) {
    char path[PATH_MAX];
    struct stat status;
    path_of(fd, path);
    if (!is_below(path) || fstat(fd, &status) || !S_ISREG(status.st_mode)) return 0;
    if (offset < 0) offset = fcntl(fd, F_GETFL) & O_APPEND ? status.st_size : lseek(fd, 0, SEEK_CUR);
    return fails("write", path, "", offset, bytes, length);
}

ssize_t write(int fd, const void *bytes, size_t length) {
    return fails_write(fd, -1, bytes, length) ? -1 : REAL(write)(fd, bytes, length);
}

ssize_t pwrite(int fd, const void *bytes, size_t length, off_t offset) {
    return fails_write(fd, offset, bytes, length) ? -1 : REAL(pwrite)(fd, bytes, length, offset);
}

ssize_t pwrite64(int fd, const void *bytes, size_t length, off64_t offset) {
    return fails_write(fd, offset, bytes, length) ? -1 : REAL(pwrite64)(fd, bytes, length, offset);
}

ssize_t writev(int fd, const struct iovec *parts, int count) {
    char path[PATH_MAX];
    path_of(fd, path);
    if (!is_below(path)) return REAL(writev)(fd, parts, count);
    return write(fd, parts[0].iov_base, parts[0].iov_len); /* writing a part is allowed */
}

static int fails_sync(int fd) {
    char path[PATH_MAX];
    path_of(fd, path);
    return fails("sync", path, "", 0, NULL, 0);
}

int fsync(int fd) { return fails_sync(fd) ? -1 : REAL(fsync)(fd); }
int fdatasync(int fd) { return fails_sync(fd) ? -1 : REAL(fdatasync)(fd); }

static int fails_size(int fd, long size) {
    char path[PATH_MAX];
    path_of(fd, path);
    return fails("resize", path, "", size, NULL, 0);
}

int ftruncate(int fd, off_t size) { return fails_size(fd, size) ? -1 : REAL(ftruncate)(fd, size); }
int ftruncate64(int fd, off64_t size) { return fails_size(fd, size) ? -1 : REAL(ftruncate64)(fd, size); }

static int fails_at(const char *kind, int folder, const char *name) {
    char path[PATH_MAX];
    absolute(folder, name, path);
    return fails(kind, path, "", 0, NULL, 0);
}

int mkdir(const char *path, mode_t mode) {
    if (!faccessat(AT_FDCWD, path, F_OK, AT_SYMLINK_NOFOLLOW)) return REAL(mkdir)(path, mode);
    return fails_at("mkdir", AT_FDCWD, path) ? -1 : REAL(mkdir)(path, mode);
}
int unlink(const char *path) {
    if (faccessat(AT_FDCWD, path, F_OK, AT_SYMLINK_NOFOLLOW)) return REAL(unlink)(path);
    return fails_at("remove", AT_FDCWD, path) ? -1 : REAL(unlink)(path);
}
int rmdir(const char *path) { return fails_at("remove", AT_FDCWD, path) ? -1 : REAL(rmdir)(path); }
int unlinkat(int folder, const char *path, int flags) {
    return fails_at("remove", folder, path) ? -1 : REAL(unlinkat)(folder, path, flags);
}

static int fails_rename(int folder, const char *from, int other, const char *to) {
    char first[PATH_MAX], second[PATH_MAX];
    absolute(folder, from, first);
    absolute(other, to, second);
    return fails("rename", first, second, 0, NULL, 0);
}

int rename(const char *from, const char *to) {
    return fails_rename(AT_FDCWD, from, AT_FDCWD, to) ? -1 : REAL(rename)(from, to);
}
int renameat(int folder, const char *from, int other, const char *to) {
    return fails_rename(folder, from, other, to) ? -1 : REAL(renameat)(folder, from, other, to);
}
