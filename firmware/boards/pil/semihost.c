#include "semihost.h"

#define SYS_OPEN 0x01u
#define SYS_WRITE 0x05u
#define SYS_READ 0x06u
#define SYS_EXIT 0x18u
#define OPEN_READ 1u  /* "rb" */
#define OPEN_WRITE 5u /* "wb" */
#define EXIT_WELL 0x20026u
#define EXIT_ERROR 0x20023u

static uint32_t call(uint32_t operation, uintptr_t argument)
{
    register uint32_t r0 __asm__("r0") = operation;
    register uintptr_t r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

int32_t semihost_open(const char *path, bool writing)
{
    uint32_t length = 0u;
    while (path[length] != '\0') {
        length++;
    }
    const uintptr_t block[] = {(uintptr_t)path, writing ? OPEN_WRITE : OPEN_READ, length};
    return (int32_t)call(SYS_OPEN, (uintptr_t)block);
}

/* Both calls return the number of bytes that are still missing: all of them at the end of a file. */
static bool transfer(uint32_t operation, int32_t handle, uintptr_t bytes, uint32_t length)
{
    while (length != 0u) {
        const uintptr_t block[] = {(uintptr_t)handle, bytes, length};
        const uint32_t missing = call(operation, (uintptr_t)block);
        if (missing >= length) {
            return false;
        }
        bytes += length - missing;
        length = missing;
    }
    return true;
}

bool semihost_read(int32_t handle, void *bytes, uint32_t length)
{
    return transfer(SYS_READ, handle, (uintptr_t)bytes, length);
}

bool semihost_write(int32_t handle, const void *bytes, uint32_t length)
{
    return transfer(SYS_WRITE, handle, (uintptr_t)bytes, length);
}

void semihost_exit(bool well)
{
    for (;;) {
        call(SYS_EXIT, well ? EXIT_WELL : EXIT_ERROR);
    }
}
