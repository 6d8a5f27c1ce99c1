// What a device remembers without power: its settings, how often it has booted, its last faults.
//
//     record: generation u32, payload, CRC-32 of both
//
// Each kind has two places that are written in turn, and the good record with the higher generation
// counts. So a save that the power cuts short leaves the older one. If one place is damaged, the next
// generation skips one: should the damaged one have been the newer, its generation does not come
// again. The boot counter is a record without a payload: its generation.
#ifndef HEADWAY_STORE_H
#define HEADWAY_STORE_H

#include "board.h"
#include "fault.h"
#include "settings.h"

// Saves the next boot number and tells it. False if it cannot be known (both places are damaged) or
// cannot be saved: then there is no number that was not there before.
bool store_count_boot(struct board *board, uint32_t *boots);

// False if there are none, or none that is whole and of this format. They may still not be valid.
bool store_load_settings(const struct board *board, struct device_settings *settings);

// The saves read back what they wrote; false if it is not there.
bool store_save_settings(struct board *board, const struct device_settings *settings);

// An empty log if there is none.
void store_load_faults(const struct board *board, struct fault_log *faults);
bool store_save_faults(struct board *board, const struct fault_log *faults);

#endif
