// Who may talk to a device: HELLOs are answered, sessions begin and are replaced.
#ifndef HEADWAY_ADMIT_H
#define HEADWAY_ADMIT_H

#include "device.h"

enum sender { SENDER_NOBODY, SENDER_HOST, SENDER_GROUP };

// By its size and its first bytes: what is not opened costs little. What is opened may be anything
// still. A HELLO soon after another is ignored.
enum admission { ADMIT_OPEN, ADMIT_IGNORED, ADMIT_BAD };
enum admission admit_packet(const struct device *device, const uint8_t *packet, int32_t size,
                            int32_t port, uint32_t count_us);

// Answers a HELLO: the same one with the same WELCOME, another one with an offer of a new session.
void admit_hello(struct device *device, struct board *board, const uint8_t *frame, int32_t size,
                 uint32_t count_us);

// Whom a frame is from. A host's first frame in the offered session begins it, if nothing moves.
enum sender admit_frame(struct device *device, const uint8_t *frame, int32_t size);

// Lets an old offer lapse. To be called at least each half hour.
void admit_advance(struct device *device, uint32_t count_us);

#endif
