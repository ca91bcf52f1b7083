/* Stands between a process and the C library's file calls on what lies below one folder: counts them, makes the
   N-th fail, ends the process in its place, or writes all of them down. Loaded with LD_PRELOAD and steered through
   shim_arm and its sisters; everything else, and every other path, passes through untouched.

   One lock is held through each call that is watched, so that what is written down is in the order in which it
   happened: a write is durable exactly when it stands before the sync. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

enum mode { OFF, COUNT, FAIL, CRASH, TEAR, LOG };
enum class { WRITES = 1, LOOKS = 2, READS = 4, TEARABLE = 8 };
enum verdict { GO_ON, REFUSED, HALVED, TORN };

static char root[4096];
static size_t root_length;
static enum mode mode = OFF;
static int watched, error_given, log_file = -1;
static long first, last, counted, halved_file = -1;
static char hit[4400];
static useconds_t slowness;
static pthread_mutex_t lock = PTHREAD_RECURSIVE_MUTEX_INITIALIZER_NP;

#define REAL(name) ((__typeof__(&name))real(#name))

static void *real(const char *name) {
    void *found = dlsym(RTLD_NEXT, name);
    if (found == NULL) abort();
    return found;
}

/* Fail (or end at, or tear) the calls numbered first to last of the classes in `what`; 0 for none. LOG writes down the
   others, too. */
void shim_arm(const char *folder, int how, int what, long from, long to, int number) {
    pthread_mutex_lock(&lock);
    snprintf(root, sizeof root, "%s", folder);
    root_length = strlen(root);
    mode = how, watched = what, first = from, last = to, error_given = number;
    counted = 0, halved_file = -1, hit[0] = 0;
    pthread_mutex_unlock(&lock);
}

/* Let each sync, of any file, take so many microseconds more. */
void shim_slow(unsigned microseconds) { slowness = microseconds; }

long shim_count(void) { return counted; }

const char *shim_hit(void) { return hit; }

static int inside(const char *path) {
    return mode != OFF && strncmp(path, root, root_length) == 0 && (path[root_length] == '/' || path[root_length] == 0);
}

/* The absolute path of a descriptor, or of a path below a folder's descriptor. */
static int path_of(int file, char *path) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, 4095);
    if (length < 0) return 0;
    path[length] = 0;
    return 1;
}

static const char *absolute(int folder, const char *path, char *space) {
    if (path[0] == '/') return path;
    if (folder == AT_FDCWD ? getcwd(space, 4096) == NULL : !path_of(folder, space)) return path;
    size_t length = strlen(space);
    snprintf(space + length, 8192 - length, "/%s", path);
    return space;
}

static enum verdict judge(const char *call, int what, const char *path, long file, size_t length) {
    int tears = (what & TEARABLE) && length > 1;
    if (!(what & watched) || (mode == TEAR && !tears)) return GO_ON;
    if (halved_file >= 0 && halved_file == file && tears) {
        halved_file = -1;
        errno = error_given;
        return REFUSED;
    }
    long number = ++counted;
    if (mode == COUNT || number < first || number > last) return GO_ON;
    snprintf(hit, sizeof hit, "%s %s", call, path);
    if (mode == CRASH) kill(getpid(), SIGKILL);
    if (mode == TEAR) return TORN;
    if (error_given == ENOSPC && tears) {
        halved_file = file; /* as a full disk does it: a part is written, and the next call fails */
        return HALVED;
    }
    errno = error_given;
    return REFUSED;
}

