/* Semihosting: what QEMU does for the firmware (Arm, "Semihosting for AArch32 and AArch64"). Main loop; no emulated
 * time passes. */
#ifndef ARMSIGHT_SEMIHOST_H
#define ARMSIGHT_SEMIHOST_H

#include <stdbool.h>
#include <stdint.h>

/* Open a file of the computer QEMU runs on, to read or to write; returns its handle, below 0 where it cannot be
 * opened. */
int32_t semihost_open(const char *path, bool writing);

/* Read or write length bytes, waiting for them; returns whether all came or went. */
bool semihost_read(int32_t handle, void *bytes, uint32_t length);
bool semihost_write(int32_t handle, const void *bytes, uint32_t length);

/* End the emulation: well, or not. Does not return. */
void semihost_exit(bool well);

#endif
