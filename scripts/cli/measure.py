"""How punctual this computer is: a task in real time against a plant of its own, measured."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from headway.cli.failure import ExitCode, Failure
from headway.cli.linked import Linked
from headway.cli.live import live
from headway.cli.stopping import signals_stop
from headway.controller.record.recorder import Memory
from headway.controller.tick import DeviceError
from headway.devices import packet

if TYPE_CHECKING:
    from headway.configs.schema import Config

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """Of each tick of a task, or of each status [us]; and what went wrong."""

    wake_us: Array  # from the knot to the tick's beginning, what had arrived taken in
    compute_us: Array  # estimator, solver, tracks
    ready_us: Array  # from the knot until its plan is sent: both of the above
    round_trip_us: list[Array]  # by device: to it and back, without its own waiting
    clock_us: float  # what a device's clock may have been off by, at most, once it was settled
    missed: int  # knots without a tick, or with a plan that was too late to be sent
    late_points: int  # plans that came too late to a device
    failure: str = ""  # why the task broke off

    @property
    def knots(self) -> int:
        """Of the task."""
        return len(self.ready_us) + self.missed


def measure(linked: Linked, path: Path, config: Config, changes: list[str]) -> Measured:
    """Runs the config's task. Raises Failure if it does not even begin."""
    record, failure = Memory(), ""
    with (
        tempfile.TemporaryDirectory(prefix="headway-") as folder,
        live(linked, path, config, changes, Path(folder), record) as (driver, _),
    ):
        try:
            with signals_stop(driver):
                driver.run()
        except DeviceError as error:
            failure = str(error)
        if driver.stopping:
            raise KeyboardInterrupt
    arrays = record.arrays()
    if not driver.ticks:
        raise Failure(ExitCode.DEVICE, failure or "the task did not begin")
    ready_us = (arrays["tick_sent_us"] - arrays["tick_us"]).astype(np.float64)
    compute_us = arrays["timing_compute_us"] * linked.factor
    of_task = arrays["received_us"] >= driver.loop.start_us
    devices = arrays["received_device"][of_task]
    starts = arrays["received_packet_offsets"]
    raw = [
        arrays["received_packet"][starts[i] : starts[i + 1]].tobytes()
        for i in np.flatnonzero(of_task)
    ]
    arrived = list(zip(devices.tolist(), arrays["received_us"][of_task].tolist(), raw, strict=True))
    return Measured(
        wake_us=ready_us - compute_us,
        compute_us=compute_us,
        ready_us=ready_us,
        round_trip_us=round_trips(arrived, len(config.machine.boards)),
        clock_us=clock_error(packet for _, _, packet in arrived),
        missed=driver.deadline_misses,
        late_points=driver.frames(arrays)["late_points"] or 0,
        failure=failure,
    )


def round_trips(arrived: Iterable[tuple[int, int, bytes]], devices: int) -> list[Array]:
    """By device [us], from (device, received_us, packet): what each status and the frame before it
    took together."""
    trips: list[list[float]] = [[] for _ in range(devices)]
    for device, received_us, raw in arrived:
        status = packet.status(raw)
        if status is not None and status.heard_us:
            trips[device].append(received_us - status.heard_us - status.heard_age_us)
    return [np.array(each) for each in trips]


def clock_error(packets: Iterable[bytes]) -> float:
    """The most that a settled clock may be off by, as statuses tell it [us]."""
    worst = 0.0
    for raw in packets:
        status = packet.status(raw)
        if status is not None and status.synced:
            worst = max(worst, -status.least_error_ns * 1e-3, status.most_error_ns * 1e-3)
    return worst