/* The log: a line "kind inode offset length path-length", then the path and the bytes. */
int shim_log(const char *path) {
    log_file = path == NULL ? -1 : (int)syscall(SYS_open, path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
    return log_file;
}

static void put(const void *bytes, size_t length) {
    while (length > 0) {
        ssize_t done = syscall(SYS_write, log_file, bytes, length);
        if (done <= 0) abort();
        bytes = (const char *)bytes + done, length -= (size_t)done;
    }
}

static void note(char kind, uint64_t inode, int64_t offset, const char *path, const void *bytes, size_t length) {
    if (mode != LOG || log_file < 0) return;
    int before = errno;
    char head[128];
    size_t path_length = strlen(path);
    put(head, (size_t)snprintf(head, sizeof head, "%c %llu %lld %zu %zu\n", kind, (unsigned long long)inode,
                               (long long)offset, length, path_length));
    put(path, path_length);
    put(bytes, length);
    errno = before;
}

void shim_mark(const char *text) {
    pthread_mutex_lock(&lock);
    note('M', 0, 0, text, "", 0);
    pthread_mutex_unlock(&lock);
}

static uint64_t inode_of(int file, int *folder) {
    struct stat found;
    if (fstat(file, &found) != 0) return 0;
    if (folder != NULL) *folder = S_ISDIR(found.st_mode);
    return found.st_ino;
}

/* Opening. */
static int opened(const char *call, int (*open_it)(int, const char *, int, mode_t), int folder, const char *path,
                  int flags, mode_t rights) {
    char space[8192];
    const char *whole = mode == OFF ? path : absolute(folder, path, space);
    if (mode == OFF || !inside(whole)) return open_it(folder, path, flags, rights);
    pthread_mutex_lock(&lock);
    struct stat found;
    int there = stat(whole, &found) == 0, result = -1;
    int writes = (flags & O_ACCMODE) != O_RDONLY || (flags & (O_CREAT | O_TRUNC));
    if (judge(call, writes ? WRITES : LOOKS, whole, -1, 0) == GO_ON) {
        result = open_it(folder, path, flags, rights);
        if (result >= 0 && !there && (flags & O_CREAT)) note('C', inode_of(result, NULL), 0, whole, "", 0);
        if (result >= 0 && there && (flags & O_TRUNC)) note('T', inode_of(result, NULL), 0, whole, "", 0);
    }
    pthread_mutex_unlock(&lock);
    return result;
}

static int by_openat(int folder, const char *path, int flags, mode_t rights) {
    return REAL(openat)(folder, path, flags, rights);
}

static mode_t rights_of(int flags, va_list more) { return flags & (O_CREAT | O_TMPFILE) ? va_arg(more, mode_t) : 0; }

#define OPEN(name)                                                           \
    int name(const char *path, int flags, ...) {                             \
        va_list more;                                                        \
        va_start(more, flags);                                               \
        mode_t rights = rights_of(flags, more);                              \
        va_end(more);                                                        \
        return opened("open", by_openat, AT_FDCWD, path, flags, rights);     \
    }
#define OPENAT(name)                                                         \
    int name(int folder, const char *path, int flags, ...) {                 \
        va_list more;                                                        \
        va_start(more, flags);                                               \
        mode_t rights = rights_of(flags, more);                              \
        va_end(more);                                                        \
        return opened("open", by_openat, folder, path, flags, rights);       \
    }
OPEN(open)
OPEN(open64)
/* REAL(openat) must not find ourselves: RTLD_NEXT looks behind this library. */
OPENAT(openat)
OPENAT(openat64)
int __open_2(const char *path, int flags) { return opened("open", by_openat, AT_FDCWD, path, flags, 0); }
int __open64_2(const char *path, int flags) { return opened("open", by_openat, AT_FDCWD, path, flags, 0); }
int creat(const char *path, mode_t rights) {
    return opened("open", by_openat, AT_FDCWD, path, O_CREAT | O_WRONLY | O_TRUNC, rights);
}
int creat64(const char *path, mode_t rights) { return creat(path, rights); }

/* Writing and reading. at < 0: where the file stands. */
static ssize_t moved(const char *call, int what, int file, void *bytes, size_t length, off_t at) {
    char path[4200];
    int is_write = what & WRITES;
    ssize_t result = -1;
#define DO(n)                                                                                                    \
    (is_write ? (at < 0 ? REAL(write)(file, bytes, (n)) : REAL(pwrite)(file, bytes, (n), at))                    \
              : (at < 0 ? REAL(read)(file, bytes, (n)) : REAL(pread)(file, bytes, (n), at)))
    if (mode == OFF || file == log_file || !path_of(file, path) || !inside(path)) return DO(length);
    pthread_mutex_lock(&lock);
    off_t from = at;
    if (at < 0) {
        from = lseek(file, 0, REAL(fcntl)(file, F_GETFL) & O_APPEND ? SEEK_END : SEEK_CUR);
    }
    enum verdict verdict = judge(call, what, path, file, length);
    if (verdict == GO_ON) result = DO(length);
    if (verdict == HALVED || verdict == TORN) result = DO(length / 2);
    if (verdict == TORN) kill(getpid(), SIGKILL);
    if (result > 0 && is_write) note('W', inode_of(file, NULL), from, path, bytes, (size_t)result);
    pthread_mutex_unlock(&lock);
    return result;
#undef DO
}

#define UNCONST(bytes) ((void *)(uintptr_t)(bytes))
ssize_t write(int file, const void *bytes, size_t length) {
    return moved("write", WRITES | TEARABLE, file, UNCONST(bytes), length, -1);
}
ssize_t pwrite(int file, const void *bytes, size_t length, off_t at) {
    return moved("write", WRITES | TEARABLE, file, UNCONST(bytes), length, at);
}
ssize_t pwrite64(int file, const void *bytes, size_t length, off_t at) { return pwrite(file, bytes, length, at); }
ssize_t read(int file, void *bytes, size_t length) { return moved("read", READS, file, bytes, length, -1); }
ssize_t pread(int file, void *bytes, size_t length, off_t at) { return moved("read", READS, file, bytes, length, at); }
ssize_t pread64(int file, void *bytes, size_t length, off_t at) { return pread(file, bytes, length, at); }

/* Calls that would pass by unseen: nothing here makes them, and it must be noticed if that changes. */
#define UNSEEN(file)                                                             \
    char path[4200];                                                             \
    if (mode != OFF && path_of(file, path) && inside(path)) abort();
ssize_t writev(int file, const struct iovec *parts, int count) {
    UNSEEN(file)
    return REAL(writev)(file, parts, count);
}
ssize_t pwritev(int file, const struct iovec *parts, int count, off_t at) {
    UNSEEN(file)
    return REAL(pwritev)(file, parts, count, at);
}
ssize_t copy_file_range(int from, off64_t *at, int file, off64_t *to, size_t length, unsigned flags) {
    UNSEEN(file)
    return REAL(copy_file_range)(from, at, file, to, length, flags);
}
int fallocate(int file, int how, off_t at, off_t length) {
    UNSEEN(file)
    return REAL(fallocate)(file, how, at, length);
}
int posix_fallocate(int file, off_t at, off_t length) {
    UNSEEN(file)
    return REAL(posix_fallocate)(file, at, length);
}

/* Calls on one descriptor. */
#define ON_FILE(result_of, call, kind, offset)                                                                  \
    char path[4200];                                                                                            \
    if (mode == OFF || !path_of(file, path) || !inside(path)) return result_of;                                 \
    pthread_mutex_lock(&lock);                                                                                  \
    int result = -1, folder = 0;                                                                                \
    uint64_t inode = inode_of(file, &folder);                                                                   \
    if (judge(call, WRITES, path, file, 0) == GO_ON && (result = result_of) == 0)                               \
        note(folder ? 'F' : kind, inode, offset, path, "", 0);                                                  \
    pthread_mutex_unlock(&lock);                                                                                \
    return result;
static int slowed(int result) {
    if (slowness > 0) usleep(slowness);
    return result;
}
int fsync(int file) { ON_FILE(slowed(REAL(fsync)(file)), "fsync", 'S', 0) }
int fdatasync(int file) { ON_FILE(slowed(REAL(fdatasync)(file)), "fdatasync", 'S', 0) }
int ftruncate(int file, off_t length) { ON_FILE(REAL(ftruncate)(file, length), "ftruncate", 'T', length) }
int ftruncate64(int file, off_t length) { return ftruncate(file, length); }

/* Calls on names. */
#define ON_NAME(folder, name, result_of, call, kind)                                                            \
    char space[8192];                                                                                           \
    const char *whole = mode == OFF ? name : absolute(folder, name, space);                                     \
    if (mode == OFF || !inside(whole)) return result_of;                                                        \
    pthread_mutex_lock(&lock);                                                                                  \
    int result = -1;                                                                                            \
    if (judge(call, WRITES, whole, -1, 0) == GO_ON && (result = result_of) == 0) note(kind, 0, 0, whole, "", 0); \
    pthread_mutex_unlock(&lock);                                                                                \
    return result;
int unlink(const char *path) { ON_NAME(AT_FDCWD, path, REAL(unlink)(path), "unlink", 'U') }
int rmdir(const char *path) { ON_NAME(AT_FDCWD, path, REAL(rmdir)(path), "rmdir", 'X') }
int unlinkat(int folder, const char *path, int flags) {
    int is_folder = flags & AT_REMOVEDIR;
    ON_NAME(folder, path, REAL(unlinkat)(folder, path, flags), is_folder ? "rmdir" : "unlink", is_folder ? 'X' : 'U')
}
int mkdir(const char *path, mode_t rights) { ON_NAME(AT_FDCWD, path, REAL(mkdir)(path, rights), "mkdir", 'D') }
int mkdirat(int folder, const char *path, mode_t rights) {
    ON_NAME(folder, path, REAL(mkdirat)(folder, path, rights), "mkdir", 'D')
}

/* The new name is written down in the place of bytes. */
#define ON_TWO(folder, name, other_folder, other, result_of, call, kind)                                        \
    char space[8192], other_space[8192];                                                                        \
    const char *whole = mode == OFF ? name : absolute(folder, name, space);                                     \
    const char *goal = mode == OFF ? other : absolute(other_folder, other, other_space);                        \
    if (mode == OFF || !inside(whole)) return result_of;                                                        \
    pthread_mutex_lock(&lock);                                                                                  \
    int result = -1;                                                                                            \
    if (judge(call, WRITES, whole, -1, 0) == GO_ON && (result = result_of) == 0)                                \
        note(kind, 0, 0, whole, goal, strlen(goal));                                                            \
    pthread_mutex_unlock(&lock);                                                                                \
    return result;
int rename(const char *from, const char *to) {
    ON_TWO(AT_FDCWD, from, AT_FDCWD, to, REAL(rename)(from, to), "rename", 'R')
}
int renameat(int folder, const char *from, int other, const char *to) {
    ON_TWO(folder, from, other, to, REAL(renameat)(folder, from, other, to), "rename", 'R')
}
int link(const char *from, const char *to) {
    ON_TWO(AT_FDCWD, from, AT_FDCWD, to, REAL(link)(from, to), "link", 'L')
}
