// The board's functions, as firmware calls them.
#include "rack.h"
#include "judge.h"
#include <string.h>

#define RANDOM_STEP 0x9e3779b97f4a7c15u

uint32_t board_count_us(const struct board *of) { return of->count_us; }

int32_t board_encoder_count(const struct board *of) { return of->encoder_count; }

static void call(struct board *of) {
    if (of->interrupt_at > 0 && --of->interrupt_at == 0)
        rack_interrupt(of);
}

void board_set_power(struct board *of, bool on) {
    call(of);
    of->power = on;
}

void board_set_duty(struct board *of, int32_t duty_q15) {
    call(of);
    of->duty_q15 = duty_q15;
}

void board_set_brake(struct board *of, bool engaged) {
    call(of);
    of->brake = engaged;
}

// The axis is where its steps are: at once, as a rack has no time between two polls.
void board_step(struct board *of, uint32_t count_us, int32_t steps, uint32_t first_q16,
                uint32_t spacing_q16) {
    of->axis.position_q16 += (int64_t)steps * 65536;
    rack_stepped(count_us, steps, first_q16, spacing_q16);
}

bool board_stop_line(const struct board *of) { return of->line_open; }

bool board_home_switch(const struct board *of) { return of->on_switch; }

bool board_index(struct board *of, int32_t *count) {
    bool indexed = of->indexed;
    of->indexed = false;
    if (indexed)
        *count = of->index_count;
    return indexed;
}

int32_t board_supply_mV(const struct board *of) { return of->supply_mV; }

void board_set_chopper(struct board *of, bool on) {
    call(of);
    of->chopper = on;
}

void board_set_digital(struct board *of, int32_t output, bool on, uint32_t count_us) {
    of->digital_outputs = (uint8_t)((of->digital_outputs & ~(1 << output)) | on << output);
    rack_switched(output, on, count_us);
}

void board_set_pwm(struct board *of, int32_t output, int32_t duty_q15) {
    of->pwm_q15[output] = duty_q15;
}

uint8_t board_digital_inputs(const struct board *of) { return of->digital_inputs; }

bool board_frame_start(const struct board *of, uint16_t *number, uint32_t *count_us) {
    if (!of->on_bus)
        return false;
    *number = of->frame_number;
    *count_us = of->frame_us;
    return true;
}

int32_t board_receive(struct board *of, uint8_t *bytes, int32_t capacity, int32_t *port,
                      uint32_t *count_us) {
    if (of->packets == 0)
        return 0;
    const struct rack_packet *first = &of->waiting[0];
    int32_t size = first->size < capacity ? first->size : capacity;
    memcpy(bytes, first->bytes, (size_t)size);
    *port = first->port;
    *count_us = first->arrived_us;
    memmove(&of->waiting[0], &of->waiting[1], (size_t)--of->packets * sizeof *first);
    return size;
}

void board_send(struct board *of, int32_t port, const uint8_t *bytes, int32_t size) {
    if (of->collects) {
        rack_sent(port, bytes, size);
        return;
    }
    say_number("port", port);
    say_bytes("packet", bytes, size);
}

int32_t board_load(const struct board *of, enum board_record record, uint8_t *bytes,
                   int32_t capacity) {
    const struct memory *memory = &of->memory[record];
    if (memory->size > capacity)
        return 0;
    memcpy(bytes, memory->bytes, (size_t)memory->size);
    return memory->size;
}

void board_save(struct board *of, enum board_record record, const uint8_t *bytes, int32_t size) {
    struct memory *memory = &of->memory[record];
    memory->size = size < of->kept ? size : of->kept;
    memcpy(memory->bytes, bytes, (size_t)memory->size);
    memory->size += of->grown;
    if (of->flipped >= 0)
        memory->bytes[of->flipped] ^= 1;
    say_number("record", record);
    say_bytes("saved", bytes, size);
}

uint64_t board_random(struct board *of) {
    uint64_t drawn = of->random;
    of->random += RANDOM_STEP;
    return drawn;
}

void rack_advance(struct board *of, uint32_t step_us) {
    struct rack_axis *axis = &of->axis;
    int64_t speed_q16 = axis->turn_q16;
    if (of->power && !of->brake)
        speed_q16 += axis->pull_q16 + (int64_t)of->duty_q15 * axis->speed_q16 / 32768;
    of->count_us += step_us;
    axis->position_q16 += speed_q16 * step_us;
    if (axis->position_q16 > axis->wall_q16)
        axis->position_q16 = axis->wall_q16;
    if (axis->position_q16 < axis->floor_q16)
        axis->position_q16 = axis->floor_q16;
    of->encoder_count = (int32_t)(uint32_t)(uint64_t)(axis->position_q16 >> 16);
}
