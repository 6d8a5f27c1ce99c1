// The payload of a GROUP frame: the key of a group of devices, for frames that one broadcast brings
// to all of them. Under it a device accepts SYNC and the command STOP, nothing else.
//
//     key 16 bytes, masked; number u32; counter u48, of the last frame that the group has had
//
// Frames are authentic, not secret, so the key travels under a pad: two SipHash-2-4 values of the
// session's key and of the frame's own counter, which never comes again. Whoever has the group's key,
// each of its devices too, can stop the others and tell them stamps, and no more.
#ifndef HEADWAY_GROUP_H
#define HEADWAY_GROUP_H

#include "frame.h"

// The payload of the session's next frame; `group` is the sending end of the group.
int32_t group_encode(const struct session *session, const struct session *group, uint8_t *payload,
                     int32_t capacity);

// Begins the receiving end of the group, from a frame that the session has opened.
bool group_decode(const struct session *session, const uint8_t *frame, int32_t payload_size,
                  struct session *group);

#endif
