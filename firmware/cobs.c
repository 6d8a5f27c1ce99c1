#include "cobs.h"

int32_t cobs_encode(const uint8_t *packet, int32_t size, uint8_t *out) {
    int32_t block = 0, written = 1; // `block` is where the open block's length byte belongs
    for (int32_t i = 0; i < size; i++) {
        if (packet[i] != 0)
            out[written++] = packet[i];
        int full = written - block == 255;
        if (packet[i] == 0 || (full && i + 1 < size)) {
            out[block] = (uint8_t)(written - block);
            block = written++;
        }
    }
    out[block] = (uint8_t)(written - block);
    return written;
}

int32_t cobs_decode(uint8_t *bytes, int32_t size) {
    int32_t read = 0, written = 0;
    while (read < size) {
        int32_t length = bytes[read++];
        if (length == 0 || read + length - 1 > size)
            return -1;
        for (int32_t i = 1; i < length; i++) {
            if (bytes[read] == 0)
                return -1;
            bytes[written++] = bytes[read++];
        }
        if (length < 255 && read < size)
            bytes[written++] = 0;
    }
    return size == 0 ? -1 : written;
}
