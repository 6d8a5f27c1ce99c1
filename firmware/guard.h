// The guard: whether a device may have its output on, judged beside its main loop. All else that
// stops a motor runs in the servo period; if the main loop hangs, the motor is left on its last duty.
//
// What is assumed. The board calls device_guard from a timer's interrupt of its own, at least every
// millisecond, on the core that runs device_poll. The interrupt may come between any two of its
// instructions, device_boot's included, and runs to its end before they go on. A load or store of an
// aligned field of up to 32 bits is never torn, so the guard reads no wider ones: power, state,
// next_servo_us, stop_count_us. What the main loop has written is in memory by its next call of the
// board, which is compiled apart. What the guard misses of a change under way it sees a call later.
// Settings are written as a whole, but with the output off; with the output off it reads none. It
// writes its own struct alone; there the main loop writes `verdict`, in one store, to release.
//
// It never switches anything on. How the board's functions that set an output may be called is in
// board.h.
#ifndef HEADWAY_GUARD_H
#define HEADWAY_GUARD_H

#include <stdint.h>

struct board;
struct device;

enum guard_verdict {
    GUARD_LETS,   // the device has its output
    GUARD_BRAKES, // brake on, no duty: the bridge shorts the windings while the brake engages
    GUARD_OFF,    // the brake has had its time: output off
};

struct guard {
    volatile enum guard_verdict verdict; // latched, until CLEAR
    uint32_t trip_count_us;              // count when it tripped
    uint32_t brake_us;                   // the brake's time, as it was then
    uint32_t closed_count_us;            // count when the line was last seen closed, or no output
    int32_t overdue_us, limit_us;        // what it tripped by
};

// To be called by the board's timer, at least every millisecond. It trips if the output is on and
// - the servo is due, and has been for longer than monitor.late_us;
// - the device has been in FAULT or ESTOP for longer than its stop takes: stop_us, the brake's time
//   and two servo periods;
// - the emergency line has been open for a period more, whatever state the device says it is in.
void device_guard(struct device *device, struct board *board);

// The outputs as the verdict has them, once more: for whoever may have set them since.
void guard_assert(const struct guard *guard, struct board *board);

#endif
