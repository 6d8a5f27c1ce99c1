"""The networks with a name: they are what docs/network.md says, and a machine runs on them."""

import sys
from pathlib import Path

import numpy as np
import pytest

from headway.configs.load import ConfigError, load_config
from headway.configs.save import save_config
from headway.sim.lockstep import Lockstep
from headway.sim.profiles import PROFILES, profile_of

ROOT = Path(__file__).resolve().parent.parent
ARM2 = ROOT / "configs/arm2.yaml"
sys.path.insert(0, str(ROOT / "scripts/benches"))
import network  # noqa: E402  the benchmark that the page quotes

PACKETS = 80_000


def quoted() -> dict[tuple[str, str], list[float]]:
    """The page's table, by network and way."""
    page = (ROOT / "docs/network.md").read_text(encoding="utf-8")
    lines = page.partition("<!-- network:begin -->")[2].partition("<!-- network:end -->")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines.splitlines()]
    rows = [row for row in rows if row][2:]
    return {(row[0], row[1].strip("`")): [float(cell) for cell in row[2:]] for row in rows}


@pytest.mark.parametrize("way", ["to_device", "to_host"])
@pytest.mark.parametrize("name", PROFILES)
def test_the_page_says_what_the_simulator_does(name: str, way: str) -> None:
    least, p50, p99, p999, loss = quoted()[name, way]
    row = network.quantiles(name, way, PACKETS)
    assert least == row["least us"] == getattr(PROFILES[name], way).least_us
    assert p50 == pytest.approx(row["p50 us"], rel=0.03)
    assert p99 == pytest.approx(row["p99 us"], rel=0.06)
    assert p999 == pytest.approx(row["p99.9 us"], rel=0.2)
    assert loss == pytest.approx(row["loss %"], rel=0.12, abs=0.005)


def test_a_named_network_has_its_channels_and_else_they_are_the_configs() -> None:
    assert set(PROFILES) | {"channels"} == set(
        type(load_config(ARM2).sim).model_fields["network"].annotation.__args__
    )
    assert profile_of(load_config(ARM2, ["sim.network=usb"]).sim) is PROFILES["usb"]
    own = load_config(ARM2, ["sim.to_device.loss=0.2"]).sim
    assert profile_of(own) == (own.to_device, own.to_host)


def test_the_ways_of_awful_are_unequal_and_of_usb_iid_equal() -> None:
    assert PROFILES["usb-iid"].to_device == PROFILES["usb-iid"].to_host
    awful = quoted()["awful", "to_device"], quoted()["awful", "to_host"]
    assert awful[1][1] - awful[0][1] > 5000 and awful[1][3] > 90_000


def test_a_config_as_used_loads_again(tmp_path: Path) -> None:
    config = load_config(ARM2, ["sim.network=usb"])
    save_config(config, ARM2.parent, tmp_path / "again.yaml")
    assert load_config(tmp_path / "again.yaml").sim == config.sim


@pytest.mark.parametrize("key", ["to_device", "to_host"])
def test_a_name_and_channels_are_a_mistake(key: str) -> None:
    with pytest.raises(ConfigError, match=f"is lan, .*{key} is given as well: leave {key} out"):
        load_config(ARM2, ["sim.network=lan", f"sim.{key}.loss=0.5"])


@pytest.mark.parametrize("name", ["usb", "lan"])
def test_a_machine_runs_on_it(name: str) -> None:
    unknown = ["sync.to_device_least_us=0", "sync.to_host_least_us=0", "sync.limit_us=2000"]
    changes = [f"sim.network={name}", "duration_s=1", *unknown]
    lockstep = Lockstep(load_config(ARM2, changes), ARM2.parent)
    lockstep.run()
    record = lockstep.record.arrays()
    late = (record["truth_s"] > 0.6) & (record["truth_s"] < 0.95)
    error = record["truth_position"][late] - record["truth_reference"][late][:, :2]
    assert np.abs(error).max() < 5e-3
    assert all((node.sof is not None) == (name == "usb") for node in lockstep.plant.nodes)


def test_copies_are_counted_as_bad_frames_and_change_nothing() -> None:
    """Both ends have a replay window: what arrives twice is taken once."""
    changes = [f"sim.{way}.duplicate=0.3" for way in ("to_device", "to_host")]
    changes += [f"sim.{way}.loss=0" for way in ("to_device", "to_host")]
    lockstep = Lockstep(load_config(ARM2, [*changes, "duration_s=0.5"]), ARM2.parent)
    link, count_anew = lockstep.link, lockstep.link.count_anew
    before = {}

    def count() -> None:
        count_anew()
        before["device"] = [node.status.frames_bad for node in lockstep.plant.nodes]
        before["host"] = [remote.frames_bad for remote in lockstep.remotes]

    link.count_anew = count  # type: ignore[method-assign]
    lockstep.run()
    for axis, (node, remote) in enumerate(zip(lockstep.plant.nodes, lockstep.remotes, strict=True)):
        bad = node.status.frames_bad - before["device"][axis]
        assert link.to_device[axis].duplicated > 20
        assert abs(bad - link.to_device[axis].duplicated) <= 3  # those under way at the ends
        during = lockstep.ticks / link.to_host[axis].sent  # the host no longer listens at the end
        bad = remote.frames_bad - before["host"][axis]
        assert abs(bad - link.to_host[axis].duplicated * during) < 12
