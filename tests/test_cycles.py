"""scripts/bench firmware: an emulator that counts as ARM's table says, a device that lives there as
it does here, and the budget."""

import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from test_cortex import require, tools

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = [str(ROOT / "scripts" / name) for name in ("cortex", "benches")]
NAMES = ("tools", "emulator", "image", "twin", "scene", "profile_lines", "firmware", "_report")

# By ARM's table: each line's cycles, with BL 3 of the caller in none of them. Each function has its
# arguments in r0 and r1.
COUNTED = {
    "straight": ("adds r0, r0, r1; muls r0, r1; lsls r0, r0, #3; bx lr", (3, 4), 1 + 1 + 1 + 2),
    "memory": ("ldr r0, [r0]; str r1, [sp]; ldrh r1, [r2]; bx lr", (0x20000000, 4), 2 * 3 + 2),
    "literal": ("ldr r0, =0x12345678; bx lr", (0, 0), 2 + 2),
    "stack": ("push {r4-r7, lr}; pop {r4-r7, pc}", (0, 0), 6 + 8),
    "many": ("ldmia r0!, {r1, r2, r3}; bx lr", (0x20000000, 0), 4 + 2),
    "taken": ("cmp r0, r1; beq 1f; nop; 1: bx lr", (5, 5), 1 + 2 + 2),
    "not taken": ("cmp r0, r1; beq 1f; nop; 1: bx lr", (5, 6), 1 + 1 + 1 + 2),
    "loop": ("1: subs r0, #1; bne 1b; bx lr", (10, 0), 10 * 1 + 9 * 2 + 1 + 2),
    "call": ("push {lr}; bl leaf; pop {pc}", (0, 0), 2 + 3 + 2 + 4),
    "jump": ("b 1f; 1: bx lr", (0, 0), 2 + 2),
    "high": ("mov r8, r0; add r8, r1; mov r0, r8; bx lr", (1, 2), 3 + 2),
    "barrier": ("dmb; mrs r0, primask; bx lr", (0, 0), 3 + 3 + 2),
}


@pytest.fixture(scope="module")
def modules() -> Iterator[dict[str, ModuleType]]:
    """The bench's modules by name; they are no package of ours."""
    require("arm-none-eabi-gcc")
    sys.path[:0] = FOLDERS
    yield {name: importlib.import_module(name) for name in NAMES}
    del sys.path[: len(FOLDERS)]
    for name in NAMES:
        del sys.modules[name]


@pytest.fixture(scope="module")
def counted(modules: dict[str, ModuleType], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The functions above as an image."""
    folder = tmp_path_factory.mktemp("counted")
    lines = [".syntax unified", ".text", ".thumb"]
    lines += [".thumb_func", ".global leaf", ".type leaf, %function", "leaf: bx lr"]
    for name, (code, _, _) in COUNTED.items():
        label = name.replace(" ", "_")
        lines += [".thumb_func", f".global {label}", f".type {label}, %function", f"{label}:"]
        lines += [*code.replace("1: ", "1:\n").split("; "), ".ltorg"]
    (folder / "counted.s").write_text("\n".join(lines) + "\n")
    linked = ["-nostdlib", "-T", ROOT / "scripts" / "cortex" / "memory.ld", "-Wl,-e,leaf"]
    command = [f"{tools.PREFIX}gcc", *tools.CORE, *linked]
    made = folder / "counted.elf"
    subprocess.run([*command, folder / "counted.s", "-o", made], check=True)
    return made


@pytest.mark.parametrize("name", COUNTED)
def test_cycles_are_those_of_the_table(
    modules: dict[str, ModuleType], counted: Path, name: str
) -> None:
    core = modules["emulator"].Emulator(counted, ("leaf",))
    _, arguments, cycles = COUNTED[name]
    core.call(name.replace(" ", "_"), *arguments)
    tally = core.take()
    assert tally.cycles == cycles
    assert tally.calls == ({"leaf": [2]} if name == "call" else {})
    assert core.take().cycles == 0


@pytest.fixture(scope="module")
def measured(modules: dict[str, ModuleType]) -> tuple[list[dict], ...]:
    """What the bench prints, of polls that are each the same as here."""
    result: tuple[list[dict], ...] = modules["firmware"].measure(40_000)
    return result


def test_the_budget_is_held(measured: tuple[list[dict], ...]) -> None:
    cycles = {row["what"].strip(): row["max"] for row in measured[0]}
    goals = {goal["name"]: goal["met"] for goal in measured[3]}
    assert goals["servo tick, maximum, no more than before [cycles]"], cycles
    assert goals["routines of soft-float in the image"]
    assert goals["cycles of 64-bit divisions in all ticks"]


def test_a_flood_of_junk_costs_little(measured: tuple[list[dict], ...]) -> None:
    """20,000 a second: a tenth of the core at most, if they do not know session and counter. Those
    that do are opened, one in a poll (test_device_states.py), and cost what the bench says."""
    shares = {row["what"]: row["share"] for row in measured[1] if "header right" not in row["what"]}
    assert len(shares) == 4
    assert max(shares.values()) < 0.10, shares


def test_other_numbers_cost_more(measured: tuple[list[dict], ...]) -> None:
    for row in measured[2]:
        assert row["ratio"] > 4 and row["ratio of it"] > 4, row


def test_a_difference_is_noticed(modules: dict[str, ModuleType], tmp_path: Path) -> None:
    """The last bit of a gain on the emulated device alone."""
    core = modules["emulator"].Emulator(modules["image"].compile_firmware(tmp_path / "f.elf"))
    scene = modules["scene"].Scene()
    twin = scene.emulate(core)
    scene.run(20_000)
    assert len(twin.tallies) > 80
    at = core.address("the_device")
    before = core.read(at, core.read_u32("the_sizes"))
    gain = int(scene.settings.servo.kp_tq.mantissa).to_bytes(2, "little")
    assert before.count(gain) >= 1
    core.write(at + before.index(gain), (int.from_bytes(gain, "little") ^ 1).to_bytes(2, "little"))
    with pytest.raises(modules["twin"].Different):
        scene.run(20_000)


def test_soft_float_is_found(modules: dict[str, ModuleType], tmp_path: Path) -> None:
    image, here = modules["image"], ROOT / "scripts" / "cortex"
    made = image.compile_firmware(tmp_path / "rivals.elf", [here / "rivals.c"])
    found = image.soft_float(modules["emulator"].Image(made).symbols)
    assert "__aeabi_fmul" in found and "__aeabi_i2f" in found
