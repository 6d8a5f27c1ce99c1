// Pointers that the compiler takes as they are.
//
// A device is one large struct, and a function that is inlined reaches each field from its beginning.
// A small core's loads reach 128 bytes: beyond, each costs the offset's own load besides.
#ifndef HEADWAY_NEAR_H
#define HEADWAY_NEAR_H

// From here on fields are reached from this pointer; it changes nothing else.
#define NEAR(pointer) __asm__("" : "+r"(pointer))

// Called, not inlined: a function of its own has all registers, and those of a small core are few.
#define APART __attribute__((noinline))

// Inlined, however long.
#define INLINE inline __attribute__((always_inline))

// Apart as well: what hardly ever runs. What calls it is laid out for the case that it does not.
#define RARE __attribute__((noinline, cold))

#endif
