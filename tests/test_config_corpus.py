"""Broken configs, by the kind of mistake: what `headway run` says, where, and that it stops."""

import itertools
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from headway.cli.main import main
from headway.configs.mistakes.source import SIZE_MAX

MODEL = Path(__file__).resolve().parent.parent / "models" / "arm2" / "arm2.xml"
COMMAND = Path(sys.executable).with_name("headway")

GOOD = f"""\
name: bench
machine:
  model: '{MODEL}'
  axes:
    - joint: q1
      counts_per_turn: 40000
      position_min_rad: -2.8
      position_max_rad: 2.8
      velocity_limit_rad_per_s: 12
      acceleration_limit_rad_per_s2: 250
      torque_limit_Nm: 12
      motor: {{gear: 30, torque_constant_Nm_per_A: 0.08, resistance_ohm: 2.0, supply_V: 48}}
      servo: {{kp_Nm_per_rad: 120, kd_Nm_s_per_rad: 6}}
    - joint: q2
      counts_per_turn: 40000
      position_min_rad: -2.6
      position_max_rad: 2.6
      velocity_limit_rad_per_s: 15
      acceleration_limit_rad_per_s2: 400
      torque_limit_Nm: 6
      motor: {{gear: 20, torque_constant_Nm_per_A: 0.06, resistance_ohm: 2.0, supply_V: 48}}
      servo: {{kp_Nm_per_rad: 60, kd_Nm_s_per_rad: 2}}
loop:
  knot_us: 4096
  margin_us: 12288
task:
  kind: sines
  frequency_Hz: 0.45
  axes:
    - {{offset_rad: 0.7, amplitude_rad: 0.8}}
    - {{offset_rad: 0.6, amplitude_rad: 0.7, harmonic: 2}}
sim:
  compute_us: 2500
  plant:
    coulomb_Nm_or_N: [0.15, 0.15]
"""
RANGE_OF_Q1 = "      position_min_rad: -2.8\n      position_max_rad: 2.8\n"
RANGE_MARGIN = "must be a whole number from 1024 to 200000, in microseconds"


@dataclass(frozen=True)
class Broken:
    """A config, or changes of the good one; and what has to be told of each mistake, in order.

    Each mistake is told at a line and column (or None) with a text that holds all the fragments.
    """

    name: str
    content: str | bytes
    mistakes: tuple[tuple[str | None, tuple[str, ...]], ...]
    sets: tuple[str, ...] = ()


def edit(name: str, old: str, new: str, *mistakes: tuple[str | None, *tuple[str, ...]]) -> Broken:
    assert old in GOOD
    return Broken(name, GOOD.replace(old, new, 1), tuple((m[0], m[1:]) for m in mistakes))


def whole(name: str, content: str | bytes, place: str | None, *fragments: str) -> Broken:
    return Broken(name, content, ((place, fragments),))


def override(text: str, *fragments: str) -> Broken:
    return Broken(f"--set {text}", GOOD, ((f"--set {text}", fragments),), (text,))


