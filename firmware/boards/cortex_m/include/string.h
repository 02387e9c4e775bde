/* As much of string.h as the firmware has (memory.c), for MAVLink's headers. */
#ifndef ARMSIGHT_STRING_H
#define ARMSIGHT_STRING_H

#include <stddef.h>

void *memcpy(void *to, const void *from, size_t length);
void *memset(void *to, int value, size_t length);

/* Short ones of known length become a few instructions; without a C library compilers do that only by this name. */
#define memcpy __builtin_memcpy
#define memset __builtin_memset

#endif
