// judge FILE ...: replays vectors; prints the first disagreement and exits with 1, or with 0 if
// there is none, or with 2 if a file cannot be read. judge --answer FILE ... prints the files with
// this firmware's answers in place of what is published.
#include "judge.h"
#include <errno.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>

#ifndef JUDGE_CPU_S
#define JUDGE_CPU_S 1 // of a firmware that does not come back
#endif
#define LINE_MAX_BYTES 65536
#define FIELDS_MAX 128

struct field {
    const char *name, *value;
    bool taken;
};

static const struct word *const tables[] = {
    codec_words,    handshake_words, payload_words, motion_words,  stop_words,  clock_words,
    settings_words, guard_words,     group_words,   history_words, servo_words, stepper_words,
    peer_words,     neighbour_words, signal_words,  device_words};
static const char *file_name;
static int line_number;
static struct field fields[FIELDS_MAX];
static int32_t field_count;
static char answer[LINE_MAX_BYTES];
static size_t answered;
static void *rooms[FIELDS_MAX];
static int32_t room_count;

static _Noreturn void give_up(const char *what, const char *name) {
    fprintf(stderr, "%s:%d: %s: %s\n", file_name, line_number, what, name);
    exit(2);
}

uint8_t *room(int32_t size) {
    uint8_t *bytes = malloc(size > 0 ? (size_t)size : 1);
    if (!bytes || room_count == FIELDS_MAX)
        give_up("no memory for", "a value");
    rooms[room_count++] = bytes;
    return bytes + (size > 0 ? 0 : 1); // nothing may be read or written where there is nothing
}

static struct field *find(const char *name) {
    for (int32_t i = 0; i < field_count; i++)
        if (strcmp(fields[i].name, name) == 0)
            return &fields[i];
    return 0;
}

static const char *value_of(const char *name) {
    struct field *field = find(name);
    if (!field)
        give_up("missing", name);
    field->taken = true;
    return field->value;
}

bool is_given(const char *name) { return find(name) != 0; }

bool is_word(const char *name, const char *word) { return strcmp(value_of(name), word) == 0; }

static int64_t number(const char *name, const char **text) {
    char *end;
    errno = 0;
    int64_t value = strtoll(*text, &end, 10);
    if (end == *text || errno)
        give_up("not a number", name);
    *text = end;
    return value;
}

int64_t given(const char *name) {
    const char *text = value_of(name);
    int64_t value = number(name, &text);
    if (*text)
        give_up("not a number", name);
    return value;
}

uint64_t given_word64(const char *name) {
    const char *text = value_of(name);
    char *end;
    uint64_t value = strtoull(text, &end, 16);
    if (end - text != 16 || *end)
        give_up("not 16 hexadecimal digits", name);
    return value;
}

static int32_t nibble(char c) {
    return c >= '0' && c <= '9' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : -1;
}

uint8_t *given_bytes(const char *name, int32_t *size) {
    const char *text = value_of(name);
    *size = (int32_t)(strlen(text) / 2);
    uint8_t *bytes = room(*size);
    for (int32_t i = 0; i < *size; i++) {
        int32_t high = nibble(text[2 * i]), low = nibble(text[2 * i + 1]);
        if (high < 0 || low < 0)
            give_up("not hexadecimal", name);
        bytes[i] = (uint8_t)(high << 4 | low);
    }
    if (text[2 * *size])
        give_up("half a byte too many", name);
    return bytes;
}

int32_t given_list(const char *name, int32_t *values, int32_t most) {
    const char *text = value_of(name);
    int32_t count = 0;
    while (*text) {
        int32_t value = (int32_t)number(name, &text);
        int64_t times = 1;
        if (*text == '*') {
            text++;
            times = number(name, &text);
        }
        for (; times > 0; times--) {
            if (count == most)
                give_up("too many numbers", name);
            values[count++] = value;
        }
        if (*text == ',')
            text++;
        else if (*text)
            give_up("not a list", name);
    }
    return count;
}

static void append(const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    size_t left = sizeof answer - answered;
    int written = vsnprintf(answer + answered, left, format, arguments);
    va_end(arguments);
    if (written < 0 || (size_t)written >= left) {
        printf("%s:%d: more answer than a line holds\n", file_name, line_number);
        exit(1);
    }
    answered += (size_t)written;
}