UNITS = [
    edit(
        "ms for us",
        "margin_us: 12288",
        "margin_ms: 8",
        ("25:3", "loop.margin_ms: unknown key; write `margin_us: 8000`", "is in microseconds)"),
    ),
    edit("s for us", "margin_us: 12288", "margin_s: 0.0125", ("25:3", "`margin_us: 12500`")),
    edit(
        "no unit", "margin_us: 12288", "margin: 8", ("25:3", "did you mean `margin_us`, in micro")
    ),
    edit(
        "converted, but too much",
        "margin_us: 12288",
        "margin_ms: 8000",
        ("25:3", "did you mean `margin_us`, a whole number from 1024 to 200000"),
    ),
    edit(
        "deg for rad",
        "position_min_rad: -2.8",
        "position_min_deg: -90",
        ("7:7", "machine.axes.0.position_min_deg", "`position_min_rad: -1.57079632679`"),
    ),
    edit(
        "rpm for rad/s",
        "velocity_limit_rad_per_s: 12",
        "velocity_limit_rpm: 60",
        ("9:7", "`velocity_limit_rad_per_s: 6.28318530718`", "in rad/s)"),
    ),
    edit(
        "deg/s^2 for rad/s^2",
        "acceleration_limit_rad_per_s2: 250",
        "acceleration_limit_deg_per_s2: 18000",
        ("10:7", "`acceleration_limit_rad_per_s2: 314.159265359`", "in rad/s^2)"),
    ),
    edit(
        "mNm for Nm",
        "torque_limit_Nm: 12",
        "torque_limit_mNm: 12000",
        ("11:7", "`torque_limit_Nm: 12`"),
    ),
    edit(
        "mNm/A for Nm/A",
        "torque_constant_Nm_per_A: 0.08",
        "torque_constant_mNm_per_A: 80",
        ("12:25", "machine.axes.0.motor.", "`torque_constant_Nm_per_A: 0.08`", "in Nm/A)"),
    ),
    edit("mohm for ohm", "resistance_ohm: 2.0", "resistance_mohm: 900", ("12:57", "_ohm: 0.9`")),
    edit(
        "Nm/deg for Nm/rad",
        "kp_Nm_per_rad: 120",
        "kp_Nm_per_deg: 2",
        ("13:15", "`kp_Nm_per_rad: 114.591559026`"),
    ),
    edit("counts per revolution", "counts_per_turn", "counts_per_rev", ("6:7", "_turn: 40000`")),
    edit("kHz for Hz", "frequency_Hz: 0.45", "frequency_kHz: 0.002", ("28:3", "_Hz: 2`")),
    edit("another spelling", "margin_us: 12288", "margin_usec: 8192", ("25:3", "_us: 8192`")),
    edit(
        "a list in another unit",
        "coulomb_Nm_or_N: [0.15, 0.15]",
        "coulomb_mNm: [150, 200]",
        ("35:5", "sim.plant.coulomb_mNm", "`coulomb_Nm_or_N: [0.15, 0.2]`", "in Nm or N)"),
    ),
    edit(
        "percent for a share",
        "compute_us: 2500",
        "outlier_share_percent: 5",
        ("33:3", "sim.outlier_share_percent: unknown key; write `outlier_share: 0.05`", "no unit"),
    ),
    edit(
        "a unit with the value",
        "margin_us: 12288",
        "margin_us: 12 ms",
        ("25:14", f"loop.margin_us: {RANGE_MARGIN} (given: '12 ms'); write 12000"),
    ),
    edit("degrees with the value", "-2.8", "-90°", ("7:25", "'-90°'); write -1.57079632679")),
]

