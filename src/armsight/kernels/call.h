/* The tables of compiled kernels that build.py writes and call.c reads. */

#ifndef ARMSIGHT_CALL_H
#define ARMSIGHT_CALL_H

#include <stdint.h>

/* Returns whether it failed. */
typedef int (*Entry)(const uint64_t *arguments, uint64_t *result);

typedef struct {
    const char *module, *name, *takes, *gives;
    Entry entry;
    int releases_lock;
} Signature;

/* The kernels compiled for a kind of processor. */
typedef struct {
    const char *processor;
    const Signature *signatures;
} Level;

extern const Level armsight_levels[]; /* the newest first */
extern const int armsight_level_count;
extern const int armsight_signature_count;

/* What was compiled: a module of Python and the digest of its text (decorator.py). */
typedef struct {
    const char *module, *digest;
} Source;

extern const Source armsight_sources[];
extern const int armsight_source_count;

#endif
