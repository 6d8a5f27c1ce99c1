#include "command.h"
#include "wire.h" // fields

int32_t command_encode(const struct command *command, uint8_t *payload, int32_t capacity) {
    struct writer w = {payload, capacity, 0, false};
    write_uint(&w, command->number, 4);
    write_uint(&w, command->kind, 1);
    write_uint(&w, (uint32_t)command->argument, 4);
    write_uint(&w, command->epoch, 2);
    return w.failed ? -1 : w.size;
}

bool command_decode(const uint8_t *payload, int32_t size, struct command *command) {
    struct reader r = {payload, size, 0, false};
    command->number = (uint32_t)read_uint(&r, 4);
    command->kind = (uint8_t)read_uint(&r, 1);
    command->argument = (int32_t)(uint32_t)read_uint(&r, 4);
    command->epoch = (uint16_t)read_uint(&r, 2);
    return !r.failed && r.at == size;
}