KEYS = [
    edit(
        "misspelled", "margin_us", "margn_us", ("25:3", "loop.margn_us: unk", "mean `margin_us`?")
    ),
    edit("misspelled section", "\nloop:", "\nlop:", ("23:1", "lop: unknown key", "mean `loop`?")),
    edit("upper case", "joint: q1", "Joint: q1", ("5:7", "did you mean `joint`?")),
    edit("with a dash", "margin_us", "margin-us", ("25:3", "did you mean `margin_us`?")),
    edit("beginning only", "supply_V", "supply", ("12:78", "did you mean `supply_V`, in V?")),
    edit(
        "of another section",
        "  margin_us: 12288\n",
        "  margin_us: 12288\nmargin_us: 12288\n",
        ("26:1", "margin_us: unknown key; `margin_us` belongs under `loop`"),
    ),
    edit(
        "of a part of the same axis",
        "      motor: {gear: 30, ",
        "      gear: 30\n      motor: {",
        ("12:7", "machine.axes.0.gear: unknown key; `gear` belongs under `machine.axes.0.motor`"),
    ),
    edit(
        "of two other sections",
        "compute_us: 2500",
        "jitter_us: 1000",
        ("33:3", "`jitter_us` belongs under `sim.to_device` or `sim.to_host`"),
    ),
    edit(
        "of another list",
        "gear: 30, ",
        "gear: 30, amplitude_rad: 1, ",
        ("12:25", "`amplitude_rad` belongs under `task.axes.N`"),
    ),
    edit(
        "the beginning of one",
        "sim:\n",
        "estimator: {gate: 3}\nsim:\n",
        ("32:13", "estimator.gate: unknown key; did you mean `gate_sigma`?"),
    ),
    edit(
        "of the top",
        "compute_us: 2500",
        "duration_s: 3",
        ("33:3", "sim.duration_s: unknown key; `duration_s` belongs at the top"),
    ),
    edit(
        "with dots, as for --set",
        "compute_us: 2500",
        "loop.margin_us: 8192",
        ("33:3", "sim.loop.margin_us: unknown key; `margin_us` belongs under `loop`"),
    ),
    edit(
        "in another unit and section",
        "name: bench",
        "name: bench\nmargin_ms: 12",
        ("2:1", "margin_ms: unknown key; did you mean `margin_us` under `loop`?"),
    ),
    edit(
        "like none",
        "compute_us: 2500",
        "zzz: 1",
        ("33:3", "sim.zzz: unknown key; sim has plant, network, to_device, to_host, clocks"),
    ),
    edit(
        "given in two units",
        "margin_us: 12288",
        "margin_us: 12288\n  margin_ms: 12",
        ("26:3", "loop.margin_ms: unknown key; `margin_us` is given as well: keep one"),
    ),
    edit(
        "twice",
        "margin_us: 12288",
        "margin_us: 12288\n  knot_us: 2048",
        ("26:3", "loop.knot_us: this key is given twice, first in line 24: remove one"),
    ),
    edit(
        "missing",
        "  margin_us: 12288\n",
        "",
        ("23:1", "loop.margin_us: missing: a whole number", "for example `margin_us: "),
    ),
    edit(
        "missing in a list",
        "gear: 30, ",
        "",
        ("12:7", "machine.axes.0.motor.gear: missing: a number", "for example `gear: "),
    ),
    edit(
        "missing section",
        "loop:\n  knot_us: 4096\n  margin_us: 12288\n",
        "",
        (None, "loop: missing: a section with knot_us, margin_us and gains; for example `loop: {"),
    ),
    edit("missing name", "name: bench\n", "", (None, "name: missing: text of 1 to 25 characters")),
    edit("no key", "compute_us: 2500", ": 2500", ("33:3", "sim: a key is a word, as `name` in")),
    edit("no word", "compute_us", '"a\\nb"', ("33:3", "sim: a key is a word")),
    edit("a list as key", "compute_us: 2500", "[a]: 2500", ("33:3", "sim: a key is a word")),
    edit(
        "not below a section",
        "loop:\n  knot_us: 4096\n  margin_us: 12288\n",
        "loop:\nknot_us: 4096\nmargin_us: 12288\n",
        ("23:1", "loop: must be a section with knot_us, margin_us and gains (given: nothing)"),
        ("24:1", "knot_us: unknown key; `knot_us` belongs under `loop`"),
        ("25:1", "margin_us: unknown key; `margin_us` belongs under `loop`"),
    ),
]

