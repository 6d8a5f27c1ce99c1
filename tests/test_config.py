"""Configs: whatever is in the file, the answer is a Config or a ConfigError that can be mended."""

import io
import itertools
import json
import math
import pickle
import re
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any, get_args

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from headway.configs.load import ConfigError, load_config
from headway.configs.mistakes.mistake import Mistake, Place
from headway.configs.mistakes.source import read_yaml
from headway.configs.mistakes.units import convert, factor, split, told
from headway.configs.save import save_config
from headway.configs.schema import Config
from headway.configs.section import Section

ARM2 = Path(__file__).resolve().parent.parent / "configs" / "arm2.yaml"
MODEL = ARM2.parent.parent / "models" / "arm2" / "arm2.xml"
TEXT = ARM2.read_text().replace("../models/arm2/arm2.xml", f"'{MODEL}'")
TREE: dict[str, Any] = YAML(typ="safe").load(TEXT)

Load = Callable[..., Config]
KeyPath = tuple[int | str, ...]

anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**40), 10**40)
    | st.floats()
    | st.text(max_size=8)
    | st.dates()
    | st.binary(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=4,
)
pieces = st.sampled_from([
    *(b"[", b"]", b"{", b"}", b":", b": ", b"-", b"- ", b"? ", b",", b"&a ", b"*a", b"!!x ", b"|"),
    *(b">", b"'", b'"', b"%", b"@", b"#", b"~", b"<<: ", b"\\ud800", b"\\UFFFFFFFF", b"---\n"),
    *(b"...", b" ", b"\n", b"\n  ", b"\t", b"\r", b"\xff", b"\x00", b"\xef\xbb\xbf", b"\xc2\x85"),
    *(b".nan", b"1e999", b"0x", b"axes", b"margin_ms: 8\n", b"9" * 60),
]) | st.binary(min_size=1, max_size=1)  # fmt: skip
fuzz = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture
def load(tmp_path: Path) -> Load:
    """load_config of a text or a tree, from a file config.yaml."""

    def load(content: str | bytes | dict[str, Any], *overrides: str) -> Config:
        path = tmp_path / "config.yaml"
        text = dumped(content) if isinstance(content, dict) else content
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return load_config(path, list(overrides))

    return load


def dumped(tree: Any) -> str:
    """YAML with a line for each key and list entry."""
    yaml, stream = YAML(typ="safe"), io.StringIO()
    yaml.default_flow_style, yaml.width = False, 10_000
    yaml.dump(tree, stream)
    return stream.getvalue()


def mistakes_of(load: Load, *arguments: Any) -> list[Mistake]:
    """Empty if it loads; each names the file or the override, and says something."""
    try:
        assert isinstance(load(*arguments), Config)
    except ConfigError as error:
        assert error.mistakes
        for mistake in error.mistakes:
            assert mistake.text
            assert mistake.place.source.endswith("config.yaml") or mistake.place.order > 0
        assert len(str(error).splitlines()) == min(21, len(error.mistakes))
        return error.mistakes
    return []


def places(node: Any, path: KeyPath = ()) -> Iterator[tuple[Any, Any, KeyPath]]:
    """(container, key or index, path) of every node of a tree."""
    items = node.items() if isinstance(node, dict) else enumerate(node)
    for key, child in items:
        yield node, key, (*path, key)
        if isinstance(child, dict | list):
            yield from places(child, (*path, key))


PLACES = len(list(places(TREE)))
LEAVES = [path for node, key, path in places(TREE) if not isinstance(node[key], dict | list)]


def changed(path: KeyPath, change: Callable[[Any, Any], None]) -> dict[str, Any]:
    """A copy of the good tree; `change` gets the container and the last key of `path`."""
    tree = deepcopy(TREE)
    node: Any = tree
    for step in path[:-1]:
        node = node[step]
    change(node, path[-1])
    return tree


