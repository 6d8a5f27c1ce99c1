// The session that a device has offered in its last WELCOME, until the host's first frame in it.
#ifndef HEADWAY_OFFER_H
#define HEADWAY_OFFER_H

#include "handshake.h"

// From one HELLO that is looked at to the next: a flood of them costs little, and uses up the numbers
// of one boot in 2.7 years. Longer than a round trip, so that a host that was answered gets its turn.
#define OFFER_PAUSE_US 20000
#define OFFER_VALID_US 1000000 // a host whose first frame comes later says hello again

struct offer {
    struct session session;
    struct nonces nonces;
    uint32_t count; // of offers in this boot
    uint32_t made_us, looked_us;
};

#endif