VALUES = [
    edit("true for a number", "12288", "true", ("25:14", f"{RANGE_MARGIN} (given: true)")),
    edit("text for a number", "frequency_Hz: 0.45", "frequency_Hz: fast", ("28:17", "'fast'")),
    edit("quotes", "12288", "'12288'", ("25:14", "(given: '12288'); write 12288 without quotes")),
    edit("decimal comma", "0.45", "0,45", ("28:17", "(given: '0,45'); write 0.45")),
    edit("commas between digits", "12288", "12,288", ("25:14", "'12,288'); write 12288")),
    edit("underscores", "12288", "12_288", ("25:14", "(given: '12_288'); write 12288")),
    edit("fraction", "12288", "12288.5", ("25:14", f"{RANGE_MARGIN} (given: 12288.5)")),
    edit("1e4 for an integer", "12288", "1e4", ("25:14", "(given: 10000.0); write 10000")),
    edit("too small", "12288", "12", ("25:14", f"{RANGE_MARGIN} (given: 12)")),
    edit("negative", "gear: 30", "gear: -30", ("12:21", "from 1e-9 to 1e12 (given: -30)")),
    edit(
        "NaN",
        "0.45",
        ".nan",
        ("28:17", "must be a number from 1e-9 to 1e12, in Hz, or null (given: .nan)"),
    ),
    edit("infinite", "0.45", "-.inf", ("28:17", "(given: -.inf)")),
    edit("NaN as in Python", "0.45", "nan", ("28:17", "(given: 'nan')")),
    edit("huge integer", "12288", "9" * 5000, ("25:14", f"{RANGE_MARGIN} (given: .inf)")),
    edit("huge number", "0.45", "1e400", ("28:17", "(given: .inf)")),
    edit("long text", "0.45", "x" * 3000, ("28:17", "(given: '" + 60 * "x" + "...')")),
    edit("null", "knot_us: 4096", "knot_us:", ("24:3", "(given: nothing)")),
    edit(
        "a kind's key is missing",
        "frequency_Hz: 0.45",
        "frequency_Hz:",
        ("26:1", "a task of the kind sines needs frequency_Hz"),
    ),
    edit(
        "a list of one", "gear: 30", "gear: [30]", ("12:15", "a list of 1); write 30 without brack")
    ),
    edit("a section for a number", "12288", "{us: 12}", ("25:3", "(given: a section with us)")),
    edit("a date", "12288", "2026-01-31", ("25:14", "(given: '2026-01-31')")),
    edit("not on the list", "4096", "4000", ("24:12", "512, 1024, 2048, 4096", "; write 4096")),
    edit("a misspelled word", "sines", "sins", ("27:9", "task.kind", "'sins'); write sines")),
    edit("yes", "compute_us: 2500", "compute_us: yes", ("33:15", "whole number", "'yes'")),
    edit(
        "yes for true",
        "sim:\n",
        "mpc: {enabled: yes, feedforward: modle}\nsim:\n",
        ("32:16", "mpc.enabled: must be true or false (given: 'yes'); write true"),
        ("32:34", "mpc.feedforward: must be none or model (given: 'modle'); write model"),
    ),
    edit("a number for text", "joint: q1", "joint: 1", ("5:14", 'given: 1); write "1", in quotes')),
    edit("bad characters", "bench", "my bench", ("1:7", "1 to 25 characters: A-Z, a-z, 0-9, _")),
    edit(
        "a list too long",
        "[0.15, 0.15]",
        "[0.1, 0.2, 0.3]",
        ("35:5", "sim.plant.coulomb_Nm_or_N: has 3 entries; the machine has 2 axes"),
    ),
    edit("no list", "[0.15, 0.15]", "0.15", ("35:22", "must be a list, each entry a number")),
    edit(
        "wrong entry", "[0.15, 0.15]", "[0.15, x]", ("35:29", "sim.plant.coulomb_Nm_or_N.1: must")
    ),
    edit(
        "number or list", "sim:\n", "mpc: {torque_step_weight: [1, x]}\nsim:\n", ("32:31", ".1: ")
    ),
    edit("range", "-2.8", "2.9", ("7:25", "position_min_rad: must be below position_max_rad")),
    edit(
        "continuous, with a range",
        "position_max_rad: 2.8",
        "position_max_rad: 2.8\n      soft_max_rad: 2\n      continuous: true",
        ("7:25", "machine.axes.0.position_min_rad: is for axes that end somewhere: remove it, or"),
        ("8:25", "machine.axes.0.position_max_rad: is for", "remove it, or continuous: true"),
        ("9:21", "machine.axes.0.soft_max_rad: is for axes that end somewhere: remove it"),
    ),
    edit(
        "neither continuous nor a range",
        f"{RANGE_OF_Q1}",
        "      continuous: false\n",
        (
            "5:7",
            "position_min_rad: missing: a number, in rad; for",
            "continuous: true, if it turns",
        ),
        ("5:7", "machine.axes.0.position_max_rad: missing: a number, in rad; for example `pos"),
    ),
    edit(
        "continuous, with a mechanical stop",
        f"{RANGE_OF_Q1}",
        "      continuous: true\n      homing: {method: stop, mark_rad: 0, speed_rad_per_s: 1, "
        "torque_Nm: 1, way_rad: 7}\n",
        ("8:24", "homing.method: is stop, but an axis with continuous: true has", "use index or"),
    ),
    edit(
        "no word for continuous",
        f"{RANGE_OF_Q1}",
        "      continuous: yes\n",
        ("7:19", "continuous: must be true or false (given: 'yes'); write true"),
    ),
    edit(
        "turning on within a range",
        "amplitude_rad: 0.8",
        "rate_rad_per_s: 1, amplitude_rad: 0.8",
        ("30:41", "task.axes.0.rate_rad_per_s: would take q1 out of its range: remove it, or"),
    ),
    Broken(
        "further than its encoder counts",
        GOOD.replace(RANGE_OF_Q1, "      continuous: true\n").replace("0.7,", "4e5,"),
        (("29:7", ("task.axes.0: q1 would start at 400000 rad", "begin between -337326 and")),),
    ),
    edit(
        "two that do not fit",
        "name: bench",
        "name: bench\nmpc: {fade_start: 0.9, fade_end: 0.1}",
        ("2:19", "mpc.fade_start: must be below mpc.fade_end (given: 0.9)"),
    ),
    edit(
        "axes of two kinds", "gear: 30", "gear_rad_per_m: 9", ("10:38", "of rotary axes and", "use")
    ),
    edit(
        "no model", "arm2.xml", "arm3.xml", ("3:10", "machine.model: there is no file", "arm2.xml?")
    ),
    edit(
        "a folder as model", f"{MODEL}", f"{MODEL.parent}", ("3:10", "machine.model: there is no")
    ),
]