void say(const char *word) { append(" %s", word); }

void say_number(const char *name, int64_t value) { append(" %s=%lld", name, (long long)value); }

void say_word64(const char *name, uint64_t value) {
    append(" %s=%016llx", name, (unsigned long long)value);
}

void say_bytes(const char *name, const uint8_t *bytes, int32_t size) {
    append(size < 0 ? " %s=(%d bytes)" : " %s=", name, size);
    for (int32_t i = 0; i < size; i++)
        append("%02x", bytes[i]);
}

void say_list(const char *name, const int32_t *values, int32_t count) {
    append(" %s=", name);
    for (int32_t i = 0, times; i < count; i += times) {
        for (times = 1; i + times < count && values[i + times] == values[i]; times++)
            ;
        append(times > 1 ? "%s%d*%d" : "%s%d", i ? "," : "", values[i], times);
    }
}

static void split(char *line) {
    field_count = 0;
    for (char *word = strtok(line, " "); word; word = strtok(0, " ")) {
        char *equals = strchr(word, '=');
        if (!equals || field_count == FIELDS_MAX)
            give_up("not name=value, or too many", word);
        *equals = 0;
        fields[field_count++] = (struct field){word, equals + 1, false};
    }
}

static void replay(const char *name) {
    for (size_t i = 0; i < sizeof tables / sizeof *tables; i++)
        for (const struct word *word = tables[i]; word->name; word++)
            if (strcmp(word->name, name) == 0) {
                word->replay();
                return;
            }
    give_up("no such word", name);
}

static void free_rooms(void) {
    while (room_count > 0)
        free(rooms[--room_count]);
}

// Returns false if the firmware's answer is not the published one.
static bool judge_line(char *line, bool publish) {
    static char shown[LINE_MAX_BYTES];
    char *published = strstr(line, " ->");
    if (published) {
        *published = 0;
        published += 3;
    }
    strcpy(shown, line);
    char *rest = strchr(line, ' ');
    if (rest)
        *rest++ = 0;
    split(rest ? rest : line + strlen(line));
    answered = 0;
    answer[0] = 0;
    replay(line);
    for (int32_t i = 0; i < field_count; i++)
        if (!fields[i].taken)
            give_up("unknown name", fields[i].name);
    free_rooms();
    if (publish) {
        printf(answered ? "%s ->%s\n" : "%s\n", shown, answer);
        return true;
    }
    if (strcmp(answer, published ? published : "") == 0)
        return true;
    printf("%s:%d: %s\n  published:%s\n  firmware: %s\n", file_name, line_number, shown,
           published ? published : "", answer);
    return false;
}

static bool judge_file(bool publish) {
    static char line[LINE_MAX_BYTES];
    FILE *file = fopen(file_name, "r");
    line_number = 0;
    if (!file)
        give_up("cannot read", strerror(errno));
    bool agreed = true;
    while (agreed && fgets(line, sizeof line, file)) {
        line_number++;
        size_t size = strlen(line);
        if (size == 0 || line[size - 1] != '\n')
            give_up("not a whole line", "");
        line[size - 1] = 0;
        if (line[0] && line[0] != '#')
            agreed = judge_line(line, publish);
        else if (publish)
            puts(line);
    }
    fclose(file);
    return agreed;
}

int main(int argc, char **argv) {
#ifdef RLIMIT_CPU // a board has none
    struct rlimit cpu = {JUDGE_CPU_S, JUDGE_CPU_S + 1};
    setrlimit(RLIMIT_CPU, &cpu);
    struct rlimit core = {0, 0};
    setrlimit(RLIMIT_CORE, &core);
#endif
    bool publish = argc > 1 && strcmp(argv[1], "--answer") == 0;
    if (publish)
        setvbuf(stdout, 0, _IOLBF, BUFSIZ); // a generator may wait for each answer
    if (argc < 2 + publish) {
        fprintf(stderr, "usage: judge [--answer] FILE ...\n");
        return 2;
    }
    for (int32_t i = 1 + publish; i < argc; i++) {
        file_name = argv[i];
        if (!judge_file(publish))
            return 1;
    }
    return 0;
}