@fuzz
@given(
    st.lists(
        st.tuples(
            st.integers(0, PLACES - 1),
            st.sampled_from(["set", "delete", "add", "rename"]),
            anything,
        ),
        min_size=1,
        max_size=3,
    )
)
def test_mutated_tree(load: Load, mutations: list[tuple[int, str, Any]]) -> None:
    tree = deepcopy(TREE)
    for index, kind, value in mutations:
        found = list(places(tree))
        container, key, _ = found[index % len(found)]
        if kind == "set" or isinstance(container, list):
            container[key] = value
        elif kind == "add":
            container[str(value)] = value
        else:
            taken = container.pop(key)
            if kind == "rename":
                container[f"{key}_x"] = taken
        if not tree:
            break
    mistakes_of(load, tree)


@settings(fuzz, max_examples=200)
@given(
    st.lists(
        st.tuples(st.integers(0, len(TEXT)), st.integers(0, 20) | st.just(10_000), pieces),
        min_size=1,
        max_size=3,
    )
)
def test_mutated_bytes(load: Load, mutations: list[tuple[int, int, bytes]]) -> None:
    content = TEXT.encode()
    for start, cut, pasted in mutations:
        content = content[:start] + pasted + content[start + cut :]
    mistakes_of(load, content)


@fuzz
@given(st.lists(st.integers(0, TEXT.count("\n") - 1), min_size=2, max_size=4))
def test_lines_repeated_and_swapped(load: Load, numbers: list[int]) -> None:
    lines = TEXT.splitlines()
    lines.insert(numbers[0], lines[numbers[-1]])
    for a, b in itertools.pairwise(numbers):
        lines[a], lines[b] = lines[b], lines[a]
    mistakes_of(load, "\n".join(lines))


@fuzz
@given(st.text(alphabet=st.sampled_from("abm:.{}[]=&*!- 0129ens\n\"'#\udc80"), max_size=25))
def test_any_override(load: Load, override: str) -> None:
    for mistake in mistakes_of(load, TEXT, override):
        assert mistake.place.order == 1 and str(mistake).startswith("--set ")


tree_of_scalars = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**30), 10**30) | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=9)
    | st.sampled_from(["1e3", "0x1f", "0o7", "on", "Null", "~", "<<", ".inf", "1_0", "2020-01-01"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("a1<-", min_size=1), inner),
    max_leaves=8,
)  # fmt: skip


@settings(fuzz, max_examples=200)
@given(tree_of_scalars)
def test_reads_what_ruamel_writes(tree: Any) -> None:
    read, mistakes = read_yaml(dumped(tree), Place("x"))
    assert json.dumps(read, sort_keys=True) == json.dumps(tree, sort_keys=True)  # 1 is not 1.0
    assert mistakes == []


@pytest.mark.parametrize("path", LEAVES, ids=lambda path: ".".join(map(str, path)))
def test_a_wrong_value_is_one_mistake_in_its_place(load: Load, path: KeyPath) -> None:
    if path[-1] == "joint":
        return  # any text will do

    def change(node: Any, key: Any) -> None:
        node[key] = "MARK it"

    tree = changed(path, change)
    lines = dumped(tree).splitlines()
    number = next(i for i, line in enumerate(lines) if "MARK" in line)
    (mistake,) = mistakes_of(load, tree)
    assert mistake.key == path
    assert mistake.place.line == number + 1
    assert mistake.place.column == lines[number].index("MARK") + 1


@pytest.mark.parametrize("path", LEAVES, ids=lambda path: ".".join(map(str, path)))
def test_a_misspelled_key_is_one_mistake_in_its_place(load: Load, path: KeyPath) -> None:
    if isinstance(path[-1], int) or "mass_scale" in path:
        return  # an entry of a list has no name, a body may have any

    def change(node: Any, key: Any) -> None:
        node[f"{key}z"] = node.pop(key)

    tree = changed(path, change)
    lines = dumped(tree).splitlines()
    number = next(i for i, line in enumerate(lines) if f"{path[-1]}z:" in line)
    (mistake,) = mistakes_of(load, tree)
    assert mistake.key == (*path[:-1], f"{path[-1]}z")
    assert mistake.place.line == number + 1
    assert mistake.place.column == lines[number].index(f"{path[-1]}z") + 1
    assert f"unknown key; did you mean `{path[-1]}`?" in mistake.text


