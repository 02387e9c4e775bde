/* The configuration: its ranges, the factory's values, and two stored copies with a CRC each. Any context but the tick:
 * the CRC of a copy takes long. */
#ifndef ARMSIGHT_CONFIG_H
#define ARMSIGHT_CONFIG_H

#include <stdbool.h>

#include "types.h"

#define CONFIG_MAGIC 0x31435341u /* "ASC1" as bytes in memory */
#define CONFIG_VERSION 6u        /* goes up whenever core_config changes its layout or meaning */

/* Return the CRC-32 (IEEE 802.3, as zlib's) of length bytes. */
uint32_t config_crc(const void *bytes, uint32_t length);

/* Return a CRC (0xFFFFFFFF at first, inverted at last) after length more bytes. Any context. */
uint32_t config_crc_on(uint32_t crc, const void *bytes, uint32_t length);

/* Fill in values that keep an unknown arm harmless: weak, slow, and with a fault that rejects enabling. */
void config_factory(core_config *config);

/* Return whether every value is in the range types.h names, and fits the others. */
bool config_is_valid(const core_config *config);

/* Make a copy to store: config with its serial number, version and CRC. */
void config_seal(config_copy *copy, const core_config *config, uint32_t serial);

/* Convert a good copy of version 5 into one of this version; any other stays as it is. */
void config_upgrade(config_copy *copy);

/* Take the newer of two stored copies, the older where the newer is broken, the factory's values where both are.
 * Returns CONFIG_NEWEST, CONFIG_OLDER (one copy is broken) or CONFIG_FACTORY. */
uint32_t config_load(core_config *config, const config_copy *first, const config_copy *second);

/* Return which copy (0 or 1) to write next, never the only good one, and the serial number to seal it with. */
uint32_t config_next(const config_copy *first, const config_copy *second, uint32_t *serial);

#endif
