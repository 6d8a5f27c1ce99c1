"""Controllers that are killed, stopped and unplugged while the machine moves.

Real processes at real ports: exempt from virtual time. What is judged is the plant's own record, by
its own clock, so a slow computer makes a test slow and no other.
"""

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from kills import PEAKS_S, kills, moving
from processes import (
    AFTER_US,
    CONFIG,
    CONT,
    KILL,
    PATIENCE_S,
    STOP,
    Machine,
    coast,
    within_limits,
)

from headway.cli.main import main
from headway.configs.load import load_config
from headway.controller.record.reader import NAME, RecordError, read_run
from headway.controller.reference import Sines
from headway.devices.core import COAST_KNOTS
from headway.devices.places import address_of
from headway.firmware import _core
from headway.sim.truth import TRUTH_US

SLOWLY = ["--realtime-factor", "0.25"]  # what has to come to its end, on any computer


def test_a_killed_controller_leaves_a_machine_that_comes_to_rest(tmp_path: Path) -> None:
    """At peak speed, and at any phase, over both kinds of link; the next one takes over."""
    rows: list[str] = []
    assert kills(tmp_path, 10, 3, rows.append) == []
    assert len(rows) == 10


def stops(folder: Path, kind: str, times: list[tuple[float, int]]) -> None:
    """Stops a controller at each of these times of its task [s], for so long [us]."""
    folder.mkdir()
    spans = []
    with Machine(folder, kind, 1.0) as machine:
        for phase, stop_us in times:
            controller = moving(machine, phase)
            controller.send(STOP)
            stopped_us = machine.now_us()
            machine.pause(stop_us)
            controller.send(CONT)
            if stop_us > machine.plan_us + 50_000:
                assert controller.wait() == 4
                assert "no plan reached it in time" in machine.said
                spans.append((stopped_us, machine.now_us()))
            elif controller.await_task(phase + 0.1):
                controller.send(signal.SIGTERM)
                assert controller.wait() == 130
            else:  # on a computer so busy that it has lost its devices in the meantime
                assert controller.wait() == 4
            machine.pause(machine.plan_us + 2 * AFTER_US)
    truth = machine.truth()
    assert within_limits(machine, truth)
    for stopped_us, ended_us in spans:
        rest = coast(machine, truth, stopped_us, ended_us + AFTER_US)
        assert rest.broken == []


def test_a_stopped_controller_executes_nothing_old(tmp_path: Path) -> None:
    """SIGSTOP for 10 ms to 5 s, at peak speed and at any phase. What was computed before is not
    executed after; what has come to rest stays at rest, and the controller says so."""
    rng = np.random.default_rng(8)
    q2_s, both_s, *_ = PEAKS_S
    some_s = [float(phase) for phase in rng.uniform(0.1, 1.7, 2)]
    serial = [(q2_s, 10_000), (some_s[0], 5_000_000)]
    udp = [(q2_s, 100_000), (both_s, 300_000), (some_s[1], 1_000_000)]
    with ThreadPoolExecutor(2) as pool:
        jobs = [
            pool.submit(stops, tmp_path / "serial", "serial", serial),
            pool.submit(stops, tmp_path / "udp", "udp", udp),
        ]
        for job in jobs:
            job.result()


def test_a_stop_by_signal_is_coordinated_and_a_dead_plant_is_told(tmp_path: Path) -> None:
    """Both axes follow one plan to its end: none stops before the other by more than a knot."""
    with Machine(tmp_path, "serial", 1.0) as machine:
        controller = moving(machine, PEAKS_S[0])
        controller.send(signal.SIGINT)
        at_us = machine.now_us()
        assert controller.wait() == 130
        controller = moving(machine, 0.1)
        again_us = machine.now_us()
        machine.process.kill()
        assert controller.wait() == 4
        assert "has gone" in machine.said and "no longer answers" in machine.said
    truth = machine.truth()
    assert within_limits(machine, truth)
    rest = coast(machine, truth, at_us, at_us + machine.plan_us + 2 * AFTER_US)
    assert rest.speed > 1.0 and rest.broken == []
    # Of the plan's last tenth both do the same: the references reach their ends together.
    stop = (truth["servo_us"] > at_us) & (truth["servo_us"] < again_us - 700_000)
    rate = np.abs(truth["servo_setpoint_rate_pq"])[stop]
    ends = [np.flatnonzero(rate[:, axis] > 0)[-1] for axis in range(2)]
    assert abs(ends[0] - ends[1]) <= 5  # milliseconds


