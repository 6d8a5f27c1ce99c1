"""A device takes its load only at rest; one that still swings is asked again, for a while."""

from pathlib import Path

import pytest

from headway.configs.load import load_config
from headway.controller.tick import DeviceError, Outbox, Phase, Tick
from headway.sim.lockstep import Lockstep
from headway.sim.plant import BRAKE

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
ELBOW = 1
SHARE = 1.5  # of what its brake holds


def powered_up() -> Lockstep:
    config = load_config(CONFIGS / "arm2.yaml", ["duration_s=0.1", "mpc.enabled=false"])
    return Lockstep(config, CONFIGS)


def test_it_is_asked_again() -> None:
    """From when the load is to be taken the elbow is pushed to and fro, tick by tick, harder than
    its brake can hold: it hardly comes to rest before that ends."""
    lockstep = powered_up()
    plant, tick = lockstep.plant, lockstep.loop.tick
    effort = SHARE * float(plant.model.actuator_user[ELBOW, BRAKE])
    pushes = [effort, *(2 * effort * (-1) ** i for i in range(1, 60)), effort]
    assert sum(pushes) == pytest.approx(0)

    def and_push(now_us: int) -> tuple[Tick, Outbox]:
        decided = tick(now_us)
        if lockstep.loop.phase is Phase.ARM and pushes:
            plant.push(ELBOW, pushes.pop(0))
        return decided

    lockstep.loop.tick = and_push  # type: ignore[method-assign]
    lockstep.run()
    assert lockstep.device_states() == ["HOLD", "HOLD"]


def test_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    lockstep = powered_up()
    monkeypatch.setattr(lockstep.remotes[ELBOW], "answer", lambda: "MOVING")
    with pytest.raises(DeviceError, match=r"^q2: the device does not arm: MOVING$"):
        lockstep.run()
    assert lockstep.loop.phase is Phase.ARM
