"""A plant and its controllers as processes of their own, for tests that kill them.

Controllers are forked from a server that has imported everything, so that one is there in a moment;
what they run is `headway run --link`'s own loop.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from headway.cli.wall import WallClock
from headway.configs.load import load_config
from headway.controller.record.columns import Arrays
from headway.controller.record.reader import RecordError, read_run
from headway.devices.keys import draw_keys
from headway.sim.truth import TRUTH_US

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
CONFIG = CONFIGS / "arm2.yaml"
PATIENCE_S = 60.0
LOAD = ["headway.cli.live", "headway.controller.live", "headway.sim.realtime", "osqp", "casadi"]
NEVER = -1.0
STILL_RAD = 1e-3  # that an axis may creep at rest, as in scripts/bench mishaps
AFTER_US = 250_000  # beyond the plan: five of the time constants (Kd / Kp) of arm2's servos

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload([*LOAD, __name__])


def ticks_in(folder: Path) -> int:
    """How many are there by now; -1 if not even the file's beginning is."""
    try:
        return read_run(folder).messages["tick"]
    except RecordError:
        return -1


def _control(
    folder: Path, ports: Path, kind: str, factor: float, changes: list[str], told: Any
) -> None:
    """A controller: tells the task's seconds after each tick, and at the end why it ended."""
    os.environ["PYTHONFAULTHANDLER"] = "1"
    from headway.cli.failure import ExitCode, Failure
    from headway.cli.linked import Linked
    from headway.cli.live import live
    from headway.cli.stopping import signals_stop
    from headway.controller.record.recorder import Memory
    from headway.controller.tick import DeviceError

    config = load_config(CONFIG, changes)
    linked = Linked(kind, factor, False, folder / "keys", ports)  # type: ignore[arg-type]
    code = 0

    def progress(done_s: float) -> None:
        told.value = done_s

    try:
        with live(linked, CONFIG, config, changes, folder, Memory()) as (driver, _):
            try:
                with signals_stop(driver):
                    driver.run(progress)
            except DeviceError as error:
                raise Failure(ExitCode.DEVICE, str(error)) from error
            code = 130 if driver.stopping else 0
    except Failure as error:
        (folder / "said").write_text(str(error))
        code = 4
    os._exit(code)


