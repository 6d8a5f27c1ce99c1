#include "outbox.h"
#include "cobs.h" // packets on the byte stream
#include "happen.h"

void outbox_send(struct device *device, struct board *board, enum frame_type type,
                 uint8_t frame[FRAME_MAX], int32_t payload_size) {
    uint8_t packet[COBS_BOUND(FRAME_MAX)];
    int32_t size = payload_size < 0 ? -1 : frame_seal(&device->session, type, frame, payload_size);
    if (size > 0)
        board_send(board, BOARD_HOST, packet, cobs_encode(frame, size, packet));
}

void outbox_status(struct device *device, struct board *board, uint32_t count_us) {
    if (!device->session.begun)
        return;
    uint8_t frame[FRAME_MAX];
    struct status *status = &device->status;
    status->sent_us = clock_at(&device->clock, count_us);
    status->state = device->state;
    status->sent_count_us = count_us;
    status->least_error_ns = device->sync.least_error_ns;
    status->most_error_ns = device->sync.most_error_ns;
    status->rate_q32 = device->clock.rate_q32;
    status->heard_age_us = count_us - device->heard_count_us;
    status->counters.stamps_excluded = device->sync.excluded;
    status->synced = device->sync.settled;
    status->grouped = device->group.begun;
    status->holding_tq = held_torque(device);
    status->sample_count = (uint8_t)history_report(&device->history, status->samples);
    outbox_send(device, board, FRAME_STATUS, frame,
                status_encode(status, frame + FRAME_HEADER_BYTES, FRAME_PAYLOAD_MAX));
    status->torque_peak_tq = 0;
}

void outbox_readings(struct device *device, struct board *board) {
    uint8_t frame[FRAME_MAX];
    struct report report;
    signals_report(&device->signals, &report);
    outbox_send(device, board, FRAME_READINGS, frame,
                report_encode(&report, frame + FRAME_HEADER_BYTES, FRAME_PAYLOAD_MAX));
}

void outbox_faults(struct device *device, struct board *board) {
    uint8_t frame[FRAME_MAX];
    outbox_send(device, board, FRAME_FAULTS, frame,
                fault_log_encode(&device->faults, frame + FRAME_HEADER_BYTES, FRAME_PAYLOAD_MAX));
}

void outbox_settings(struct device *device, struct board *board) {
    uint8_t frame[FRAME_MAX];
    int32_t size =
        settings_encode(&device->settings, false, frame + FRAME_HEADER_BYTES, FRAME_PAYLOAD_MAX);
    frame[FRAME_HEADER_BYTES + size++] = DEVICE_FIRMWARE; // the settings are shorter than a payload
    outbox_send(device, board, FRAME_SETTINGS, frame, size);
}