LINEAR = GOOD.replace(
    GOOD[GOOD.index("      counts_per_turn") : GOOD.index("    - joint: q2")],
    """\
      counts_per_m: 1000000
      position_min_m: -0.1
      position_max_m: 0.1
      velocity_limit_m_per_s: 0.5
      acceleration_limit_m_per_s2: 5
      force_limit_N: 200
      motor: {gear_rad_per_m: 99, torque_constant_Nm_per_A: 0.08, resistance_ohm: 2.0, supply_V: 48}
      servo: {kp_N_per_m: 10000, kd_N_s_per_m: 1000}
""",
).replace("{offset_rad: 0.7, amplitude_rad: 0.8}", "{amplitude_m: 0.05}")
LINEAR_IN_MM = re.sub("_m(?=:|_per)|_per_m(?=:)", lambda found: found[0] + "m", LINEAR)

MANY = [
    Broken(
        "a linear axis in mm",
        LINEAR_IN_MM,
        (
            ("6:7", ("counts_per_mm: unknown key; write `counts_per_m: 1e9`",)),
            ("7:7", ("write `position_min_m: -0.0001`",)),
            ("8:7", ("write `position_max_m: 0.0001`",)),
            ("9:7", ("write `velocity_limit_m_per_s: 0.0005`",)),
            ("10:7", ("write `acceleration_limit_m_per_s2: 0.005`",)),
            ("12:15", ("write `gear_rad_per_m: 99000`",)),
            ("13:15", ("write `kp_N_per_m: 1e7`",)),
            ("13:35", ("write `kd_N_s_per_m: 1e6`",)),
            ("30:8", ("write `amplitude_m: 5e-5`",)),
        ),
    ),
    Broken(
        "a key of a rotary axis in a linear one",
        LINEAR.replace("position_min_m", "position_min_rad"),
        (("7:25", ("position_min_rad: is a key of rotary axes and", "of linear ones: use")),),
    ),
    Broken(
        "a continuous slide",
        LINEAR.replace("      position_min_m", "      continuous: true\n      position_min_m"),
        (("7:19", ("axes.0.continuous: is for rotary axes alone: a slide ends, so remove it",)),),
    ),
    edit(
        "several",
        "name: bench",
        "name: my bench\nsed: 3\nmpc: {intervals: 2}",
        ("1:7", "name: must be"),
        ("2:1", "sed: unknown key; did you mean `seed`?"),
        ("3:18", "mpc.intervals: must be a whole number from 4 to 200 (given: 2)"),
    ),
    edit(
        "in a misspelled section, too",
        "loop:\n  knot_us: 4096\n  margin_us: 12288\n",
        "lop:\n  knot_us: 4000\n  margin_ms: 8\n",
        ("23:1", "lop: unknown key; did you mean `loop`?"),
        ("24:12", "loop.knot_us: must be 512, 1024"),
        ("25:3", "loop.margin_ms: unknown key; write `margin_us: 8000`"),
    ),
    edit(
        "of one key, of a section and of all",
        "position_min_rad: -2.8\n      position_max_rad: 2.8",
        "position_min_rad: 2.9\n      position_max_rad: 2.8\n      colour: red",
        ("7:25", "must be below position_max_rad"),
        ("9:7", "machine.axes.0.colour: unknown key"),
    ),
    Broken(
        "in the file and in --set",
        GOOD.replace("margin_us: 12288", "margin_ms: 8").replace("0.15, 0.15", "0.15"),
        (
            ("25:3", ("loop.margin_ms: unknown key",)),
            ("35:5", ("has 1 entries; the machine has 2 axes",)),
            ("--set seed=-1", ("seed: must be",)),
            ("--set nmae=x", ("nmae: unknown key; did you mean `name`?",)),
        ),
        ("seed=-1", "nmae=x"),
    ),
]

