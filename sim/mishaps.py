"""What goes wrong in the simulated world: mishaps of boards, wires and clocks, as configured."""

from __future__ import annotations

from typing import Protocol

from headway.configs.schema import Config, Mishap
from headway.sim.plant import Plant

ENCODER_DEFECTS = {"encoder_stuck": 1, "encoder_reversed": 2, "encoder_spike": 3}


class Network(Protocol):
    """The wires, and the host's clock at their end."""

    def cut(self, devices: set[int]) -> None:
        """No packet passes to or from these devices."""

    def step_clock(self, true_us: int, step_us: int) -> None:
        """The host's clock jumps."""


class Mishaps:
    """Lets each mishap begin and end in its time."""

    def __init__(self, config: Config, plant: Plant, network: Network) -> None:
        joints = [axis.joint for axis in config.machine.axes]
        every = range(len(plant.nodes))
        self._plant, self._network = plant, network
        self._feed_V = [node.feed_V for node in plant.nodes]
        self._waiting = [
            (mishap, [joints.index(mishap.joint)] if mishap.joint else list(every))
            for mishap in sorted(config.sim.mishaps, key=lambda mishap: mishap.at_s)
        ]
        self._under_way: list[tuple[Mishap, list[int]]] = []
        self._cut: set[int] = set()

    def happen(self, true_us: int, task_s: float) -> None:
        """What is due by now; to be called with time going on, once the task runs."""
        while self._waiting and self._waiting[0][0].at_s <= task_s:
            mishap, devices = self._waiting.pop(0)
            self._begin(mishap, devices, true_us)
            self._under_way.append((mishap, devices))
        for mishap, devices in [m for m in self._under_way if m[0].at_s + m[0].for_s <= task_s]:
            self._end(mishap, devices)
            self._under_way.remove((mishap, devices))

    def _begin(self, mishap: Mishap, devices: list[int], true_us: int) -> None:
        if mishap.kind == "host_clock_step":
            self._network.step_clock(true_us, mishap.step_us)
            return
        for device in devices:
            if mishap.kind == "push":  # which happens to a joint without a board, too
                self._plant.push(device, mishap.effort_Nm_or_N)
                continue
            node = self._plant.nodes[device]
            if mishap.kind == "emergency_stop":
                node.stop_line = True
            elif mishap.kind == "reset":
                node.restart()
            elif mishap.kind == "partition":
                self._cut.add(device)
                self._network.cut(self._cut)
            elif mishap.kind == "supply_sag":
                node.feed_V = mishap.supply_V
            elif mishap.kind == "clock_step":
                node.step_clock(mishap.step_us)
            elif mishap.kind == "firmware_hangs":
                node.hung = True
            else:
                node.break_encoder(ENCODER_DEFECTS[mishap.kind], true_us)

    def _end(self, mishap: Mishap, devices: list[int]) -> None:
        for device in devices:
            if mishap.kind == "push":
                self._plant.push(device, -mishap.effort_Nm_or_N)
                continue
            node = self._plant.nodes[device]
            if mishap.kind == "emergency_stop":
                node.stop_line = False
            elif mishap.kind == "partition":
                self._cut.discard(device)
                self._network.cut(self._cut)
            elif mishap.kind == "supply_sag":
                node.feed_V = self._feed_V[device]
            elif mishap.kind == "firmware_hangs":
                node.hung = False
