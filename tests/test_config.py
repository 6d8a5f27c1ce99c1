"""Configs: whatever is in the file, the answer is a Config or a ConfigError that can be mended."""

import re
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any, get_args

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel
from ruamel.yaml import YAML

from headway.configs.load import SIZE_MAX, ConfigError, load_config
from headway.configs.save import save_config
from headway.configs.schema import Config

ARM2 = Path(__file__).resolve().parent.parent / "configs" / "arm2.yaml"
TEXT = ARM2.read_text()
TREE: dict[str, Any] = YAML(typ="safe").load(TEXT)

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
fuzz = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture
def load(tmp_path: Path) -> Callable[..., Config]:
    """load_config of a text or a tree, from a file config.yaml."""

    def load(content: str | dict[str, Any], *overrides: str) -> Config:
        path = tmp_path / "config.yaml"
        if isinstance(content, str):
            path.write_bytes(content.encode(errors="surrogatepass"))
        else:
            with path.open("w") as file:
                YAML(typ="safe").dump(content, file)
        return load_config(path, list(overrides))

    return load


def places(node: Any) -> Iterator[tuple[Any, Any]]:
    """(container, key or index) of every node of a tree."""
    items = node.items() if isinstance(node, dict) else enumerate(node)
    for key, child in items:
        yield node, key
        if isinstance(child, dict | list):
            yield from places(child)


PLACES = len(list(places(TREE)))


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
def test_mutated_tree(load: Callable[..., Config], mutations: list[tuple[int, str, Any]]) -> None:
    tree = deepcopy(TREE)
    for index, kind, value in mutations:
        found = list(places(tree))
        container, key = found[index % len(found)]
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
    try:
        config = load(tree)
    except ConfigError as error:
        assert "config.yaml" in str(error)
    else:
        assert isinstance(config, Config)


@fuzz
@given(st.integers(0, len(TEXT)), st.integers(0, 20), st.text(max_size=10))
def test_mutated_text(load: Callable[..., Config], start: int, cut: int, pasted: str) -> None:
    try:
        load(TEXT[:start] + pasted + TEXT[start + cut :])
    except ConfigError as error:
        assert "config.yaml" in str(error)


