#include "store.h"
#include "crc.h"
#include "wire.h" // fields
#include <string.h>

#define GENERATION_BYTES 4
#define AROUND_BYTES (GENERATION_BYTES + CRC_BYTES)

_Static_assert(SETTINGS_BYTES_MAX + AROUND_BYTES <= BOARD_RECORD_MAX, "settings fit a record");
_Static_assert(FAULT_LOG_BYTES + AROUND_BYTES <= BOARD_RECORD_MAX, "a fault log fits a record");

// One of the two places of a kind.
struct place {
    bool empty, good;
    uint32_t generation; // of a good one
    int32_t size;        // of the record
    uint8_t bytes[BOARD_RECORD_MAX];
};

static void look(const struct board *board, enum board_record record, struct place *place) {
    place->size = board_load(board, record, place->bytes, sizeof place->bytes);
    place->empty = place->size == 0;
    place->good = false;
    if (place->size < AROUND_BYTES)
        return;
    int32_t covered = place->size - CRC_BYTES;
    struct reader crc = {place->bytes + covered, CRC_BYTES, 0, false};
    struct reader generation = {place->bytes, GENERATION_BYTES, 0, false};
    place->good = read_uint(&crc, CRC_BYTES) == crc_of(place->bytes, covered);
    place->generation = (uint32_t)read_uint(&generation, GENERATION_BYTES);
}

// Looks at both places; returns which of them counts, -1 if none does.
static int32_t newest(const struct board *board, enum board_record first, struct place places[2]) {
    look(board, first, &places[0]);
    look(board, first + 1, &places[1]);
    if (!places[0].good && !places[1].good)
        return -1;
    return places[1].good && (!places[0].good || places[1].generation > places[0].generation);
}

// The payload's size, 0 if there is none.
static int32_t load(const struct board *board, enum board_record first, uint8_t *payload) {
    struct place places[2];
    int32_t which = newest(board, first, places);
    if (which < 0)
        return 0;
    int32_t size = places[which].size - AROUND_BYTES;
    memcpy(payload, places[which].bytes + GENERATION_BYTES, (size_t)size);
    return size;
}

// Returns the generation under which the payload is there now, 0 if it is not. It fits a record, as its
// callers' own bytes do, with what lies around it.
static uint32_t save(struct board *board, enum board_record first, const uint8_t *payload,
                     int32_t size) {
    struct place places[2];
    int32_t which = newest(board, first, places);
    uint32_t last = which < 0 ? 0 : places[which].generation;
    int32_t into = which != 1 && !places[0].empty; // not over the one that counts
    uint32_t step = places[into].empty || places[into].good ? 1 : 2;
    if (last > UINT32_MAX - step)
        return 0;
    struct writer w = {places[0].bytes, sizeof places[0].bytes, 0, false};
    write_uint(&w, last + step, GENERATION_BYTES);
    write_bytes(&w, payload, size);
    write_uint(&w, crc_of(w.bytes, w.size), CRC_BYTES);
    board_save(board, first + (enum board_record)into, w.bytes, w.size);
    struct place *written = &places[1];
    look(board, first + (enum board_record)into, written);
    bool same = written->size == w.size && memcmp(written->bytes, w.bytes, (size_t)w.size) == 0;
    return same ? last + step : 0;
}

bool store_count_boot(struct board *board, uint32_t *boots) {
    struct place places[2];
    bool known = newest(board, RECORD_BOOTS_A, places) >= 0;
    if (!known && !places[0].empty && !places[1].empty)
        return false;
    *boots = save(board, RECORD_BOOTS_A, 0, 0);
    return *boots != 0;
}

bool store_load_settings(const struct board *board, struct device_settings *settings) {
    uint8_t payload[BOARD_RECORD_MAX];
    int32_t size = load(board, RECORD_SETTINGS_A, payload);
    return settings_decode(payload, size, true, settings);
}

bool store_save_settings(struct board *board, const struct device_settings *settings) {
    uint8_t payload[SETTINGS_BYTES_MAX];
    int32_t size = settings_encode(settings, true, payload, sizeof payload);
    return save(board, RECORD_SETTINGS_A, payload, size) != 0;
}

void store_load_faults(const struct board *board, struct fault_log *faults) {
    uint8_t payload[BOARD_RECORD_MAX];
    int32_t size = load(board, RECORD_FAULTS_A, payload);
    if (!fault_log_decode(payload, size, faults))
        memset(faults, 0, sizeof *faults);
}

bool store_save_faults(struct board *board, const struct fault_log *faults) {
    uint8_t payload[FAULT_LOG_BYTES];
    int32_t size = fault_log_encode(faults, payload, sizeof payload);
    return save(board, RECORD_FAULTS_A, payload, size) != 0;
}