SYNTAX = [
    edit(
        "no space after a colon", "margin_us: 1", "margin_us:1", ("25:3", "a key needs `: ` after")
    ),
    edit("a colon too many", "knot_us: 4096", "knot_us: a: b", ("24:13", "this `:` does not fit")),
    edit("tab", "  margin_us", "\tmargin_us", ("25:1", "is not YAML: a tab: indent with spaces")),
    edit("indented too far", "  margin_us", "   margin_us", ("25:13", "check its indentation")),
    edit(
        "indented too little", "  margin_us", " margin_us", ("25:2", "indent it like its neighbour")
    ),
    edit(
        "open bracket", "[0.15, 0.15]", "[0.15, 0.15", ("35:22", "no end: a `]` or a comma is mis")
    ),
    edit("open brace", "_rad: 0.8}", "_rad: 0.8", ("30:7", "a `}` or a comma", "in line 31 at")),
    edit(
        "a brace too many", "_rad: 0.8}", "_rad: 0.8}}", ("30:44", "indent it like its neighbours")
    ),
    edit("a comma too many", "[0.15, 0.15]", "[0.15,, 1]", ("35:28", "missing before this `,`")),
    edit("open quote", "bench", '"bench', ("1:7", "the quote that begins here has no end")),
    edit("backslash", "bench", '"C:\\q"', ("1:11", "`\\q` means nothing in double quotes")),
    edit("at sign", "bench", "@bench", ("1:7", "no value begins with `@`: put it into quotes")),
    edit(
        "a list in a line", "kind: sines", "kind: - sines", ("27:9", "a list's `- ` begins a line")
    ),
    edit("two documents", "\ntask:", "\n---\ntask:", ("26:1", "a second document begins here")),
    edit("a tag", "bench", "!!python/object:os.system x", ("1:7", "the tag !!python/object:os.sy")),
    edit(
        "a standard tag", "12288", "!!int 12288", ("25:14", "loop.margin_us: the tag !!int has no")
    ),
    edit("no anchor", "12288", "*margin", ("25:14", "loop.margin_us: *margin repeats what has no")),
    edit(
        "an endless alias",
        "sim:\n  compute_us: 2500",
        "sim: &a\n  compute_us: *a",
        ("33:15", "end"),
    ),
    edit(
        "merging a number", "kind: sines", "kind: sines\n  <<: 3", ("28:7", "task: `<<` takes in")
    ),
    edit("a control character", "bench", "be\x07nch", ("1:9", "character '\\x07' is not allowed")),
    edit("an impossible escape", "bench", '"\\UFFFFFFFF"', ("1:1", "an escape in double quotes")),
    whole(
        "truncated",
        GOOD[: GOOD.index("resistance_ohm")],
        "12:57",
        "a value or a closing bracket is missing",
    ),
    whole("empty", "", None, "is empty: start from a copy of configs/arm2.yaml"),
    whole("comments only", "# name: bench\n", None, "is empty: start from a copy"),
    whole("a list", "- name: bench\n", None, "is a list: a config is a section of keys"),
    whole("a scalar", "name:bench\n", None, "is a single value: a config", "`: ` after it"),
    whole("brackets", "[" * 100_000, "1:33", "is nested deeper than 32 levels"),
    whole("dashes", "- " * 90_000, "1:65", "is nested deeper than 32 levels"),
    whole("UTF-16", GOOD.encode("utf-16"), None, "is UTF-16 text: save it as UTF-8"),
    whole("UTF-16 without BOM", GOOD.encode("utf-16-le"), None, "save it as UTF-8 text"),
    whole("Latin-1", GOOD.replace("q2", "qé").encode("latin-1"), "14:15", "byte 0xe9 is not UTF-8"),
    whole("binary", bytes(range(256)) * 9, None, "is not text, or not UTF-8: it has zero bytes"),
    whole(
        "large", b"abc: def\n" * 1_200_000, None, f"is too large for a config: more than {SIZE_MAX}"
    ),
    whole("many entries", "x: [" + "1," * 20_000 + "]", "1:20003", "more than 10000 entries"),
    whole("the same key", "a: 1\n" * 20_000, "10000:4", "has more than 10000 entries"),
    whole(
        "a billion laughs",
        "a: &a [x, x, x, x, x, x, x, x, x]\n"
        + "".join(
            f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in itertools.pairwise("abcdefghi")
        ),
        "5:12",
        "has more than 10000 entries",
    ),
]

