#include "reading.h"
#include <stdbool.h>

void readings_push(struct readings *readings, int64_t time_us, int32_t value, uint8_t trigger) {
    if (readings->taken - readings->kept == READINGS) // the host sees that it is gone
        readings->kept++;
    struct reading *reading = &readings->ring[readings->taken++ % READINGS];
    reading->time_us = time_us;
    reading->value = value;
    reading->trigger = trigger;
}

void readings_seen(struct readings *readings, uint32_t number) {
    if (number == readings->kept || number - readings->kept > readings->taken - readings->kept)
        return;
    readings->kept = number;
    readings->waited = 0;
}

uint32_t readings_tell(struct readings *readings, uint32_t most, uint32_t *count) {
    bool passed = readings->told - readings->kept > readings->taken - readings->kept;
    bool waits = readings->told != readings->kept;
    if (passed || (waits && ++readings->waited > READINGS_PATIENCE)) {
        readings->told = readings->kept;
        readings->waited = 0;
    }
    uint32_t first = readings->told, left = readings->taken - first;
    *count = left < most ? left : most;
    readings->told += *count;
    return first;
}
