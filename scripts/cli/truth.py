"""A run's record and its plant's own, put together: one knows the task, the other the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Config
from headway.controller.record.columns import Arrays
from headway.controller.reference import Reference

Array = NDArray[np.float64]

CHANNELS = "truth_", "servo_"


def with_truth(arrays: Arrays, plant: Arrays, task: Reference) -> Arrays:
    """The run's arrays with the plant's truth and servos, from the task's beginning on, in the
    run's task time. Both count the same system time."""
    start_us = int(arrays["task_start_us"][0])
    joined = dict(arrays)
    for name, values in plant.items():
        channel = next((c for c in CHANNELS if name.startswith(c)), None)
        if channel is not None:
            joined[name] = values[plant[f"{channel}us"] >= start_us]
    for channel in CHANNELS:
        joined[f"{channel}s"] = (joined[f"{channel}us"] - start_us) * 1e-6
    joined["truth_reference"] = task.at(joined["truth_s"])[0]
    return joined


def told_positions(config: Config, arrays: Arrays) -> list[tuple[Array, Array]]:
    """For each axis with an encoder, times of the task [s] and positions [rad or m] as it told
    them; a continuous axis' turns are counted on."""
    start_us, told = int(arrays["task_start_us"][0]), []
    counts = np.diff(arrays["received_sample_count_offsets"])
    devices = np.repeat(arrays["received_device"], counts)
    for device, axis in enumerate(config.machine.boards):
        mine = devices == device
        time_us, first = np.unique(arrays["received_sample_time_us"][mine], return_index=True)
        count = arrays["received_sample_count"][mine][first]
        if axis.continuous:
            count = np.unwrap(count, period=2**32)
        of_task = time_us >= start_us
        time_s = (time_us[of_task] - start_us) * 1e-6
        told.append((time_s, count[of_task] / axis.counts_per_unit))
    return told


def has_truth(arrays: Arrays) -> bool:
    """Whether anybody knows how the machine truly moved."""
    return bool(np.size(arrays["truth_us"]))
