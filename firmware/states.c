#include "states.h"
#include <stdint.h>

enum { STAY = DEVICE_STATES }; // no exit

// Rows: states. Columns: events, in the order of enum device_event.
enum {
    BOOT = DEVICE_BOOT,
    UNSY = DEVICE_UNSYNCED,
    IDLE = DEVICE_IDLE,
    ARMD = DEVICE_ARMED,
    RUNN = DEVICE_RUNNING,
    COAS = DEVICE_COAST,
    TAIL = DEVICE_TAIL,
    HOLD = DEVICE_HOLD,
    FAUL = DEVICE_FAULT,
    ESTO = DEVICE_ESTOP,
    ____ = STAY,
};

// clang-format off
static const uint8_t next[DEVICE_STATES][DEVICE_EVENTS] = {
    //          BOOTED SYNCED LOST   ARM    DISARM PLAN   OVERDU RESTED RESUME STOP   FAULT  CLEAR  ESTOP
    [BOOT]   = {UNSY,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  FAUL,  ____,  ESTO},
    [UNSY]   = {____,  IDLE,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  FAUL,  ____,  ESTO},
    [IDLE]   = {____,  ____,  UNSY,  ARMD,  ____,  ____,  ____,  ____,  ____,  ____,  FAUL,  ____,  ESTO},
    [ARMD]   = {____,  ____,  TAIL,  ____,  IDLE,  RUNN,  ____,  ____,  ____,  TAIL,  FAUL,  ____,  ESTO},
    [RUNN]   = {____,  ____,  TAIL,  ____,  ____,  RUNN,  COAS,  ____,  ____,  TAIL,  FAUL,  ____,  ESTO},
    [COAS]   = {____,  ____,  ____,  ____,  ____,  RUNN,  ____,  HOLD,  ____,  TAIL,  FAUL,  ____,  ESTO},
    [TAIL]   = {____,  ____,  ____,  ____,  ____,  ____,  ____,  HOLD,  ____,  ____,  FAUL,  ____,  ESTO},
    [HOLD]   = {____,  ____,  ____,  ____,  IDLE,  ____,  ____,  ____,  ARMD,  TAIL,  FAUL,  ____,  ESTO},
    [FAUL]   = {____,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  UNSY,  ESTO},
    [ESTO]   = {____,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  ____,  UNSY,  ____},
};
// clang-format on

enum device_state next_state(enum device_state state, enum device_event event) {
    uint8_t after = next[state][event];
    return after == STAY ? state : (enum device_state)after;
}