OVERRIDES = [
    override("loop.margin_ms=8", "loop.margin_ms: unknown key; write `loop.margin_us=8000`"),
    override("margin_us=8192", "margin_us: unknown key; `margin_us` belongs under `loop`"),
    override(
        "loop.margin_us=12 ms", f"loop.margin_us: {RANGE_MARGIN} (given: '12 ms'); write 12000"
    ),
    override(
        "machine.axes.2.joint=q3", "machine.axes.2: no such entry: the first is machine.axes.0"
    ),
    override(
        "machine.axes.-1.joint=q", "machine.axes.-1: no such entry", "the last machine.axes.1"
    ),
    override("machine.axes.first.joint=q", "machine.axes.first: no such entry"),
    override("machine.axs.0.joint=q", "machine.axs: unknown key; did you mean `axes`?"),
    override(
        "machine.axes.0.motr.gear=9", "machine.axes.0.motr: unknown key; did you mean `motor`?"
    ),
    override("name.x=3", "name.x: name is 'bench', and nothing is below it"),
    override("loop.margin_us", "write key.path=value, like --set loop.margin_us=8192"),
    override("=3", "write key.path=value"),
    override("loop..margin_us=3", "write key.path=value"),
    override("a." * 40 + "b=1", "write key.path=value"),
    override(
        "seed=", "seed: must be a whole number from 0 to 9223372036854775807 (given: nothing)"
    ),
    override("seed=[", "is not YAML: a value or a closing bracket is missing"),
    override(
        "sim.network=token-ring", "sim.network: must be channels, usb, usb-iid, lan, wifi or aw"
    ),
    override(
        "sim={network: usb, to_host: {loss: 0.5}}",
        "network: is usb, which says what the wires do, and to_host is given as well: leave to_ho",
    ),
    override(
        "sim={to_host: {frame_us: 125}, to_device: {frame_us: 1000}}",
        "to_device.frame_us: is 1000 and to_host.frame_us 125; a bus has one frame: make them",
    ),
    override(
        "sim.to_host={slot_us: 5}", "slot_us: lies in the frame: it must be less than frame_us"
    ),
    override(
        "sim.to_host={tail: 0.1}", "tail: is a share of packets, and tail_us how late they are"
    ),
    override(
        "sim.to_host.bandwidth_kbit_per_s=12",
        "sim.to_host.bandwidth_kbit_per_s: unknown key; did you mean `bandwidth_bit_per_s`?",
    ),
    override(
        "sim.mishaps=[{kind: clock_step, at_s: 1}]", "a clock_step needs a step_us other than 0"
    ),
    override(
        "sim.mishaps=[{kind: host_clock_step, at_s: 1, step_us: 5, joint: q1}]",
        "a host_clock_step happens to the host: leave joint out",
    ),
    override("sim.to_device={los: 0.5}", "sim.to_device.los: unknown key; did you mean `loss`?"),
    override(
        "machine.model=none.xml", "machine.model: there is no file", "starts at the config's fol"
    ),
    override("sync.method=mean", "sync.method: must be bounds or average (given: 'mean')"),
    override(
        "sync.limit_us=5", "sync.limit_us: must be a whole number from 10 to 1000000, in micro"
    ),
    override("sync.limit_ms=2", "sync.limit_ms: unknown key; write `sync.limit_us=2000`"),
    override("sync.drift_ppm=0", "sync.drift_ppm: must be a number above 0 and up to 300, in ppm"),
    override("sync.drift_ppm=301", "sync.drift_ppm: must be a number above 0 and up to 300"),
    override("sync.wander_ppm_per_s=61", "sync.wander_ppm_per_s: must be a number above 0 and up"),
    override("sync.to_device_least_us=-1", "sync.to_device_least_us: must be a whole number from"),
    override("sync.to_host_least_us=1000001", "sync.to_host_least_us: must be a whole number"),
    override("sync.least_us=5", "sync.least_us: unknown key"),
]

