// CRC-32 of IEEE 802.3: finds line noise and records that were not written to their end. It proves
// nothing about who wrote them.
#ifndef HEADWAY_CRC_H
#define HEADWAY_CRC_H

#include <stdint.h>

#define CRC_BYTES 4

uint32_t crc_of(const uint8_t *bytes, int32_t size);

#endif