@pytest.mark.parametrize("path", LEAVES, ids=lambda path: ".".join(map(str, path)))
def test_a_missing_key_is_one_mistake_or_none(load: Load, path: KeyPath) -> None:
    def change(node: Any, key: Any) -> None:
        del node[key]

    mistakes = mistakes_of(load, changed(path, change))
    required = any(mistake.text.startswith("missing: ") for mistake in mistakes)
    # A default that does not go with the others may be told at one of these.
    beside = [mistake.key for mistake in mistakes if mistake.key[:-1] == path[:-1]]
    told = [path] if required else beside or [path[:-1]]
    assert [mistake.key for mistake in mistakes] in ([], told) and len(mistakes) <= 1
    if required:
        example = re.search(f"for example `({path[-1]}: .*)`", mistakes[0].text)
        assert example

        def mend(node: Any, key: Any) -> None:
            node.update(YAML(typ="safe").load(example[1]))

        mended = changed(path, mend)
        mended["machine"]["model"] = str(MODEL)
        assert mistakes_of(load, mended) == []


SWAPS = [
    ("us", "ms", 1e3),
    ("us", "s", 1e6),
    ("s", "ms", 1e-3),
    ("rad", "deg", math.pi / 180),
    ("rad_per_s", "rpm", math.pi / 30),
    ("rad_per_s", "deg_per_ms", 1e3 * math.pi / 180),
    ("rad_per_s2", "deg_per_s2", math.pi / 180),
    ("Nm", "mNm", 1e-3),
    ("Nm", "kNm", 1e3),
    ("Nm_per_A", "mNm_per_A", 1e-3),
    ("Nm_per_rad", "Nm_per_deg", 180 / math.pi),
    ("Nm_s_per_rad", "Nm_ms_per_rad", 1e-3),
    ("ohm", "mohm", 1e-3),
    ("V", "mV", 1e-3),
    ("Hz", "kHz", 1e3),
    ("counts_per_turn", "counts_per_deg", 360.0),
]


@pytest.mark.parametrize(("unit", "other", "scale"), SWAPS)
def test_another_unit_is_converted(load: Load, unit: str, other: str, scale: float) -> None:
    """By factors that stand here once more: the suggestion is the value that was there before."""
    swapped = 0
    for path in LEAVES:
        key = str(path[-1])
        if split(key)[0] + f"_{unit}" != key and key != unit:
            continue
        stem = key.removesuffix(unit)

        def change(node: Any, key: Any, renamed: str = stem + other) -> None:
            node[renamed] = node.pop(key) / scale

        (mistake,) = mistakes_of(load, changed(path, change))
        found = re.match(rf"unknown key; write `{key}: (\S+)`", mistake.text)
        node: Any = TREE
        for step in path:
            node = node[step]
        assert found and math.isclose(float(found[1]), node, rel_tol=1e-9)
        swapped += 1
    assert swapped


@given(st.floats(1e-6, 1e6), st.sampled_from(SWAPS))
def test_a_value_with_its_unit_is_converted(value: float, swap: tuple[str, str, float]) -> None:
    unit, other, scale = swap
    assert factor(f"x_{other}", f"x_{unit}") == pytest.approx(scale, rel=1e-12)
    assert factor(f"x_{unit}", f"x_{other}") == pytest.approx(1 / scale, rel=1e-12)
    text = f"{value!r} {other.replace('_per_', '/').replace('_', ' ')}"
    assert convert(text, f"x_{unit}") == pytest.approx(value * scale, rel=1e-12)


@pytest.mark.parametrize(
    ("key", "stem", "unit"),
    [
        ("margin_us", "margin", "microseconds"),
        ("position_min_rad", "position_min", "rad"),
        ("position_min", "position_min", ""),
        ("ki_Nm_per_rad_s", "ki", "Nm/(rad s)"),
        ("limit_rad_per_s2", "limit", "rad/s^2"),
        ("noise_Nm_or_N_per_s05", "noise", "(Nm or N)/s^0.5"),
        ("start_rad_or_m", "start", "rad or m"),
        ("mass_scale", "mass_scale", ""),
        ("per_s", "per", "seconds"),
        ("_or_".join("m" * 20), "_or_".join("m" * 18) + "_or", "m or m"),
    ],
)
def test_unit_of_a_key(key: str, stem: str, unit: str) -> None:
    assert (split(key)[0], told(key)) == (stem, unit)