CORPUS = UNITS + KEYS + VALUES + MANY + SYNTAX + OVERRIDES
AS_PROCESS = ("ms for us", "several", "brackets", "UTF-16", "--set loop.margin_ms=8")


def write(broken: Broken) -> None:
    content = broken.content
    Path("config.yaml").write_bytes(content if isinstance(content, bytes) else content.encode())


def check(broken: Broken, code: int, out: str, err: str) -> None:
    """One line for each mistake, with its place and what helps; nothing else is said or done."""
    assert (code, out) == (2, "")
    assert [path.name for path in Path().iterdir()] == ["config.yaml"]
    lines = err.splitlines()
    assert len(lines) == len(broken.mistakes), err
    for line, (place, fragments) in zip(lines, broken.mistakes, strict=True):
        if place is None:
            assert line.startswith("config.yaml: ")
        else:
            prefix = place if place.startswith("--set ") else f"config.yaml:{place}"
            assert line.startswith(f"{prefix}: "[:100])
        for fragment in fragments:
            assert fragment in line
        assert len(line) < 500 + len(str(MODEL))


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_names() -> None:
    assert len({broken.name for broken in CORPUS}) == len(CORPUS) > 100


@pytest.mark.parametrize("broken", CORPUS, ids=lambda broken: broken.name[:40])
def test_broken_config(broken: Broken, capfd: pytest.CaptureFixture[str]) -> None:
    write(broken)
    code = main(["run", "config.yaml", *(f"--set={text}" for text in broken.sets)])
    out, err = capfd.readouterr()
    check(broken, code, out, err)


@pytest.mark.parametrize(
    "broken", [b for b in CORPUS if b.name in AS_PROCESS], ids=lambda broken: broken.name
)
def test_broken_config_as_a_process(broken: Broken) -> None:
    write(broken)
    command = [COMMAND, "run", "config.yaml", *(f"--set={text}" for text in broken.sets)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    check(broken, done.returncode, done.stdout, done.stderr)


def test_no_file(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    Path("machine.yaml").write_text(GOOD)
    assert main(["run", "machin.yaml"]) == 2
    told = f"there is no such file in {tmp_path}; did you mean machine.yaml?\n"
    assert capfd.readouterr().err == f"machin.yaml: cannot be read: {told}"


def test_a_folder(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "."]) == 2
    assert capfd.readouterr().err == ".: cannot be read: it is a folder; name a file in it\n"


@pytest.mark.parametrize(
    "error", [PermissionError(13, "Permission denied"), OSError(5, "I/O error")]
)
def test_not_readable(
    error: OSError, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole_open = Path.open

    def refuse(path: Path, *args: Any, **options: Any) -> Any:
        if path == Path("config.yaml"):
            raise error
        return whole_open(path, *args, **options)

    monkeypatch.setattr(Path, "open", refuse)
    assert main(["run", "config.yaml"]) == 2
    told = capfd.readouterr().err
    assert f"config.yaml: cannot be read: {error.strerror}; check the path" in told


def test_twenty_mistakes_are_told(capfd: pytest.CaptureFixture[str]) -> None:
    Path("config.yaml").write_text(GOOD + "".join(f"zz{i}: {i}\n" for i in range(25)))
    assert main(["run", "config.yaml"]) == 2
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 21
    assert lines[19].startswith("config.yaml:55:1: zz19: unknown key")
    assert lines[20] == "... and 5 more mistakes"


def test_the_good_one_is_good() -> None:
    Path("config.yaml").write_text(GOOD)
    assert main(["run", "config.yaml", "--duration", "0.01", "--out", "out"]) == 0
