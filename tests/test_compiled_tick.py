"""The tick's two compiled calls, by every solver: what they take of the computer, and what becomes
of them after nonsense."""

import os
import subprocess
import sys
import threading
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from headway.configs.load import load_config
from headway.controller._tick import Feedback
from headway.controller.prediction import Prediction
from headway.controller.program import Program
from headway.controller.reference import own_costs, task_reference
from headway.models.machine import load_machine

ROOT = Path(__file__).resolve().parent.parent
CONFIGS = ROOT / "configs"
BACKENDS = "osqp", "hpipm", "riccati"
COUNTER = ROOT / "tests" / "count_allocations.c"

Array = NDArray[np.float64]


class Still:
    """A machine's program around rest, which it is to leave."""

    def __init__(self, machine: str, backend: str, iterations: int = 1) -> None:
        said = [f"mpc.backend={backend}", f"mpc.sqp_iterations={iterations}"]
        config = load_config(CONFIGS / f"{machine}.yaml", said)
        loaded = load_machine(CONFIGS / config.machine.model)
        prediction = Prediction.of(config, loaded)
        costs = own_costs(task_reference(config, CONFIGS), loaded)
        self.program, n = Program(config, prediction, costs), prediction.n
        self.q, self.d = np.full(n, 0.1), np.zeros(n)
        nodes = config.mpc.intervals + 1
        self.x = np.repeat(np.concatenate((self.q, np.zeros(n)))[:, None], nodes, axis=1)
        self.torque = prediction.holding(self.q, self.d)
        self.u = np.repeat(self.torque[:, None], nodes, axis=1)

    def prepare(self) -> None:
        self.program.prepare(self.x, self.u, self.d)

    def feedback(self, start: Array | None = None) -> Feedback:
        reference = self.x + 0.05
        begin = self.x[:, 0] if start is None else start
        return self.program.feedback(begin, self.d, reference, self.torque, self.torque)


@cache
def still(machine: str, backend: str) -> Still:
    return Still(machine, backend)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("machine", ["arm2", "furuta"])
def test_a_sound_tick_follows_nonsense(machine: str, backend: str) -> None:
    """In the estimate, in the linearization and in what was foreseen: each is refused, and the next
    sound tick is taken, whatever the solver has kept."""
    of = still(machine, backend)
    of.prepare()
    assert of.feedback().accepted
    nonsense = np.full_like(of.x[:, 0], np.nan)
    assert not of.feedback(nonsense).accepted
    of.prepare()
    assert of.feedback().accepted
    for name in ("a", "b0"):
        of.prepare()
        of.program.pool[name][0, 3] = np.nan
        of.program.tick.feedback()
        of.prepare()
        assert of.feedback().accepted
    of.program.prepare(np.full_like(of.x, np.nan), of.u, of.d)
    refused = of.feedback()
    assert not refused.accepted and not refused.residual <= 1
    of.prepare()
    assert of.feedback().accepted


def test_what_one_program_said_is_not_said_of_the_next() -> None:
    """Where the second program of a tick cannot be factorized, the first one's answer is no answer
    to it."""
    of = Still("arm2", "hpipm", iterations=2)
    of.prepare()
    assert of.feedback().accepted
    of.prepare()
    of.program.pool["dt"][...] = np.nan  # what the second one is linearized with
    done = of.feedback()
    assert not done.accepted and not done.residual <= 1


@pytest.mark.parametrize("backend", BACKENDS)
def test_other_threads_run_while_it_computes(backend: str) -> None:
    """Ticks of a hundred programs, of some milliseconds: in one of them a thread that counts, and
    lets go each time, gets to ten. Of Python's own code it would get in between once in 5 ms."""
    of = Still("arm2", backend, iterations=100)
    of.prepare()
    over, counted = threading.Event(), [0]

    def count() -> None:
        while not over.is_set():
            counted[0] += 1
            time.sleep(0)

    thread, most = threading.Thread(target=count), 0
    thread.start()
    for _ in range(200):
        before = counted[0]
        of.program.tick.feedback()
        most = max(most, counted[0] - before)
        if most > 10:
            break
    over.set()
    thread.join()
    assert most > 10


COUNTED = """
import ctypes, sys
from test_compiled_tick import Still
counter = ctypes.CDLL(sys.argv[1])
of = Still(sys.argv[2], sys.argv[3])
prepare, feedback = of.program.tick.prepare, of.program.tick.feedback
def ticks(count):
    for _ in range(count):
        prepare()
        feedback()
of.prepare()
assert of.feedback().accepted
ticks(20)
counter.count_from_here()
ticks(1)
once = counter.counted()
ticks(50)
print(counter.counted() - once, of.feedback().accepted)
"""


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("machine", ["arm2", "furuta"])
def test_it_allocates_nothing(machine: str, backend: str, tmp_path: Path) -> None:
    library = tmp_path / "counter.so"
    command = ["cc", "-shared", "-fPIC", "-O1", "-o", str(library), str(COUNTER)]
    subprocess.run(command, check=True)
    environment = {**os.environ, "LD_PRELOAD": str(library), "PYTHONPATH": str(ROOT / "tests")}
    done = subprocess.run(
        [sys.executable, "-c", COUNTED, str(library), machine, backend],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.split() == ["0", "True"], done.stdout + done.stderr
