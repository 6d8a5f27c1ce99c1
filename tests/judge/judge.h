// The judge: replays published vectors (tests/vectors) against the firmware it is linked with.
//
// A vector is a line `word name=value ... -> answer`. Each word has a function here that takes what
// it is given by name, calls the firmware and says the answer; the judge compares that text. Only
// what somebody else's firmware would have, too, is looked at: bytes, values and verdicts.
#ifndef HEADWAY_JUDGE_H
#define HEADWAY_JUDGE_H

#include <stdbool.h>
#include <stdint.h>

// Words of the line at hand by name. All end the program with exit code 2 where a name is missing
// or its value is none. Memory is the judge's, exactly as long as asked for and new at each line,
// so that a sanitizer sees each byte too many.
int64_t given(const char *name);                                     // a number
uint64_t given_word64(const char *name);                             // hexadecimal, 64 bits
bool is_given(const char *name);                                     // whether it is there
uint8_t *given_bytes(const char *name, int32_t *size);               // hexadecimal, writable
int32_t given_list(const char *name, int32_t *values, int32_t most); // 7,-5*3: 7 -5 -5 -5
bool is_word(const char *name, const char *word);                    // name=word
uint8_t *room(int32_t size);

// Parts of the answer, in the order in which they are published.
void say(const char *word);
void say_number(const char *name, int64_t value);
void say_word64(const char *name, uint64_t value);
void say_bytes(const char *name, const uint8_t *bytes, int32_t size);
void say_list(const char *name, const int32_t *values, int32_t count);

struct word {
    const char *name;
    void (*replay)(void);
};

// One table for each kind of vectors; the last entry has no name.
extern const struct word codec_words[], handshake_words[], payload_words[], motion_words[],
    stop_words[], settings_words[], guard_words[], group_words[], history_words[], servo_words[],
    stepper_words[], clock_words[], peer_words[], neighbour_words[], signal_words[], device_words[];

#endif