def test_what_moves_on_is_seen() -> None:
    """By the judge of all the others: a setpoint that a stale plan moves, an axis that creeps."""
    config = load_config(CONFIG)
    plan_us = config.mpc.horizon_us + config.loop.margin_us
    machine: Any = SimpleNamespace(config=config, plan_us=plan_us)
    time_us = np.arange(-50_000, 2_000_000, TRUTH_US)
    plan = (time_us < plan_us)[:, None]
    good = {
        "truth_us": time_us,
        "servo_us": time_us,
        "servo_setpoint_rate_pq": np.where(plan, 100, 0) * np.ones((1, 2), np.int64),
        "truth_velocity": np.where(plan, 2.0, 0.0) * np.ones((1, 2)),
        "truth_position": np.minimum(time_us, plan_us)[:, None] * 2e-6 * np.ones((1, 2)),
    }
    rest = coast(machine, good, 0, 1_500_000)
    assert rest.broken == [] and rest.setpoints_us == [plan_us - plan_us % TRUTH_US] * 2
    stale, creeping = ({name: values.copy() for name, values in good.items()} for _ in range(2))
    stale["servo_setpoint_rate_pq"][time_us == 1_400_000, 1] = 1
    creeping["truth_position"][time_us > 1_000_000, 0] += 0.002
    assert "a setpoint moves 1400000 us after" in " ".join(
        coast(machine, stale, 0, 1_500_000).broken
    )
    assert "an axis moves" in " ".join(coast(machine, creeping, 0, 1_500_000).broken)


def resumed(machine: Machine, ports: Path) -> int:
    """A cable is in again for a second, and an operator runs the machine: since when."""
    machine.pause(1_000_000)
    at_us = machine.now_us()
    controller = moving(machine, 0.1, ports)
    controller.send(signal.SIGTERM)
    assert controller.wait() == 130
    return at_us


def test_a_cable_pulled_and_plugged_in_elsewhere_moves_nothing(tmp_path: Path) -> None:
    """All ptys vanish at speed and come back under other names. The machine rests, and goes on when
    an operator says so."""
    with Machine(tmp_path, "serial", 1.0) as machine:
        with wire(machine, tmp_path / "here") as cable:
            controller = moving(machine, PEAKS_S[1], tmp_path / "here")
            cable.kill()  # it does no more; to be gone takes it longer
            pulled_us = machine.now_us()
            assert controller.wait() == 4
        assert "has gone" in machine.said
        with wire(machine, tmp_path / "there"):
            resumed_us = resumed(machine, tmp_path / "there")
    truth = machine.truth()
    assert within_limits(machine, truth)
    rest = coast(machine, truth, pulled_us, resumed_us)
    assert rest.speed > 1.0 and rest.broken == []


