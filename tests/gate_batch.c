// Puts plans through the gate, one record after the other from standard input to standard output:
// what the gate says, and the points that the track then holds. What is stored has passed the gate
// before, or the plan does not count.
#include "gate.h"
#include <stdio.h>
#include <string.h>

#define BEFORE 4 // points before the knot that runs
#define WINDOW 144
#define NO_STORY (-1) // the gate would never have let in what is stored

struct job {
    int32_t continuous, point_min, point_max, difference_max, second_difference_max,
        stop_difference;
    int32_t stored_count, count; // stored_count 0: nothing is stored
    int64_t stored_first, first_knot, knot;
    int32_t stored[PLAN_POINTS_MAX], points[PLAN_POINTS_MAX];
};

struct answer {
    int32_t result;
    int32_t before[WINDOW], after[WINDOW]; // points from knot - BEFORE on
};

static void copy(const struct track *track, int64_t first_knot, int32_t *points) {
    for (int32_t i = 0; i < WINDOW; i++)
        points[i] = track_point(track, first_knot + i);
}

int main(void) {
    static struct job job;
    static struct answer answer;
    static struct track track;
    while (fread(&job, sizeof job, 1, stdin) == 1) {
        struct gate_limits limits = {
            job.continuous != 0,       job.point_min,      job.point_max, job.difference_max,
            job.second_difference_max, job.stop_difference};
        if (!gate_limits_valid(&limits))
            return 2;
        memset(&track, 0, sizeof track);
        if (job.stored_count > 0)
            track_write(&track, job.stored_first, job.stored, job.stored_count);
        copy(&track, job.knot - BEFORE, answer.before);
        const struct track empty = {0};
        if (job.stored_count > 0 &&
            gate_check_track(&limits, &empty, job.stored_first, job.stored, job.stored_count,
                             job.stored_first - GATE_LIVE_KNOTS) != GATE_ACCEPTED) {
            answer.result = NO_STORY;
            fwrite(&answer, sizeof answer, 1, stdout);
            continue;
        }
        answer.result = (int32_t)gate_check_track(&limits, &track, job.first_knot, job.points,
                                                  job.count, job.knot);
        if (answer.result == GATE_ACCEPTED)
            track_write(&track, job.first_knot, job.points, job.count);
        copy(&track, job.knot - BEFORE, answer.after);
        fwrite(&answer, sizeof answer, 1, stdout);
    }
    return 0;
}
