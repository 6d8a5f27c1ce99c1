#include "polls.h"

#define NEVER INT64_MAX

static uint32_t count_at(struct polls *polls, int64_t true_us) {
    oscillator_seek(&polls->counter, true_us);
    return (uint32_t)(uint64_t)oscillator_read(&polls->counter, true_us);
}

static void plan_pause(struct polls *polls, int64_t now_us) {
    uint64_t most = 2 * (uint64_t)polls->pause_us - 1;
    polls->pause_at_us =
        polls->pause_us == 0 ? NEVER : now_us + 1 + (int64_t)(splitmix64(&polls->random) % most);
}

void polls_begin(struct polls *polls, const struct oscillator *counter, uint32_t period_us,
                 uint32_t pause_us, uint64_t random) {
    struct polls begin = {
        .counter = *counter, .period_us = period_us, .pause_us = pause_us, .random = random};
    *polls = begin;
    polls->period_count = count_at(polls, 0);
    plan_pause(polls, 0);
}

int64_t polls_next_us(const struct polls *polls) {
    return polls->period_at_us < polls->pause_at_us ? polls->period_at_us : polls->pause_at_us;
}

static void plan_period(struct polls *polls) {
    int64_t then_us = polls->period_at_us + polls->period_us;
    polls->period_count += polls->period_us;
    for (int32_t round = 0; round < 2; round++) // the error shrinks by 10^-4 each time
        then_us -= (int32_t)(count_at(polls, then_us) - polls->period_count);
    while ((int32_t)(count_at(polls, then_us) - polls->period_count) < 0) // it has got there
        then_us++;
    polls->period_at_us = then_us;
}

void polls_pass(struct polls *polls) {
    int64_t now_us = polls_next_us(polls);
    if (now_us == polls->period_at_us)
        plan_period(polls);
    if (now_us == polls->pause_at_us)
        plan_pause(polls, now_us);
}
