"""Controllers that are killed, stopped and unplugged while the machine moves.

Real processes at real ports: exempt from virtual time. What is judged is the plant's own record, by
its own clock, so a slow computer makes a test slow and no other.
"""

import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from kills import AFTER_US, PEAKS_S, kills, moving, rests
from processes import (
    CONFIG,
    CONT,
    KILL,
    PATIENCE_S,
    STOP,
    Machine,
    speeds,
    within_limits,
)

from headway.controller.record.reader import NAME, read_run
from headway.controller.reference import Sines
from headway.devices.places import address_of


def test_a_killed_controller_leaves_a_machine_that_comes_to_rest(tmp_path: Path) -> None:
    """At peak speed, and at any phase, over both kinds of link; the next one takes over."""
    assert kills(tmp_path, 10, 3) == []


@pytest.mark.parametrize("kind", ["serial", "udp"])
def test_a_stopped_controller_executes_nothing_old(tmp_path: Path, kind: str) -> None:
    """SIGSTOP for 10 ms to 5 s. What was computed before is not executed after; what has come to
    rest stays at rest, and the controller says so."""
    stops_us = [10_000, 100_000, 300_000, 1_000_000, 5_000_000][kind == "udp" :: 2]
    spans = []
    with Machine(tmp_path, kind, 1.0) as machine:
        for stop_us in stops_us:
            controller = moving(machine, PEAKS_S[1])
            controller.send(STOP)
            stopped_us = machine.now_us()
            machine.pause(stop_us)
            controller.send(CONT)
            went_on_us = machine.now_us()
            if stop_us > machine.plan_us + 50_000:
                assert controller.wait() == 4
                assert "no plan reached it in time" in machine.said
                spans.append((stopped_us, machine.now_us()))
            else:
                if controller.await_task(PEAKS_S[1] + 0.1):
                    controller.send(signal.SIGTERM)
                    assert controller.wait() == 130
                else:  # nor is a pause of 20 ms and more good for the clocks
                    assert controller.wait() == 4
                machine.pause(machine.plan_us + 2 * AFTER_US)
            assert went_on_us > stopped_us
    truth = machine.truth()
    assert within_limits(machine, truth)
    for stopped_us, ended_us in spans:
        rested_us = stopped_us + machine.plan_us + AFTER_US
        assert rests(truth, rested_us, max(ended_us, rested_us) + AFTER_US)


def test_a_stop_by_signal_is_coordinated(tmp_path: Path) -> None:
    """Both axes follow one plan to its end: none stops before the other by more than a knot."""
    with Machine(tmp_path, "serial", 1.0) as machine:
        controller = moving(machine, PEAKS_S[1])
        controller.send(signal.SIGINT)
        at_us = machine.now_us()
        assert controller.wait() == 130
    truth = machine.truth()
    assert within_limits(machine, truth)
    rested_us = at_us + machine.plan_us + AFTER_US
    assert speeds(truth, at_us - 20_000, at_us).max() > 1.0
    assert rests(truth, rested_us, rested_us + AFTER_US)
    # Of the plan's last tenth both do the same: the references reach their ends together.
    rate = np.abs(truth["servo_setpoint_rate_pq"])[truth["servo_us"] > at_us]
    ends = [np.flatnonzero(rate[:, axis] > 0)[-1] for axis in range(2)]
    assert abs(ends[0] - ends[1]) <= 5  # milliseconds


def test_a_plant_that_dies_is_told(tmp_path: Path) -> None:
    machine = Machine(tmp_path, "serial", 1.0)
    controller = moving(machine, 0.5)
    machine.process.kill()
    machine.process.wait()
    assert controller.wait() == 4
    assert "has gone" in machine.said and "no longer answers" in machine.said