@pytest.mark.parametrize(
    ("text", "key", "value"),
    [
        ("250 µs", "margin_us", 250),
        ("90°", "position_min_rad", math.pi / 2),
        ("5 %", "loss", 0.05),
        ("3 rad/s²", "limit_rad_per_s2", 3),
        ("3 deg/s^2", "limit_rad_per_s2", math.pi / 60),
        ("2 N·m", "limit_Nm", 2),
        ("1.5 kΩ", "resistance_ohm", 1500),
        ("12 msec", "margin_us", 12000),
    ],
)
def test_units_as_people_write_them(text: str, key: str, value: float) -> None:
    assert convert(text, key) == pytest.approx(value)


@pytest.mark.parametrize("text", ["12", "ms", "", "12 bananas", "1.2.3 ms", "1" * 10_000 + " ms"])
def test_no_value_with_unit(text: str) -> None:
    assert convert(text, "margin_us") is None


def test_units_that_do_not_compare() -> None:
    assert factor("x_m", "x_rad") is None
    assert factor("x_ms", "x") is None
    assert factor("x_mm", "x_rad_or_m") == pytest.approx(1e-3)
    assert factor("x_percent", "x") == 0.01


def test_aliases_and_merged_keys(load: Load) -> None:
    text = TEXT.replace("motor: {gear: 30", "motor: &motor {gear: 30")
    second = re.sub(r"motor: \{gear: 20.*", "motor: {<<: *motor, gear: 21}", text)
    motors = [axis.motor for axis in load(second).machine.axes]
    assert motors[1] == motors[0].model_copy(update={"gear": 21.0})
    shared = re.sub(r"motor: \{gear: 20.*", "motor: *motor", text)
    motors = [axis.motor for axis in load(shared, "machine.axes.1.motor.gear=5").machine.axes]
    assert [motor.gear for motor in motors] == [30, 5]


def test_a_mistake_is_told_where_it_is_written(load: Load) -> None:
    text = TEXT.replace("motor: {gear: 30", "motor: &motor {gear: -30")
    text = re.sub(r"motor: \{gear: 20.*", "motor: *motor", text)
    line = 1 + text[: text.index("&motor")].count("\n")
    first, second = mistakes_of(load, text)
    assert (first.key[2], second.key[2]) == (0, 1)
    assert first.place.line == second.place.line == line


def test_byte_order_mark_and_line_ends(load: Load) -> None:
    bom = b"\xef\xbb\xbf"
    assert load(bom + TEXT.replace("\n", "\r\n").encode()) == load(TEXT)
    (mistake, *_) = [m for m in mistakes_of(load, bom + b"nmae: x\r\nsed: 3") if m.place.line]
    assert (mistake.place.line, mistake.place.column) == (1, 1)


def test_integers_are_numbers(load: Load) -> None:
    assert load(TEXT, "sim.plant.mass_scale.link1=2").sim.plant.mass_scale["link1"] == 2.0


def test_a_config_error_can_be_pickled(load: Load) -> None:
    with pytest.raises(ConfigError) as caught:
        load(TEXT, "seed=-1", "nmae=x")
    again = pickle.loads(pickle.dumps(caught.value))
    assert (str(again), again.mistakes) == (str(caught.value), caught.value.mistakes)


def test_all_mistakes_at_once(load: Load) -> None:
    text = TEXT.replace("knot_us:", "knots_us:").replace("gear: 30", "gear: -30")
    text = text.replace("kind: sines", "kind: sins").replace("[0.15, 0.15]", "[0.15]")
    mistakes = mistakes_of(load, text, "seed=-1", "mpc.fade_start=1")
    assert [".".join(map(str, mistake.key)) for mistake in mistakes] == [
        "machine.axes.0.motor.gear",
        "loop.knots_us",
        "task.kind",
        "sim.plant.coulomb_Nm_or_N",
        "seed",
        "mpc.fade_start",
    ]


