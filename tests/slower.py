"""A gate on the host's side that refuses what is fast of arm2's elbow."""

from collections.abc import Callable

from headway.configs.axis import DrivenAxis
from headway.devices import core
from headway.devices.axis import AxisUnits, position_limits


def slower(times: int) -> Callable[[DrivenAxis, AxisUnits], core.GateLimits]:
    """In place of position_limits: of q2 so many times slower."""

    def limits(axis: DrivenAxis, units: AxisUnits) -> core.GateLimits:
        own = position_limits(axis, units)
        speed = own.difference_max // (times if axis.joint == "q2" else 1)
        rest = own.second_difference_max, own.stop_difference
        return core.GateLimits(own.point_min, own.point_max, speed, *rest)

    return limits
