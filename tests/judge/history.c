// Replays history-*: samples taken and reported.
#include "history.h"
#include "judge.h"

static struct history history;

// Nothing taken yet, or so many samples ago that the numbers are near their end.
static void replay_history(void) {
    uint32_t taken = (uint32_t)given("taken");
    history = (struct history){.taken = taken, .reported = taken, .repeated = taken};
}

// So many samples, each of the next count and a millisecond later.
static void replay_history_push(void) {
    int64_t time_us = given("time_us"), count = given("count"), times = given("times");
    for (int64_t i = 0; i < times; i++)
        history_push(&history, time_us + 1000 * i, (int32_t)(count + i));
    say_number("lost", history.lost);
}

static void replay_history_flush(void) {
    history_flush(&history);
    say_number("taken", history.taken);
}

static void replay_history_report(void) {
    struct sample *samples = (struct sample *)(void *)room(HISTORY_SAMPLES * sizeof *samples);
    int32_t reported = history_report(&history, samples), counts[HISTORY_SAMPLES];
    for (int32_t i = 0; i < reported; i++) {
        say_number("time_us", samples[i].time_us);
        counts[i] = samples[i].count;
    }
    say_list("counts", counts, reported);
}

const struct word history_words[] = {
    {"history", replay_history},
    {"history-push", replay_history_push},
    {"history-flush", replay_history_flush},
    {"history-report", replay_history_report},
    {0, 0},
};
