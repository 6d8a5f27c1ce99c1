#include "mark.h"
#include "wire.h" // fields

void mark_write(struct writer *w, const struct mark *mark) {
    write_uint(w, mark->number, 2);
    write_uint(w, mark->width_us, 2);
    write_uint(w, (uint64_t)mark->least_us, 8);
}

void mark_read(struct reader *r, struct mark *mark) {
    mark->number = (uint16_t)read_uint(r, 2);
    mark->width_us = (uint16_t)read_uint(r, 2);
    mark->least_us = (int64_t)read_uint(r, 8);
}

bool marks_find(const struct marks *marks, uint16_t number, uint32_t *count_us) {
    for (uint32_t i = 0; i < MARKS && i < marks->taken; i++)
        if (marks->numbers[i] == number) {
            *count_us = marks->counts_us[i];
            return true;
        }
    return false;
}

bool marks_note(struct marks *marks, uint16_t number, uint32_t count_us) {
    uint32_t last = (marks->taken - 1) % MARKS;
    if (number % MARK_EVERY != 0 || (marks->taken > 0 && marks->numbers[last] == number))
        return false;
    uint32_t at = marks->taken++ % MARKS;
    marks->numbers[at] = number;
    marks->counts_us[at] = count_us;
    return true;
}
