/* Before main: memory as C wants it. */
#ifndef ARMSIGHT_MEMORY_H
#define ARMSIGHT_MEMORY_H

/* Copy .data to its address and clear .bss (sections.ld). Once, right after reset; no variable is good before it. */
void memory_start(void);

#endif
