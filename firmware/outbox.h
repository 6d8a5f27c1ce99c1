// What leaves a device.
#ifndef HEADWAY_OUTBOX_H
#define HEADWAY_OUTBOX_H

#include "device.h"

// Seals a frame, whose payload is in place and of so many bytes, and sends it. Nothing leaves where
// there is no session.
void outbox_send(struct device *device, struct board *board, enum frame_type type,
                 uint8_t frame[FRAME_MAX], int32_t payload_size);

void outbox_status(struct device *device, struct board *board, uint32_t count_us);
void outbox_readings(struct device *device, struct board *board);
void outbox_faults(struct device *device, struct board *board);
void outbox_settings(struct device *device, struct board *board); // without the key

#endif
