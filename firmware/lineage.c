#include "lineage.h"

bool lineage_joins(struct lineage own, struct lineage other, int64_t ahead_least_us,
                   int64_t ahead_most_us) {
    if (other.id == own.id || other.id == 0)
        return false;
    if (own.settled != other.settled)
        return other.settled;
    if (own.settled)
        return false;
    if (ahead_least_us > 0)
        return true;
    return ahead_most_us >= 0 && other.id > own.id;
}
