/* A disk that fails or hangs, for whoever has this preloaded: writing below the folder $BAD_DISK does what the
   file $BAD_DISK_HOW says, anew each time: nothing, an error's number, or "hang" until it says otherwise. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

static int how(void)
{
    char said[32] = "";
    const char *path = getenv("BAD_DISK_HOW");
    int fd = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
    if (fd < 0)
        return 0;
    ssize_t n = read(fd, said, sizeof said - 1);
    close(fd);
    return n <= 0 ? 0 : strncmp(said, "hang", 4) == 0 ? -1 : atoi(said);
}

static int is_there(int fd)
{
    char link[64], path[4096];
    const char *folder = getenv("BAD_DISK");
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    return folder && n > 0 && (size_t)n > strlen(folder) && memcmp(path, folder, strlen(folder)) == 0;
}

/* Whether the call fails; errno is set then. */
static int fails(int fd)
{
    int before = errno, found = is_there(fd) ? how() : 0;
    while (found < 0) {
        nanosleep(&(struct timespec){0, 20000000}, NULL);
        found = how();
    }
    errno = found ? found : before;
    return found != 0;
}

#define WITH(kind, name, declared, given) \
    kind name declared \
    { \
        static kind (*real) declared; \
        if (fails(fd)) \
            return -1; \
        if (!real) \
            real = (kind (*) declared)dlsym(RTLD_NEXT, #name); \
        return real given; \
    }

WITH(ssize_t, write, (int fd, const void *data, size_t n), (fd, data, n))
WITH(ssize_t, pwrite, (int fd, const void *data, size_t n, off_t at), (fd, data, n, at))
WITH(ssize_t, pwrite64, (int fd, const void *data, size_t n, off64_t at), (fd, data, n, at))
WITH(int, ftruncate, (int fd, off_t size), (fd, size))
WITH(int, ftruncate64, (int fd, off64_t size), (fd, size))
WITH(int, fsync, (int fd), (fd))
WITH(int, fdatasync, (int fd), (fd))