@fuzz
@given(st.text(alphabet=st.sampled_from("abm:.{}[]=&*!- 0129ens\n\"'#"), max_size=25))
def test_any_override(load: Callable[..., Config], override: str) -> None:
    try:
        load(TEXT, override)
    except ConfigError as error:
        assert str(error)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "a config is a mapping of keys"),
        ("- a\n- b\n", "a config is a mapping of keys"),
        ("name: a\nname: b\n", r"config.yaml:2: is not YAML: found duplicate key"),
        ("name: [a\n", r"config.yaml:2: is not YAML"),
        ("name: !!int x\n", "is not YAML: invalid literal"),
        ("name: 2020-99-99\n", "is not YAML: month must be"),
        ("&a name: *a\n---\nname: b", "is not YAML"),
        ("[" * 1000, "is not YAML"),
        ("# much\n" * (SIZE_MAX // 7 + 1), "is too large for a config"),
        ("name: \ud800", r"is not UTF-8 text \(byte 6\)"),
        ("machine: &a {axes: [*a]}\n", "machine.axes"),
        (TEXT.replace("duration_s: 10", "duration_s: .nan"), r"config.yaml:\d+: duration_s: .*nan"),
        (TEXT.replace("duration_s: 10", "duration_s: .inf"), r"config.yaml:\d+: duration_s: .*inf"),
        (TEXT.replace("duration_s: 10", "duration_s: true"), r"duration_s: .*number .*True"),
        (TEXT.replace("duration_s: 10", "duration_s: ten"), r"duration_s: .*number .*'ten'"),
        (TEXT.replace("duration_s: 10", "duration_s: 1" + "0" * 400), r"duration_s: .*000\.\.\."),
        (TEXT.replace("name: arm2", "name: ../arm2"), r"config.yaml:\d+: name: "),
        (TEXT.replace("knot_us: 4096", "knot_us: 4000"), r"loop.knot_us: .*512"),
        (TEXT.replace("jitter_us: 1000", "jitter_us: 9000", 1), "no packet arrives before it left"),
        (TEXT.replace("position_min_rad: -2.8", "position_min_rad: 3"), "must be below"),
    ],
)
def test_mistake_is_told(load: Callable[..., Config], content: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load(content)
    assert all(len(line) < 300 for line in str(caught.value).splitlines())


def test_all_mistakes_at_once(load: Callable[..., Config]) -> None:
    text = TEXT.replace("knot_us:", "knots_us:").replace("gear: 30", "gear: -30")
    text = text.replace("kind: sines", "kind: sins")
    with pytest.raises(ConfigError) as caught:
        load(text, "seed=-1", "mpc.intervals=2")
    lines = str(caught.value).splitlines()
    number = {key: 1 + text[: text.index(key)].count("\n") for key in ("gear", "knots", "sins")}
    assert len(lines) == 5
    told = re.sub(r".*/config.yaml", "config.yaml", "\n".join(lines))
    assert f"config.yaml:{number['gear']}: machine.axes.0.motor.gear: " in told
    assert f"config.yaml:{number['knots']}: loop.knots_us: unknown key (given: 4096)" in told
    assert f"config.yaml:{number['sins']}: task.kind: " in told
    assert "--set seed=-1: seed: " in told
    assert "--set mpc.intervals=2: mpc.intervals: " in told


def test_mistakes_between_keys_at_once(load: Callable[..., Config]) -> None:
    with pytest.raises(ConfigError) as caught:
        load(TEXT, "task.axes=[]", "sim.start_rad=[0.0]", "mpc.horizon_us=100000")
    for message in ("task.axes has 0", "sim.start_rad has 1", "mpc.horizon_us must be a multiple"):
        assert message in str(caught.value)


@pytest.mark.parametrize(
    ("override", "value"),
    [
        ("seed=3", lambda c: c.seed == 3),
        ("duration_s=2", lambda c: c.duration_s == 2.0),
        ("duration_s=1e-3", lambda c: c.duration_s == 1e-3),
        (
            "machine.axes.1.servo.kp_Nm_per_rad=9",
            lambda c: c.machine.axes[1].servo.kp_Nm_per_rad == 9,
        ),
        ("mpc.soft_max_rad=[1, 2.5]", lambda c: c.mpc.soft_max_rad == [1.0, 2.5]),
        ("mpc.soft_max_rad=null", lambda c: c.mpc.soft_max_rad is None),
        ("mpc.enabled=false", lambda c: c.mpc.enabled is False),
        ("sim.plant.mass_scale.link1=1.5", lambda c: c.sim.plant.mass_scale["link1"] == 1.5),
        ("sim.to_device={loss: 0.5}", lambda c: c.sim.to_device.loss == 0.5),
        ("name=a=b", None),
        ("", None),
        ("seed", None),
        ("=3", None),
        ("seed=", None),
        ("seed=[", None),
        ("seed.x=3", None),
        ("sed=3", None),
        ("loop..margin_us=3", None),
        ("machine.axes.2.joint=q3", None),
        ("machine.axes.first.joint=q3", None),
        ("seed=1.5", None),
        ("mpc.enabled=maybe", None),
    ],
)
def test_override(
    load: Callable[..., Config], override: str, value: Callable[[Config], bool] | None
) -> None:
    if value is None:
        with pytest.raises(ConfigError, match=re.escape(f"--set {override}")):
            load(TEXT, override)
    else:
        assert value(load(TEXT, override))


def test_later_override_wins(load: Callable[..., Config]) -> None:
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
    r"_(rad|rad_per_s|rad_per_s2|rad_per_s15|s|us|Hz|Nm|Nm_per_rad|Nm_per_rad_s|Nm_s_per_rad|V|ohm"
    r"|Nm_per_A|Nm_per_s05|ppm|counts|counts_per_turn|sigma|scale|share|share_end|weight)$"
)
PURE_NUMBERS = {
    "seed", "gear", "counts_per_turn", "sample_every", "harmonic", "intervals", "max_iterations",
    "fade_start", "fade_end", "loss", "reorder",
}  # fmt: skip


def sections(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    yield model
    for field in model.model_fields.values():
        for kind in (field.annotation, *get_args(field.annotation)):
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                yield from sections(kind)


def numeric(kind: Any) -> bool:
    if get_args(kind):
        return any(numeric(inner) for inner in get_args(kind))
    return kind in (int, float)


def test_every_number_has_its_unit_in_its_name() -> None:
    names = {
        name
        for section in sections(Config)
        for name, field in section.model_fields.items()
        if numeric(field.annotation)
    }
    assert len(names) > 40
    assert {n for n in names - PURE_NUMBERS if not UNITS.search(n)} == set()