def test_a_cable_pulled_and_plugged_in_elsewhere_moves_nothing(tmp_path: Path) -> None:
    """All ptys vanish at speed and come back under other names. The machine rests, and goes on when
    an operator says so."""
    with Machine(tmp_path, "serial", 1.0) as machine:
        with wire(machine, tmp_path / "here") as cable:
            controller = moving(machine, PEAKS_S[1], tmp_path / "here")
            pulled_us = machine.now_us()
            cable.kill()
            assert controller.wait() == 4
        assert "has gone" in machine.said
        with wire(machine, tmp_path / "there"):
            machine.pause(1_000_000)
            plugged_us = machine.now_us()
            controller = moving(machine, 0.1, tmp_path / "there")
            controller.send(signal.SIGTERM)
            assert controller.wait() == 130
    truth = machine.truth()
    assert within_limits(machine, truth)
    assert rests(truth, pulled_us + machine.plan_us + AFTER_US, plugged_us)


def test_it_tracks_through_a_bad_wire(tmp_path: Path) -> None:
    """Loss, doubles, flipped bits, packets out of turn: nothing is refused, and it moves on."""
    bad = ["loss=0.05", "duplicate=0.05", "reorder=0.05", "reorder_us=2000", "jitter_us=500"]
    bad += ["delay_us=500"]
    words = [word for change in bad for word in ("--set", change)]
    words += ["--corrupt", "0.05"]
    with Machine(tmp_path, "udp", 0.5) as machine, wire(machine, tmp_path / "bad", *words):
        controller = moving(machine, 2.0, tmp_path / "bad")
        controller.send(signal.SIGTERM)
        assert controller.wait() == 130
    truth = machine.truth()
    assert within_limits(machine, truth)
    assert truth["end_plans_refused"].tolist() == [0]


def test_a_flood_of_junk_moves_nothing(tmp_path: Path) -> None:
    """Two thousand datagrams a second from somebody else, to each device: the task goes on."""
    over = threading.Event()

    def flood(ports: Path) -> None:
        junk = [os.urandom(size).replace(b"\0", b"\1") for size in range(1, 200)]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not over.wait(0.01):
                for place in ports.glob("*.udp"):
                    address = address_of(place.read_text())
                    for packet in junk[:20]:
                        sender.sendto(packet, address)

    with Machine(tmp_path, "udp", 0.5) as machine:
        sender = threading.Thread(target=flood, args=(machine.ports,), daemon=True)
        sender.start()
        controller = moving(machine, 2.0)
        controller.send(signal.SIGTERM)
        assert controller.wait() == 130
        over.set()
        sender.join()
    truth = machine.truth()
    assert within_limits(machine, truth)
    assert truth["end_plans_refused"].tolist() == [0]


@contextmanager
def wire(machine: Machine, ports: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    """`headway chaos` between a machine's ports and others."""
    end = time.monotonic() + PATIENCE_S
    while len(list(machine.ports.glob("arm2-*"))) < 2 and time.monotonic() < end:
        time.sleep(0.05)
    headway = str(Path(sys.executable).with_name("headway"))
    more = ["--link", machine.kind, "--realtime-factor", f"{machine.factor:g}", "--until-eof"]
    process = subprocess.Popen(
        [headway, "chaos", str(machine.ports), str(ports), *more, *words],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None and process.stdin is not None
        assert "q1" in process.stdout.readline() and "q2" in process.stdout.readline()
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
    words = ["--link", "udp", "--spawn", "--realtime-factor", "0.5", "--set", "sync.limit_us=2000"]
    headway = str(Path(sys.executable).with_name("headway"))
    runs = {
        name: subprocess.Popen(
            [headway, "run", str(CONFIG), "--duration", "2", *words, "--out", str(tmp_path / name)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for name in ("killed", "full")
    }  # fmt: skip
    writers = {name: writer_of(run) for name, run in runs.items()}
    for name in runs:
        file = tmp_path / name / NAME
        end = time.monotonic() + PATIENCE_S
        while file.stat().st_size < 200_000 and time.monotonic() < end:
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
            judged = (time_s > 0.5) & (time_s < 2.0)
            error = 1e3 * (plant["truth_position"] - wanted)[judged]
            assert np.sqrt(np.mean(error**2)) < 2.0  # mrad; at rest it would be hundreds
        assert plant["end_states"].tolist() == [[7, 7]]
