"""Plants one bug after the other in a copy of the checkout; a named test has to fail at each.

planted.py [WORD ...]: all bugs, or those whose names contain one of the words. The copy is built
apart from the checkout and imported instead of it. Progress goes to standard error; a table and the
count go to standard output. Exits 0 if every bug was caught: its test passes without it, and with
it fails an assertion.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BIN = Path(sys.executable).parent  # of the virtual environment: cmake and ninja lie there too
LIMIT_S = 300  # for one run of pytest
FAILED = 1  # pytest's exit code; other errors have other codes
WHERE = """
import headway, headway.controller.loop, headway.cli, headway.sim.plant
from headway.firmware import _core
from headway.sim import _board
print(headway.__path__)
for module in (headway.controller.loop, headway.cli, headway.sim.plant, _core, _board):
    print(module.__file__)
"""


@dataclass(frozen=True)
class Bug:
    """One replacement in one file, and the test that notices it."""

    name: str
    file: str
    old: str
    new: str
    test: str


BUGS = (
    Bug(
        "a knot off by one",
        "firmware/track.h",
        "uint32_t knot = low >> knot_shift | high << (32 - knot_shift);",
        "uint32_t knot = (low >> knot_shift | high << (32 - knot_shift)) + 1;",
        "tests/test_track_spline.py::test_dense_random_splines",
    ),
    Bug(
        "clock steered away",  # from the middle of what the stamps allow
        "firmware/sync.c",
        "bounds_middle_q16(bounds)) - offset_q16;",
        "bounds_middle_q16(bounds)) * -1 + offset_q16;",
        "tests/test_device_states.py::test_syncs_to_the_hosts_time",
    ),
    Bug(
        "clock steps above UNSYNCED",
        "firmware/device.c",
        "settings, clock, device->state == DEVICE_UNSYNCED)) {",
        "settings, clock, device->state >= DEVICE_UNSYNCED)) {",
        "tests/test_clock_states.py::test_above_unsynced_it_is_slewed",
    ),
    Bug(
        "unsure clock does not stop",
        "firmware/device.c",
        "} else if (device->state > DEVICE_UNSYNCED) {",
        "} else if (device->state > DEVICE_UNSYNCED && sync->settled) {",
        "tests/test_clock_states.py::test_an_interval_beyond_the_limit_stops_it",
    ),
    Bug(
        "armed with an unsure clock",
        "firmware/obey.c",
        "    if (!device->sync.settled)\n        return COMMAND_UNSYNCED;\n    device->hold_tq",
        "    device->hold_tq",
        "tests/test_clock_states.py::test_it_is_not_armed_with_a_clock_that_is_not_good",
    ),
    Bug(
        "set clock not doubted",
        "firmware/sync.c",
        "    sync->doubtful |= sync->doubting;\n",
        "",
        "tests/test_clock_mishaps.py::test_any_other_brings_the_machine_to_rest",
    ),
    Bug(
        "neighbour's error forgotten",  # so that intervals do not add up along a chain
        "firmware/sync.c",
        "(int64_t)source->most_error_ns * (1 << 16) / 1000 + 1;",
        "1;",
        "tests/test_neighbours.py::test_all_settle_and_keep_within_a_bound",
    ),
    Bug(
        "delay ignored",  # what was last measured is taken for the state now
        "controller/filter.cpp",
        "times_us.push_back(now_us);",
        "(void)now_us;",
        "tests/test_estimator.py::test_the_state_is_known_to_within_three_counts",
    ),
    Bug(
        "disturbance sign",
        "controller/equations.py",
        "net = drive + d - friction",
        "net = drive - d - friction",
        "tests/test_dynamics.py::test_a_servoed_step_is_the_machine_under_its_servo_law",
    ),
    Bug(
        "late sample dropped",
        "controller/history.cpp",
        "if (known || at == samples.begin())",
        "if (known || at != samples.end())",
        "tests/test_estimator.py::test_any_order_and_any_batches_give_the_same_estimate",
    ),
    Bug(
        "torque track zero",  # but for the points already committed
        "controller/tracks.py",
        "f = clip(torque - feedback_torque - relief, ceiling[0])",
        "f = 0 * torque",
        "tests/test_closed_loop.py::test_tracks_within_its_goals",
    ),
    Bug(
        "gate off",
        "firmware/gate.c",
        "        if (result != GATE_ACCEPTED)\n            return result;\n",
        "        (void)result;\n",
        "tests/test_device_states.py::test_a_plan_is_taken_whole_or_not_at_all",
    ),
    Bug(
        "half of a tag judged",
        "firmware/frame.c",
        "if (read_uint(&tag, 8) != siphash24(",
        "if (read_uint(&tag, 4) != (uint32_t)siphash24(",
        "tests/test_frame.py::test_every_single_bit_flip_is_refused",
    ),
    Bug(
        "all that arrived opened at once",  # and the servo waits
        "firmware/inbox.c",
        "arrived_us, count_us);\n            return;\n        }\n        device->status",
        "arrived_us, count_us);\n            continue;\n        }\n        device->status",
        "tests/test_device_states.py::test_a_poll_opens_one_packet_at_most_and_the_rest_waits",
    ),
    Bug(
        "late ticks caught up",  # in a burst
        "controller/live.py",
        "                next_us += skipped * knot_us\n                continue\n",
        "                del skipped\n",
        "tests/test_live.py::test_a_late_tick_is_skipped_and_counted",
    ),
    Bug(
        "servo's time unguarded",
        "firmware/guard.c",
        "    judge(guard, count_us, device->next_servo_us, settings->monitor.late_us);\n",
        "",
        "tests/test_mishaps.py::test_hung_boards_are_braked_by_their_guards",
    ),
    Bug(
        "chopper off",
        "firmware/monitor.c",
        "monitor->chopper = supply_mV > (monitor->chopper ? off_mV : settings->chopper_mV);",
        "monitor->chopper = supply_mV > off_mV * 2;",
        "tests/test_mishaps.py::test_what_braking_feeds_back_is_burnt",
    ),
    Bug(
        "encoder judged by feedback alone",
        "firmware/monitor.c",
        "torque_tq = seen->servo->torque_tq;",
        "torque_tq = seen->servo->feedback_tq;",
        "tests/test_stops.py::test_a_stuck_encoder_is_found_by_any_torque",
    ),
    Bug(
        "a feed of any day",
        "firmware/feed.c",
        "if (age_us > FEED_FRESH_US || age_us < -FEED_FRESH_US)",
        "if (age_us < -FEED_FRESH_US)",
        "tests/test_feeds.py::test_what_is_not_meant_for_a_track_changes_nothing",
    ),
    Bug(
        "a feed of another time",
        "firmware/neighbours.c",
        "frame->lineage == lineage(device)",
        "frame->lineage == frame->lineage",
        "tests/test_feeds.py::test_what_is_not_meant_for_a_track_changes_nothing",
    ),
    Bug(
        "a feed played again",
        "firmware/feed.c",
        "while (i < frame->count && frame->points[i].time_us <= taken->last_us)",
        "while (i < frame->count - 1)",
        "tests/test_feeds.py::test_a_step_comes_at_its_moment_and_once",
    ),
    Bug(
        "a gap bridged by a line",
        "firmware/feed.c",
        "bool gap = !begins && i < frame->count && !follows;",
        "bool gap = false;",
        "tests/test_feeds.py::test_a_gap_holds_the_value_and_the_track_goes_on_behind_it",
    ),
    Bug(
        "a host writes to a track that is fed",
        "firmware/signals.c",
        "bool fed = signals->feeds.fed >> at & 1;",
        "bool fed = false;",
        "tests/test_feeds.py::test_a_hosts_pieces_for_such_a_track_are_refused_on_both_ends",
    ),
    Bug(
        "rest constraint off",
        "controller/ocp.py",
        "        lower = [*equal, *(ca.vec(-limit - value) for value, limit in pairs)]\n"
        "        upper = [*equal, *(ca.vec(limit - value) for value, limit in pairs), *room]\n",
        "        end = ca.DM.ones(2 * n) * UNBOUNDED\n"
        "        lower = [*equal[:2], -end, *(ca.vec(-limit - value) for value, limit in pairs)]\n"
        "        upper = [*equal[:2], end, *(ca.vec(limit - value) for value, limit in pairs)]\n"
        "        upper += room\n",
        "tests/test_closed_loop.py::test_every_plan_of_the_shipped_run_is_accepted",
    ),
)


def say(text: str) -> None:
    """Progress."""
    print(f"planted: {text}", file=sys.stderr, flush=True)


def checked(command: Sequence[str | Path]) -> str:
    """Standard output of a command, run in the checkout, that has to succeed."""
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"planted: {' '.join(map(str, command))} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


class Copy:
    """The checkout's files in another folder, built and imported there."""

    def __init__(self, folder: Path) -> None:
        self.source, self._build = folder / "source", folder / "build"
        self._prefix, self._report = folder / "prefix", folder / "report.xml"
        self._environment = {
            **os.environ,
            "PYTHONPATH": str(self._prefix),
            "PYTHONDONTWRITEBYTECODE": "1",  # a patch may leave a file's size and second as it was
            "XDG_CACHE_HOME": str(folder / "cache"),  # where compiled models go
        }
        self._environment.pop("PYTEST_ADDOPTS", None)
        self._copy_files()

    def _copy_files(self) -> None:
        """All that git knows or would add, as it is now."""
        listing = checked(["git", "ls-files", "-z", "-co", "--exclude-standard"])
        for name in set(listing.split("\0")) - {""}:
            target = self.source / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if os.path.lexists(ROOT / name):  # not deleted
                shutil.copy2(ROOT / name, target, follow_symlinks=False)

    def prepare(self) -> None:
        """The package's folders under one import prefix, and its compiled parts in them."""
        project = tomllib.loads((self.source / "pyproject.toml").read_text())
        for name, folder in project["tool"]["scikit-build"]["wheel"]["packages"].items():
            link = self._prefix / name
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(self.source / folder)
        (self._prefix / "headway" / "__init__.py").touch()  # so no other folder joins the package
        # The editable install's import hook is a module of this name; the path puts ours first.
        for hook in Path(sysconfig.get_path("platlib")).glob("_editable_*.py"):
            (self._prefix / hook.name).touch()
        self._configure()
        self.build()

    def _configure(self) -> None:
        settings = {
            "CMAKE_BUILD_TYPE": "Release",
            "CMAKE_INSTALL_PREFIX": self._prefix,
            "CMAKE_MAKE_PROGRAM": BIN / "ninja",
            "Python_EXECUTABLE": sys.executable,
        }
        defines = [f"-D{name}={value}" for name, value in settings.items()]
        checked([BIN / "cmake", "-GNinja", "-S", self.source, "-B", self._build, *defines])

    def build(self) -> None:
        """Compiles what has changed and puts it in place."""
        # Without this a library that is less than a second newer is not installed again.
        cmake, always = BIN / "cmake", "CMAKE_INSTALL_ALWAYS=1"
        checked([cmake, "-E", "env", always, cmake, "--build", self._build, "--target", "install"])

    def assert_imported(self) -> str:
        """Asserts that Python finds the copy and nothing else; returns where."""
        done = subprocess.run(
            [sys.executable, "-c", WHERE],
            cwd=self.source,
            env=self._environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        package, *files = done.stdout.splitlines()
        assert package == str([str(self._prefix / "headway")]), package
        for file in files:
            assert Path(file).resolve().is_relative_to(self.source), file
        return package

    def pytest(self, tests: list[str]) -> tuple[int, str]:
        """Exit code and output of pytest running `tests`."""
        self._report.unlink(missing_ok=True)
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
        command += ["--hypothesis-seed=0", f"--junitxml={self._report}", *tests]
        try:
            done = subprocess.run(
                command,
                cwd=self.source,
                env=self._environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                timeout=LIMIT_S,
            )
        except subprocess.TimeoutExpired:
            return -1, f"no end within {LIMIT_S} s"
        return done.returncode, done.stdout

    def failed_assertion(self) -> str:
        """The first of the last run's failures; "" if there was none, or one was no assertion."""
        report = ET.parse(self._report)
        messages = [e.get("message", "") for tag in ("error", "failure") for e in report.iter(tag)]
        if not all(m.startswith(("assert ", "AssertionError")) for m in messages):
            return ""
        return " ".join(messages[0].split()) if messages else ""

    @contextmanager
    def planted(self, bug: Bug) -> Iterator[None]:
        """The copy has the bug in here."""
        path = self.source / bug.file
        compiled = path.suffix in (".c", ".h", ".cpp")
        sound = path.read_text()
        path.write_text(sound.replace(bug.old, bug.new))
        try:
            if compiled:
                self.build()
            yield
        finally:
            path.write_text(sound)
        if compiled:
            self.build()


def check_places(copy: Copy) -> None:
    """Each bug's text is there, once."""
    for bug in BUGS:
        count = (copy.source / bug.file).read_text().count(bug.old)
        if count != 1:
            sys.exit(f"planted: {bug.name}: {bug.file} has {bug.old!r} {count} times, not once")


def is_caught(copy: Copy, bug: Bug) -> bool:
    """Whether the bug's test fails an assertion where the bug is."""
    with copy.planted(bug):
        code, output = copy.pytest([bug.test])
    if code == FAILED and (assertion := copy.failed_assertion()):
        say(f"    {assertion[:120]}")
        return True
    say(f"{bug.name}: pytest ended with {code}, without a failed assertion:\n{output[-4000:]}")
    return False


def chosen(words: list[str]) -> list[Bug]:
    """The bugs whose names contain a word; all of them if there is none."""
    bugs = [bug for bug in BUGS if not words or any(word in bug.name for word in words)]
    if not bugs:
        sys.exit(f"planted: no such bug; there are: {', '.join(bug.name for bug in BUGS)}")
    return bugs


def hunt(copy: Copy, bugs: list[Bug]) -> list[bool]:
    """Whether each bug is caught; ends the program if a test fails without any."""
    check_places(copy)
    say("building a copy ...")
    copy.prepare()
    say(f"the tests import headway from {copy.assert_imported()}")
    say("running the tests without a bug ...")
    code, output = copy.pytest([bug.test for bug in bugs])
    if code != 0:
        sys.exit(f"planted: these have to pass without a bug:\n{output}")
    caught = []
    for number, bug in enumerate(bugs, 1):
        say(f"{number}/{len(bugs)} {bug.name} ...")
        caught.append(is_caught(copy, bug))
    return caught


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Columns as wide as their widest entry."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        print("  ".join(cells).rstrip())


def main() -> int:
    """Exit code."""
    bugs = chosen(sys.argv[1:])
    with tempfile.TemporaryDirectory(prefix="headway-planted-") as folder:
        caught = hunt(Copy(Path(folder).resolve()), bugs)
    rows = [("bug", "file", "test", "")]
    for bug, good in zip(bugs, caught, strict=True):
        rows.append((bug.name, bug.file, bug.test, "caught" if good else "MISSED"))
    print_table(rows)
    print(f"{sum(caught)} passed, {len(caught) - sum(caught)} failed")
    return 0 if all(caught) else 1


if __name__ == "__main__":
    sys.exit(main())