@dataclass
class Controller:
    """A controller's process."""

    process: ForkServerProcess
    told: Any

    @property
    def task_s(self) -> float:
        """Seconds of the task at its last tick; -1 before."""
        return float(self.told.value)

    def await_task(self, seconds: float) -> bool:
        """Waits for a time of the task; False if the controller ended before."""
        end = time.monotonic() + PATIENCE_S
        while self.task_s < seconds and time.monotonic() < end:
            if not self.process.is_alive():
                return False
            time.sleep(0.0005)
        return self.task_s >= seconds

    def send(self, number: int) -> None:
        assert self.process.pid is not None
        os.kill(self.process.pid, number)

    def wait(self) -> int | None:
        """Its exit code; negative if a signal ended it."""
        self.process.join(PATIENCE_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
            raise AssertionError("the controller does not end")
        return self.process.exitcode


class Machine:
    """`headway plant` in a process, with its record, and controllers for it."""

    def __init__(self, folder: Path, kind: str, factor: float, *changes: str) -> None:
        self.folder, self.kind, self.factor = folder, kind, factor
        self.changes = ["duration_s=30", "sync.limit_us=2000", *changes]
        self.config = load_config(CONFIG, self.changes)
        self.clock = WallClock(factor)
        self.record = folder / "plant.mcap"
        if not (folder / "keys").exists():
            draw_keys(folder / "keys", [axis.joint for axis in self.config.machine.axes])
        words = ["plant", str(CONFIG), "--link", kind, "--realtime-factor", f"{factor:g}"]
        words += ["--keys", str(folder / "keys"), "--ports", str(folder / "ports")]
        words += [word for change in self.changes for word in ("--set", change)]
        words += ["--record", str(self.record), "--until-eof"]
        self.process = subprocess.Popen(
            [str(Path(sys.executable).with_name("headway")), *words],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
        )  # fmt: skip

    def __enter__(self) -> Machine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.end()

    def end(self) -> None:
        """Lets the plant finish its record."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(PATIENCE_S)

    @property
    def ports(self) -> Path:
        return self.folder / "ports"

    def controller(self, ports: Path | None = None) -> Controller:
        """One more, which takes the machine over, at its ports or those of a wire between."""
        told = _CONTEXT.Value("d", NEVER)
        arguments = self.folder, ports or self.ports, self.kind, self.factor, self.changes, told
        process = _CONTEXT.Process(target=_control, args=arguments)
        process.start()
        return Controller(process, told)

    @property
    def said(self) -> str:
        """What the last controller that failed has said."""
        return (self.folder / "said").read_text()

    def now_us(self) -> int:
        return self.clock.now_us()

    @property
    def plan_us(self) -> int:
        """How long a plan lasts, from the tick on."""
        return self.config.mpc.horizon_us + self.config.loop.margin_us

    def pause(self, span_us: int) -> None:
        """Lets system time pass."""
        time.sleep(self.clock.seconds(span_us))

    def truth(self) -> Arrays:
        """The plant's own record, after `end`."""
        return read_run(self.record).arrays


def speeds(truth: Arrays, from_us: int, to_us: int) -> np.ndarray:
    """Largest speed of each axis in a span of system time [rad/s]."""
    within = (truth["truth_us"] >= from_us) & (truth["truth_us"] <= to_us)
    assert within.any(), "nothing was recorded there"
    return np.abs(truth["truth_velocity"][within]).max(axis=0)


def ways(truth: Arrays, from_us: int, to_us: int) -> np.ndarray:
    """How far each axis moves about in a span of system time [rad]."""
    within = (truth["truth_us"] >= from_us) & (truth["truth_us"] <= to_us)
    assert within.any(), "nothing was recorded there"
    return np.ptp(truth["truth_position"][within], axis=0)


@dataclass(frozen=True)
class Coast:
    """How a machine came to rest that was left to its last plan."""

    speed: float  # of the fastest axis just before [rad/s]
    setpoints_us: list[int]  # by axis: from then on until its setpoint moved no more
    moved: float  # the most that an axis moved once it had to rest [rad]
    broken: list[str]  # what of this should not be

    def __str__(self) -> str:
        rests = " and ".join(f"{rest_us * 1e-3:.0f}" for rest_us in self.setpoints_us)
        return (
            f"{self.speed:.2f} rad/s, setpoints at rest after {rests} ms, "
            f"moved by {1e3 * self.moved:.2f} mrad from then on"
        )


def coast(machine: Machine, truth: Arrays, left_us: int, to_us: int) -> Coast:
    """Of a machine that nobody told anything from `left_us` on, and nobody may have moved up to
    `to_us`. Its setpoints rest within the plan, as its devices count time; its axes, which swing
    about them, a little later."""
    within = (truth["servo_us"] > left_us) & (truth["servo_us"] <= to_us)
    times_us, moves = truth["servo_us"][within], truth["servo_setpoint_rate_pq"][within] != 0
    assert within.any(), "nothing was recorded there"
    rests = [int(max(times_us[axis], default=left_us)) - left_us for axis in moves.T]
    allowed_us = machine.plan_us + machine.config.sync.limit_us + TRUTH_US
    rested_us = left_us + machine.plan_us + AFTER_US
    until_us = max(to_us, rested_us + AFTER_US)
    moved = float(ways(truth, rested_us, until_us).max())
    broken = []
    if max(rests) > allowed_us:
        broken.append(f"a setpoint moves {max(rests)} us after, of {allowed_us} that a plan lasts")
    if moved > STILL_RAD:
        broken.append(f"an axis moves by {moved:.4f} rad after the plan")
    return Coast(speeds(truth, left_us - 20_000, left_us).max(), rests, moved, broken)


def within_limits(machine: Machine, truth: Arrays) -> bool:
    """Position, velocity and torque, at any time."""
    from headway.cli.summary import _violations

    return _violations(machine.config, truth) == []


KILL, STOP, CONT = signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT
