#include "reading.h"

void readings_push(struct readings *readings, int64_t time_us, int32_t value, uint8_t trigger) {
    if (readings->taken - readings->kept == READINGS) {
        readings->kept++;
        readings->lost++;
    }
    struct reading *reading = &readings->ring[readings->taken++ % READINGS];
    reading->time_us = time_us;
    reading->value = value;
    reading->trigger = trigger;
}

void readings_seen(struct readings *readings, uint32_t number) {
    if (number - readings->kept <= readings->taken - readings->kept)
        readings->kept = number;
}