def test_one_axis_cable_pulled_stops_all(tmp_path: Path) -> None:
    """The other axis gets no plan either once five knots have passed without a word, and both rest
    together. The same device at a port of another name, beside the old one's, moves nothing."""
    names = {"q1": "arm2-q1", "q2": "arm2-q2", "again": "arm2-elsewhere"}
    with Machine(tmp_path, "serial", 1.0) as machine:
        for folder, name in names.items():
            (tmp_path / folder).mkdir()
            device = "arm2-q1" if folder == "q1" else "arm2-q2"
            (tmp_path / folder / name).symlink_to(machine.ports / device)
        here = tmp_path / "here"
        with (
            wire(machine, here, devices=tmp_path / "q1"),
            wire(machine, here, devices=tmp_path / "q2") as cable,
        ):
            controller = moving(machine, PEAKS_S[1], here)
            cable.kill()  # it does no more; to be gone takes it longer
            pulled_us = machine.now_us()
            assert controller.wait() == 4
            assert "arm2-q2: has gone" in machine.said
            with wire(machine, here, devices=tmp_path / "again"):
                resumed_us = resumed(machine, here)
    truth = machine.truth()
    assert within_limits(machine, truth)
    unheard_us = COAST_KNOTS * machine.config.loop.knot_us
    rest = coast(machine, truth, pulled_us + unheard_us, resumed_us)
    assert rest.speed > 1.0 and rest.broken == []
    q1_us, q2_us = rest.setpoints_us
    assert abs(q1_us - q2_us) <= unheard_us + 2 * TRUTH_US


def test_the_task_goes_on_over_a_bad_wire_in_a_flood_of_junk(tmp_path: Path) -> None:
    """Loss, doubles, flipped bits, packets out of turn; and two thousand datagrams a second from
    somebody else to each device. It moves on, within its limits."""
    bad = ["loss=0.05", "duplicate=0.05", "reorder=0.05", "reorder_us=2000", "jitter_us=500"]
    words = [word for change in [*bad, "delay_us=500"] for word in ("--set", change)]
    words += ["--corrupt", "0.05"]
    over = threading.Event()

    def flood(ports: Path) -> None:
        junk = [os.urandom(size).replace(b"\0", b"\1") for size in range(1, 200)]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not over.wait(0.01):
                for place in ports.glob("*.udp"):
                    address = address_of(place.read_text())
                    for packet in junk[:20]:
                        sender.sendto(packet, address)

    with Machine(tmp_path, "udp", 0.5) as machine, wire(machine, tmp_path / "bad", *words):
        sender = threading.Thread(target=flood, args=(machine.ports,), daemon=True)
        sender.start()
        controller = moving(machine, 1.2, tmp_path / "bad")
        controller.send(signal.SIGTERM)
        assert controller.wait() == 130
        over.set()
        sender.join()
    assert within_limits(machine, machine.truth())


