// The payload of a COMMAND frame: what a host asks of a device besides plans.
//
//     number u32, command u8, argument i32, epoch u16
//
// A command is carried out once, however often its number arrives; every status tells the last
// number and its result. In a GROUP's frame only STOP is obeyed, whatever its number.
#ifndef HEADWAY_COMMAND_H
#define HEADWAY_COMMAND_H

#include <stdbool.h>
#include <stdint.h>

enum command_kind {
    COMMAND_ARM,    // argument: torque that holds the axis [tq]; a new epoch: of the plans to come
    COMMAND_DISARM, //
    COMMAND_RESUME, // a new epoch
    COMMAND_STOP,   //
    COMMAND_CLEAR,  // a fault, or the emergency stop once its line is closed
    COMMAND_HOME,   // begins the homing task
    COMMAND_JOG,    // argument: speed, 1/65536 pq per servo period; 0 ends the task
    COMMAND_ZERO,   // argument: the position of the axis where it is [counts]
    COMMAND_SAVE,   // the settings, to non-volatile memory; while the power is off
    COMMAND_FAULTS, // asks for the fault log
    COMMAND_KINDS,
};

enum command_result {
    COMMAND_DONE,
    COMMAND_NOT_NOW,  // not in this state
    COMMAND_UNHOMED,  // the axis does not know where it is
    COMMAND_MOVING,   // the axis is not at rest
    COMMAND_CAUSE,    // the cause of the fault is still there
    COMMAND_BAD,      // no such command or argument
    COMMAND_FAILED,   // the memory did not take it
    COMMAND_UNSYNCED, // the clock may be off by more than is allowed
};

struct command {
    uint32_t number; // counts up from 1
    uint8_t kind;    // enum command_kind
    int32_t argument;
    uint16_t epoch;
};

int32_t command_encode(const struct command *command, uint8_t *payload, int32_t capacity);
bool command_decode(const uint8_t *payload, int32_t size, struct command *command);

#endif