@pytest.mark.parametrize(
    ("override", "value"),
    [
        ("seed=3", lambda c: c.seed == 3),
        ("duration_s=2", lambda c: c.duration_s == 2.0),
        ("duration_s=1e-3", lambda c: c.duration_s == 1e-3),
        (
            "machine.axes.1.servo.kp_Nm_per_rad=9",
            lambda c: c.machine.axes[1].servo.kp == 9,
        ),
        ("machine.axes.1.soft_max_rad=2.5", lambda c: c.machine.axes[1].soft_max == 2.5),
        ("machine.axes.1.soft_max_rad=null", lambda c: c.machine.axes[1].soft_max is None),
        ("mpc.enabled=false", lambda c: c.mpc.enabled is False),
        ("sim.plant.mass_scale.link1=1.5", lambda c: c.sim.plant.mass_scale["link1"] == 1.5),
        ("sim.to_device={loss: 0.5}", lambda c: c.sim.to_device.loss == 0.5),
        ("name='b'", lambda c: c.name == "b"),
        ("mpc.torque_step_weight=[1, 2]", lambda c: c.mpc.torque_step_weight == [1.0, 2.0]),
    ],
)
def test_override(load: Load, override: str, value: Callable[[Config], bool]) -> None:
    assert value(load(TEXT, override))


def test_later_override_wins(load: Load) -> None:
    assert load(TEXT, "seed=1", "seed=2").seed == 2


def test_unreadable(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.yaml", tmp_path / ("x" * 300)):
        with pytest.raises(ConfigError, match="cannot be read"):
            load_config(path)


def test_saved_config_is_the_same(tmp_path: Path) -> None:
    config = load_config(ARM2, ["sim.plant.viscous_scale=0.1234567890123456789", "seed=123"])
    save_config(config, ARM2.parent, tmp_path / "config.yaml")
    again = load_config(tmp_path / "config.yaml")
    assert Path(again.machine.model) == ARM2.parent.parent / "models" / "arm2" / "arm2.xml"
    machine = again.machine.model_copy(update={"model": config.machine.model})
    assert again.model_copy(update={"machine": machine}) == config


def test_saved_config_has_every_key(tmp_path: Path) -> None:
    save_config(load_config(ARM2), ARM2.parent, tmp_path / "config.yaml")
    written = YAML(typ="safe").load((tmp_path / "config.yaml").read_text())
    assert written == load_config(tmp_path / "config.yaml").model_dump(mode="json")


UNITS = re.compile(
    r"_(rad|rad_per_s|rad_per_s2|s|us|Hz|Nm|Nm_per_rad|Nm_per_rad_s|Nm_s_per_rad|V|ohm|Nm_per_A"
    r"|m|m_per_s|m_per_s2|N|N_per_m|N_per_m_s|N_s_per_m|rad_per_m|Nm_or_N|rad_or_m"
    r"|rad_or_m_per_s15|Nm_or_N_per_s05|A|F|ppm|counts|sigma|scale|share|share_end|weight)$"
)
PURE_NUMBERS = {
    "parameters", "sqp_iterations", "coupling",
    "seed", "gear", "counts_per_turn", "counts_per_m", "sample_every", "harmonic", "intervals",
    "max_iterations", "fade_start", "fade_end", "loss", "loss_run", "ports", "reorder",
    "duplicate", "tail", "steps_per_turn", "microsteps",
}  # fmt: skip


def parts(kind: Any) -> Iterator[Any]:
    yield kind
    for inner in get_args(kind):
        yield from parts(inner)


def sections(model: type[Section]) -> Iterator[type[Section]]:
    yield model
    for field in model.model_fields.values():
        for kind in parts(field.annotation):
            if isinstance(kind, type) and issubclass(kind, Section):
                yield from sections(kind)


def numeric(kind: Any) -> bool:
    if get_args(kind):
        return any(numeric(inner) for inner in get_args(kind))
    return kind in (int, float)


def test_every_number_has_its_unit_in_its_name() -> None:
    names = {
        section.key(name)
        for section in sections(Config)
        for name, field in section.model_fields.items()
        if numeric(field.annotation)
    }
    assert len(names) > 60
    assert {n for n in names - PURE_NUMBERS if not UNITS.search(n)} == set()
