#include "fixed.h"
#include "near.h"

RARE int32_t fixed_scale_within(int32_t a, struct scale scale, int32_t bits) {
    return fixed_scale_any(a, scale, bits);
}
