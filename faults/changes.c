/* Counts the changes of files below one folder by this process, and kills it at a chosen one.

   Loaded by LD_PRELOAD, so that changes by native libraries (HDF5, SQLite, COLMAP) are counted too. A process
   that it forks or starts is not armed. `faults_arm(folder, k)`: SIGKILL just before change k, never if k is 0.
*/
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

#define MOST_FILES 4096
static char root[PATH_MAX];
static size_t root_length;
static long kill_at;
static pid_t armed;
static atomic_long changes;
static _Atomic char written[MOST_FILES]; /* files below the folder that are open for writing */

void faults_arm(const char *folder, long at) {
    snprintf(root, sizeof root, "%s", folder);
    root_length = strlen(root);
    kill_at = at;
    changes = 0;
    memset((void *)written, 0, sizeof written);
    armed = getpid();
}

long faults_count(void) { return changes; }

static int is_armed(void) { return armed && armed == getpid(); }

static void change(void) {
    if (++changes == kill_at) kill(getpid(), SIGKILL);
}

static int is_below(int folder, const char *path) {
    if (!is_armed() || !path) return 0;
    if (path[0] == '/') return !strncmp(path, root, root_length);
    char link[64], name[PATH_MAX];
    if (folder == AT_FDCWD) snprintf(link, sizeof link, "/proc/self/cwd");
    else snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
    ssize_t length = readlink(link, name, sizeof name - 1);
    if (length < 0) return 0;
    name[length] = 0;
    return !strncmp(name, root, root_length);
}

static int opened(int file, int is_written) {
    if (file >= 0 && file < MOST_FILES) written[file] = (char)is_written;
    return file;
}

static int is_written(int file) {
    return file >= 0 && file < MOST_FILES && written[file] && is_armed();
}

#define NEXT(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

#define OPEN(name, folder, parameters, arguments)                                            \
    int name parameters {                                                                    \
        mode_t mode = 0;                                                                     \
        if (flags & (O_CREAT | __O_TMPFILE)) {                                               \
            va_list rest;                                                                    \
            va_start(rest, flags);                                                           \
            mode = va_arg(rest, mode_t);                                                     \
            va_end(rest);                                                                    \
        }                                                                                    \
        int writes = (flags & O_ACCMODE) != O_RDONLY && is_below(folder, path);              \
        if (writes && (flags & (O_CREAT | O_TRUNC))) change();                               \
        return opened(NEXT(name) arguments, writes);                                         \
    }
OPEN(open, AT_FDCWD, (const char *path, int flags, ...), (path, flags, mode))
OPEN(open64, AT_FDCWD, (const char *path, int flags, ...), (path, flags, mode))
OPEN(openat, folder, (int folder, const char *path, int flags, ...), (folder, path, flags, mode))
OPEN(openat64, folder, (int folder, const char *path, int flags, ...), (folder, path, flags, mode))

#define FOPEN(name)                                                                          \
    FILE *name(const char *path, const char *mode) {                                         \
        int writes = strpbrk(mode, "wa+") && is_below(AT_FDCWD, path);                       \
        if (writes) change();                                                                \
        FILE *file = NEXT(name)(path, mode);                                                 \
        if (file) opened(fileno(file), writes);                                              \
        return file;                                                                         \
    }
FOPEN(fopen)
FOPEN(fopen64)

int close(int file) {
    opened(file, 0);
    return NEXT(close)(file);
}

#define ON_FILE(type, name, parameters, arguments)                                           \
    type name parameters {                                                                   \
        if (is_written(file)) change();                                                      \
        return NEXT(name) arguments;                                                         \
    }
ON_FILE(ssize_t, write, (int file, const void *data, size_t size), (file, data, size))
ON_FILE(ssize_t, writev, (int file, const struct iovec *data, int count), (file, data, count))
ON_FILE(ssize_t, pwrite, (int file, const void *data, size_t size, off_t at), (file, data, size, at))
ON_FILE(ssize_t, pwrite64, (int file, const void *data, size_t size, off64_t at), (file, data, size, at))
ON_FILE(int, ftruncate, (int file, off_t size), (file, size))
ON_FILE(int, ftruncate64, (int file, off64_t size), (file, size))
ssize_t sendfile(int file, int from, off_t *at, size_t size);
ON_FILE(ssize_t, sendfile, (int file, int from, off_t *at, size_t size), (file, from, at, size))
ssize_t sendfile64(int file, int from, off64_t *at, size_t size);
ON_FILE(ssize_t, sendfile64, (int file, int from, off64_t *at, size_t size), (file, from, at, size))
ssize_t copy_file_range(int from, off64_t *at, int file, off64_t *to, size_t size, unsigned flags) {
    if (is_written(file)) change();
    return NEXT(copy_file_range)(from, at, file, to, size, flags);
}

#define ON_PATH(name, folder, path, parameters, arguments)                                   \
    int name parameters {                                                                    \
        if (is_below(folder, path)) change();                                                \
        return NEXT(name) arguments;                                                         \
    }
ON_PATH(rename, AT_FDCWD, to, (const char *from, const char *to), (from, to))
ON_PATH(renameat, b, to, (int a, const char *from, int b, const char *to), (a, from, b, to))
ON_PATH(unlink, AT_FDCWD, path, (const char *path), (path))
ON_PATH(unlinkat, a, path, (int a, const char *path, int flags), (a, path, flags))
ON_PATH(remove, AT_FDCWD, path, (const char *path), (path))
ON_PATH(rmdir, AT_FDCWD, path, (const char *path), (path))
ON_PATH(mkdir, AT_FDCWD, path, (const char *path, mode_t mode), (path, mode))
ON_PATH(mkdirat, a, path, (int a, const char *path, mode_t mode), (a, path, mode))
ON_PATH(link, AT_FDCWD, to, (const char *from, const char *to), (from, to))
ON_PATH(linkat, b, to, (int a, const char *from, int b, const char *to, int flags), (a, from, b, to, flags))
ON_PATH(symlink, AT_FDCWD, to, (const char *from, const char *to), (from, to))
ON_PATH(symlinkat, b, to, (const char *from, int b, const char *to), (from, b, to))
ON_PATH(truncate, AT_FDCWD, path, (const char *path, off_t size), (path, size))