def test_a_flood_on_loopback_is_followed_through(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """20,000 datagrams a second to each device, of its own time, from who has no key: noise, and
    what has the right version. What has arrived is counted."""
    hz, factor = 20_000, 0.2
    rng = np.random.default_rng(4)
    noise = [rng.bytes(size).replace(b"\0", b"\1") for size in rng.integers(1, 200, 64)]
    junk = noise + [bytes((255, _core.FRAME_VERSION)) + packet for packet in noise]
    over, sent = threading.Event(), [0]

    def flood(machine: Machine) -> None:
        addresses = [address_of(place.read_text()) for place in machine.ports.glob("*.udp")]
        begun_us = machine.now_us()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not over.wait(0.002):
                due = (machine.now_us() - begun_us) * hz // 1_000_000
                for number in range(sent[0], due):
                    for address in addresses:
                        sender.sendto(junk[number % len(junk)], address)
                sent[0] = due

    with Machine(tmp_path, "udp", factor) as machine:
        controller = moving(machine, 1.0)
        sender = threading.Thread(target=flood, args=(machine,), daemon=True)
        sender.start()
        flooded_us = machine.now_us()
        assert controller.await_task(2.0), machine.said
        over.set()
        sender.join()
        calm_us = machine.now_us()
        controller.send(signal.SIGTERM)
        assert controller.wait() == 130
        where = ["--keys", str(tmp_path / "keys"), "--ports", str(machine.ports), "--json"]
        factor_words = ["--link", "udp", "--realtime-factor", f"{factor:g}"]
        capsys.readouterr()
        assert main(["devices", "list", str(CONFIG), *factor_words, *where]) == 0
        counted = [row["frames_bad_there"] for row in json.loads(capsys.readouterr().out)]
    assert min(counted) > 0.5 * sent[0]  # sockets have room for some
    assert sent[0] > 0.9 * hz * (calm_us - flooded_us) * 1e-6 > 15_000
    truth = machine.truth()
    assert within_limits(machine, truth)
    task = Sines(machine.config.task)

    def rms(start_us: int, from_us: int, to_us: int) -> np.ndarray:
        judged = (truth["truth_us"] > from_us) & (truth["truth_us"] < to_us)
        wanted = task.at((truth["truth_us"][judged] - start_us) * 1e-6)[0]
        error = 1e3 * (truth["truth_position"][judged] - wanted)
        return np.asarray(np.sqrt(np.mean(error**2, axis=0)))

    # When the task began nobody has written down: as it fits best before the flood.
    starts_us = range(flooded_us - 1_100_000, flooded_us - 900_000, 250)
    start_us = min(starts_us, key=lambda at: rms(at, flooded_us - 450_000, flooded_us).max())
    assert np.all(rms(start_us, flooded_us, calm_us) < 2.0)  # mrad; at rest it would be hundreds


@contextmanager
def wire(
    machine: Machine, ports: Path, *words: str, devices: Path | None = None
) -> Iterator[subprocess.Popen[str]]:
    """`headway chaos` between a machine's ports, or those in `devices`, and others."""
    end = time.monotonic() + PATIENCE_S
    while len(list(machine.ports.glob("arm2-*"))) < 2 and time.monotonic() < end:
        time.sleep(0.05)
    source = devices or machine.ports
    names = sorted(path.name.removesuffix(".udp") for path in source.glob("arm2-*"))
    headway = str(Path(sys.executable).with_name("headway"))
    more = ["--link", machine.kind, "--realtime-factor", f"{machine.factor:g}", "--until-eof"]
    process = subprocess.Popen(
        [headway, "chaos", str(source), str(ports), *more, *words],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None and process.stdin is not None
        assert all(name in process.stdout.readline() for name in names)
        yield process
        process.stdin.close()
        assert process.wait(PATIENCE_S) in (0, -signal.SIGKILL)
    finally:
        process.kill()
        process.wait()


def writer_of(run: subprocess.Popen[str]) -> int:
    """The process that writes a run's record."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                if parent == run.pid and b"record.writer" in (folder / "cmdline").read_bytes():
                    return int(folder.name)
        time.sleep(0.05)
    raise AssertionError("no writer")


def test_the_motion_does_not_notice_what_becomes_of_its_record(tmp_path: Path) -> None:
    """The writer is killed; the disk is full. What was written can be read."""
    words = ["--link", "udp", "--spawn", "--set", "sync.limit_us=2000", *SLOWLY]
    headway = str(Path(sys.executable).with_name("headway"))
    runs = {
        name: subprocess.Popen(
            [headway, "run", str(CONFIG), "--duration", "1", *words, "--out", str(tmp_path / name)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for name in ("killed", "full")
    }  # fmt: skip
    writers = {name: writer_of(run) for name, run in runs.items()}
    for name in runs:
        file = tmp_path / name / NAME
        end = time.monotonic() + PATIENCE_S
        while file.stat().st_size < 150_000 and time.monotonic() < end:
            assert runs[name].poll() is None
            time.sleep(0.01)
    size = (tmp_path / "full" / NAME).stat().st_size
    resource.prlimit(writers["full"], resource.RLIMIT_FSIZE, (size, size))
    os.kill(writers["killed"], KILL)
    for name, run in runs.items():
        _, said = run.communicate(timeout=PATIENCE_S)
        assert run.returncode == 5, said
        assert "the record is incomplete" in said
        record = read_run(tmp_path / name)
        assert not record.complete and record.messages["received"] > 100
        plant = read_run(tmp_path / name / "plant.mcap").arrays
        start_us = int(record.arrays["task_start_us"][0]) if record.messages["task"] else None
        if start_us is not None:
            time_s = (plant["truth_us"] - start_us) * 1e-6
            wanted = Sines(record.config().task).at(time_s)[0]
            judged = (time_s > 0.5) & (time_s < 1.0)
            error = 1e3 * (plant["truth_position"] - wanted)[judged]
            assert np.sqrt(np.mean(error**2)) < 2.0  # mrad; at rest it would be hundreds
        assert plant["end_states"].tolist() == [[7, 7]]


@pytest.mark.parametrize("kind", ["serial", "udp"])
def test_a_second_host_gets_nothing_of_a_machine_that_moves(tmp_path: Path, kind: str) -> None:
    """With the right keys. It is told why, and the first one's task goes on."""
    with Machine(tmp_path, kind, 0.25) as machine:
        first = moving(machine, 0.2)
        second = machine.controller()
        assert second.wait() == 4
        told = {"serial": "another program has it", "udp": "does another host run it?"}[kind]
        assert told in machine.said
        assert first.process.is_alive()
        first.send(signal.SIGTERM)
        stopped_us = machine.now_us()
        assert first.wait() == 130
    truth = machine.truth()
    assert within_limits(machine, truth)
    start_us = int(truth["servo_us"][np.argmax(truth["servo_setpoint_rate_pq"].any(axis=1))])
    task = (truth["servo_us"] > start_us + 50_000) & (truth["servo_us"] < stopped_us)
    assert np.all(truth["servo_setpoint_rate_pq"][task].any(axis=1))  # it never rests
    assert stopped_us - start_us > 1_000_000


def test_a_terminal_that_stands_still_stops_no_motion(tmp_path: Path) -> None:
    """Nobody reads what a run has to say, and there is no room for more: it goes on to its end."""
    said, into = os.pipe()
    headway = str(Path(sys.executable).with_name("headway"))
    words = ["--link", "udp", "--spawn", "--set", "sync.limit_us=2000", *SLOWLY]
    run = subprocess.Popen(
        [headway, "run", str(CONFIG), "--duration", "1.5", *words, "--out", str(tmp_path / "run")],
        stdout=subprocess.DEVNULL, stderr=into,
    )  # fmt: skip
    try:
        file, end = tmp_path / "run" / NAME, time.monotonic() + PATIENCE_S
        begun = 0
        while time.monotonic() < end and run.poll() is None and begun < 10:
            with suppress(OSError, RecordError):
                begun = read_run(file).messages["tick"]
            time.sleep(0.05)
        assert begun >= 10
        full = os.open(f"/proc/self/fd/{into}", os.O_WRONLY | os.O_NONBLOCK)
        for size in (4096, 1):
            with suppress(BlockingIOError):
                while True:
                    os.write(full, b"." * size)
        os.close(full)
        while run.poll() is None and time.monotonic() < end:
            time.sleep(0.05)
        assert run.poll() == 0
    finally:
        run.kill()
        run.wait()
        os.close(said)
        os.close(into)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["at_rest_after_end"] and summary["record"]["complete"]


def test_ctrl_c_leaves_a_complete_record_of_a_machine_at_rest(tmp_path: Path) -> None:
    """As a user does it: one command, one Ctrl-C."""
    headway = str(Path(sys.executable).with_name("headway"))
    words = ["--link", "serial", "--spawn", "--set", "sync.limit_us=2000", "--json", *SLOWLY]
    run = subprocess.Popen(
        [headway, "run", str(CONFIG), "--duration", "60", *words, "--out", str(tmp_path / "run")],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    file, end = tmp_path / "run" / NAME, time.monotonic() + PATIENCE_S
    while time.monotonic() < end and run.poll() is None:
        with suppress(OSError, RecordError):
            if read_run(file).messages["tick"] > 50:
                break
        time.sleep(0.1)
    run.send_signal(signal.SIGINT)
    out, said = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 130 and "interrupted; the machine was brought to rest" in said
    summary = json.loads(out)
    assert summary["record"]["complete"] and summary["at_rest_after_end"]
    assert summary["limits_violated"] == []
    assert main(["report", str(tmp_path / "run"), "--out", str(tmp_path / "page.html")]) == 0
