"""What a process asks of the operating system to be on time, and how it leaves things after."""

import ctypes
import errno
import gc
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from headway.cli.claim import LOOP, PLANT, claimed


class System:
    """An operating system that allows what it is told to: scheduling and locking of memory."""

    def __init__(self, priority: bool, memory: bool) -> None:
        self._priority, self._memory = priority, memory
        self.policy, self.level, self.locked = os.SCHED_OTHER, 0, False

    def set_policy(self, _: int, policy: int, parameters: os.sched_param) -> None:
        if policy == os.SCHED_FIFO and not self._priority:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))
        self.policy, self.level = policy, parameters.sched_priority

    def lock(self, _: int) -> int:
        self.locked = self._memory
        return 0 if self._memory else -1

    def unlock(self) -> int:
        self.locked = False
        return 0


@pytest.fixture(params=[(p, m) for p in (True, False) for m in (True, False)])
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> System:
    made = System(*request.param)
    monkeypatch.setattr(os, "sched_getscheduler", lambda _: made.policy)
    monkeypatch.setattr(os, "sched_getparam", lambda _: os.sched_param(made.level))
    monkeypatch.setattr(os, "sched_setscheduler", made.set_policy)
    library = SimpleNamespace(mlockall=made.lock, munlockall=made.unlock)
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: library)
    monkeypatch.setattr(ctypes, "get_errno", lambda: errno.ENOMEM)
    return made


@pytest.fixture
def collector() -> Iterator[None]:
    """Of this process, as it was."""
    was = gc.isenabled()
    yield
    gc.unfreeze()
    (gc.enable if was else gc.disable)()


@pytest.mark.usefixtures("collector")
@pytest.mark.parametrize("collects", [True, False])
@pytest.mark.parametrize("fails", [True, False])
def test_it_says_what_it_was_refused_and_leaves_all_as_it_was(
    system: System, collects: bool, fails: bool
) -> None:
    (gc.enable if collects else gc.disable)()
    gc.unfreeze()
    try:
        with claimed(LOOP) as refused:
            assert (system.policy == os.SCHED_FIFO) == (not any("rtprio" in w for w in refused))
            assert system.locked == (not any("memlock" in word for word in refused))
            assert len(refused) == (not system._priority) + (not system._memory)
            assert not system._priority or system.level == LOOP
            assert not gc.isenabled() and gc.get_freeze_count() > 0
            if fails:
                raise ValueError
    except ValueError:
        assert fails
    assert (system.policy, system.level, system.locked) == (os.SCHED_OTHER, 0, False)
    assert gc.isenabled() == collects and gc.get_freeze_count() == 0


REAL = """
import json, os, resource, sys
from headway.cli.claim import LOOP, claimed
if sys.argv[1] == "refused":
    for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):
        resource.setrlimit(limit, (0, 0))
    if os.geteuid() == 0:
        os.setresuid(65534, 65534, 65534)

def state():
    locked = next(line for line in open("/proc/self/status") if line.startswith("VmLck"))
    return [os.sched_getscheduler(0), os.sched_getparam(0).sched_priority, int(locked.split()[1])]

before = state()
with claimed(LOOP) as refused:
    within = state()
print(json.dumps([before, within, state(), refused]))
"""


@pytest.mark.parametrize("what", ["refused", "as it is"])
def test_the_real_one_refuses_or_does_it(what: str) -> None:
    """Whichever this computer does, what is said is so."""
    done = subprocess.run([sys.executable, "-c", REAL, what], stdout=subprocess.PIPE, check=True)
    before, within, after, refused = json.loads(done.stdout)
    assert before == after
    slow = any(word.startswith("no real-time priority") for word in refused)
    unlocked = any(word.startswith("memory is not locked") for word in refused)
    assert (within[:2] == [os.SCHED_FIFO, LOOP]) == (not slow)
    assert (within[2] > 0) == (not unlocked)
    if what == "refused":
        assert slow and unlocked and within == before


def test_the_loop_goes_before_a_plant_on_the_same_computer() -> None:
    assert LOOP > PLANT
    low, high = (f(os.SCHED_FIFO) for f in (os.sched_get_priority_min, os.sched_get_priority_max))
    assert low < PLANT < LOOP < high
