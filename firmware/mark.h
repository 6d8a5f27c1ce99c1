// Marks: instants that all boards on a bus see at once, such as every 32nd start of a USB frame.
//
// Each board tells between which times, by what it knows of the host's, a mark was. The host has those
// of all boards, and tells them what all of them agree on. So they come to know the same.
#ifndef HEADWAY_MARK_H
#define HEADWAY_MARK_H

#include <stdbool.h>
#include <stdint.h>

#define MARK_EVERY 32    // starts of frames
#define MARKS 8          // a power of two: remembered, a quarter of a second
#define MARK_OPEN 0xffff // a width: there is none

// When a mark was, by the host's time: at least `least_us` and at most `width_us` later.
struct mark {
    uint16_t number;
    uint16_t width_us;
    int64_t least_us;
};

// Where the own counter was.
struct marks {
    uint32_t taken;
    uint16_t numbers[MARKS];
    uint32_t counts_us[MARKS];
};

// A mark in a frame, 12 bytes.
struct writer;
struct reader;
void mark_write(struct writer *w, const struct mark *mark);
void mark_read(struct reader *r, struct mark *mark);

// Notes the last start of a frame; true if that is a mark which is not noted yet.
bool marks_note(struct marks *marks, uint16_t number, uint32_t count_us);

// The count of a mark; false if it is not remembered.
bool marks_find(const struct marks *marks, uint16_t number, uint32_t *count_us);

#endif
