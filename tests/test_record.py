"""The record: what is noted comes back, from memory and from the file, whatever happens to it."""

import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap_protobuf.decoder import DecoderFactory
from slower import slower

from headway.configs.load import load_config
from headway.configs.save import save_config
from headway.configs.schema import Config
from headway.controller import loop
from headway.controller.record import recording as recording_module
from headway.controller.record.channels import CHANNELS
from headway.controller.record.columns import Arrays
from headway.controller.record.note import thaw
from headway.controller.record.reader import MAGIC, RecordError, Run, read_run
from headway.controller.record.recorder import Memory, Recorder
from headway.controller.record.recording import Recording
from headway.controller.record.rows import rows
from headway.controller.record.target import About, Target
from headway.sim.lockstep import Lockstep

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
ABOUT = About("name: arm2 # at 25 °C\n", 7, {"headway": "0.1", "numpy": "2"})


def fussy(config: Config, recorder: Recorder | None = None) -> Lockstep:
    """A run whose own gate refuses what is fast of q2."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "position_limits", slower(5))
        lockstep = Lockstep(config, CONFIGS, recorder)
    lockstep.run()
    return lockstep


@pytest.fixture(scope="module")
def lockstep() -> Lockstep:
    """A run with all kinds of rows: lost packets, outliers, ticks that are too late, refusals."""
    overrides = ["duration_s=1.2", "sim.outlier_share=0.02", "sim.stall_host_at_s=0.25"]
    return fussy(load_config(CONFIGS / "arm2.yaml", overrides))


@pytest.fixture(scope="module")
def memory(lockstep: Lockstep) -> Memory:
    assert isinstance(lockstep.record, Memory)
    return lockstep.record


@pytest.fixture(scope="module")
def file(memory: Memory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same record through ring and writer."""
    path = tmp_path_factory.mktemp("record") / "run.mcap"
    with Recording(path, ABOUT) as recording:
        for batch in memory._batches:
            give(recording, batch)
    assert recording.failure == ""
    return path


def give(recorder: Recorder, batch: bytes) -> None:
    """Lets it record what a Memory has."""
    for note in thaw(batch):
        recorder.add(note)
    recorder.publish()
    recorder.await_room()


def same(one: Arrays, other: Arrays) -> bool:
    return one.keys() == other.keys() and all(
        one[key].dtype == other[key].dtype
        and np.array_equal(one[key], other[key], equal_nan=one[key].dtype == np.float64)
        for key in one
    )


def test_file_and_memory_are_the_same(memory: Memory, file: Path) -> None:
    run = read_run(file)
    assert run.complete and run.batches_dropped == 0
    assert same(run.arrays, memory.arrays())
    assert run.log_sha256 == memory.sha256()
    assert (run.config_text, run.seed, run.versions) == (ABOUT.config, 7, ABOUT.versions)
    assert all(run.messages[name] > 0 for name in CHANNELS)


def test_a_recorded_run_is_the_run(memory: Memory, lockstep: Lockstep, tmp_path: Path) -> None:
    """The writer changes nothing: same config, same hash."""
    with Recording(tmp_path / "run.mcap", ABOUT) as recording:
        fussy(lockstep.config, recording)
    assert recording.sha256() == memory.sha256()
    told = {key: array for key, array in memory.arrays().items() if not key.startswith("timing_")}
    assert same({key: recording.arrays()[key] for key in told}, told)


def test_every_deterministic_byte_is_in_the_hash(memory: Memory) -> None:
    """Any other value, any other time, any other order: another hash. But for computing times."""

    def sha256(change: Any) -> str:
        copy = Memory()
        for note in notes:
            for changed in change(*note):
                copy.add(changed)
            copy.publish()
        return copy.sha256()

    notes = [
        ("task", 5, (1,)),
        ("outlier", 6, (3, 4, 1, 0.5)),
        ("timing", 7, (1.0, 2.0, 3.0, 4.0, 5.0)),
    ]
    plain = sha256(lambda *note: [note])
    assert plain == sha256(lambda *note: [note])
    changed = {
        sha256(lambda name, t, v: [(name, t, (*v[:-1], v[-1] + (name == "outlier")))]),
        sha256(lambda name, t, v: [(name, t, (v[0] + (name == "task"), *v[1:]))]),
        sha256(lambda name, t, v: [(name, t + (name == "outlier"), v)]),
        sha256(lambda name, t, v: [] if name == "task" else [(name, t, v)]),
    }
    assert len(changed) == 4 and plain not in changed
    assert plain == sha256(lambda name, t, v: [] if name == "timing" else [(name, t, v)])
    notes.reverse()
    assert plain != sha256(lambda *note: [note])


def test_it_holds_what_happened(lockstep: Lockstep, memory: Memory) -> None:
    arrays, estimator = memory.arrays(), lockstep.loop.estimator
    assert len(arrays["tick_us"]) == lockstep.ticks == arrays["end_ticks"][0]
    knots_us = np.diff(arrays["tick_us"])
    assert set(knots_us // 4096) == {1, int(knots_us.max() // 4096)}  # the stall, once
    assert not arrays["tick_in_time"].all() and arrays["end_deadline_misses"] > 5
    # Plans and frames, sent and counted.
    task = arrays["sent_us"] > arrays["tick_us"][0]
    assert task.sum() == arrays["end_frames_sent"][0] == 2 * lockstep.ticks
    planned = np.diff(arrays["sent_position_pq_offsets"]) > 0
    assert np.array_equal(planned, arrays["sent_plan"])
    assert np.array_equal(planned, np.diff(arrays["sent_torque_tq_offsets"]) > 0)
    # Every status that was read arrived before the tick that read it; counters only go up.
    for device, node in enumerate(lockstep.plant.nodes):
        of_device = arrays["received_device"] == device
        statuses = arrays["received_status"][of_device]
        assert not statuses[0] and statuses[20:].all()  # first the answers to HELLO
        assert np.all(np.diff(arrays["received_plan_seen"][of_device]) >= 0)
        accepted = arrays["received_plans_accepted"][of_device]
        assert np.all(np.diff(accepted) >= 0) and accepted[-1] <= node.status.plans_accepted
    delay_us = arrays["received_us"] - arrays["received_sent_us"]
    assert 1800 < np.median(delay_us) < 4200  # by clocks that agree to some hundred us
    # Samples: those of the statuses since the tick before, outliers among them.
    ticks = np.searchsorted(arrays["tick_us"], arrays["received_us"])
    samples = np.diff(arrays["received_sample_count_offsets"])
    for tick in (10, 50, 100):
        assert arrays["tick_samples"][tick] == samples[ticks == tick].sum()
    assert len(arrays["outlier_us"]) >= estimator.outliers > 0
    assert np.all(arrays["outlier_sample_time_us"] < arrays["outlier_us"])
    # Estimates: covariances are symmetric enough and positive, and the truth is near.
    covariance = arrays["now_covariance"].reshape(-1, 6, 6)
    np.testing.assert_allclose(covariance, covariance.transpose(0, 2, 1), rtol=1e-6, atol=1e-12)
    assert np.all(np.linalg.eigvalsh(covariance)[:, 0] > 0)
    assert np.all(arrays["commit_us"] - arrays["now_us"] == 3 * 4096)
    error = np.abs(arrays["now_estimate"][:, :2] - arrays["actual_position"])
    assert np.median(error) < 1e-3
    # The truth, each millisecond.
    assert set(np.diff(arrays["truth_us"])) == {1000}
    assert np.array_equal(arrays["truth_us"], arrays["servo_us"])
    assert arrays["truth_s"][-1] > arrays["tick_s"][-1] + 1
    assert np.all(arrays["servo_setpoint_rate_pq"][-1] == 0)


def test_received_packets_are_what_the_devices_sent(lockstep: Lockstep, memory: Memory) -> None:
    """Exactly: a host with the device's key and the same nonces opens each of them."""
    from headway.devices.session import Session
    from headway.firmware import _core

    arrays = memory.arrays()
    seeds = np.random.SeedSequence(lockstep.config.seed).spawn(7)
    world, nonces = (np.random.default_rng(seeds[i]) for i in (0, 6))
    world.integers(10**15, 2 * 10**15)
    sessions = []
    for _ in range(2):
        key = world.bytes(16)
        nonces.integers(2**63)
        sessions.append(Session(key, nonces))
        world.integers(2**32), world.uniform(-1, 1)
    ends = arrays["received_packet_offsets"]
    for i, device in enumerate(arrays["received_device"]):
        packet = arrays["received_packet"][ends[i] : ends[i + 1]].tobytes()
        opened = sessions[device].open(packet)
        if not arrays["received_status"][i]:
            verdict = sessions[device].welcome(packet)
            assert verdict == ("stale" if sessions[device].established else "ok")
            continue
        assert isinstance(opened, tuple), opened
        status = _core.status_decode(opened[1])
        assert status is not None and status.sent_us == arrays["received_sent_us"][i]


def test_the_reference_reader_reads_it(file: Path, memory: Memory) -> None:
    arrays, counts = memory.arrays(), Counter[str]()
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            name = channel.topic
            row = counts[name]
            counts[name] += 1
            assert message.log_time == arrays[f"{name}_us"][row] * 1000
            if name in ("truth", "tick", "servo") and row % 50 == 0:
                for field in CHANNELS[name].fields:
                    value = np.array(getattr(decoded, field.name))
                    np.testing.assert_array_equal(value, arrays[f"{name}_{field.name}"][row])
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        topics = {channel.id: channel for channel in summary.channels.values()}
        told = summary.statistics.channel_message_counts
        assert {topics[i].topic: count for i, count in told.items()} == counts
        assert counts == read_run(file).messages
        (config,) = reader.iter_attachments()
        assert (config.name, config.data.decode()) == ("config.yaml", ABOUT.config)
        assert {m.name for m in reader.iter_metadata()} == {"run", "versions", "end"}
        (truth,) = (c for c in topics.values() if c.topic == "truth")
        assert truth.metadata["position"] == "[rad or m] of the axes"


# --- files that were cut off or damaged ----------------------------------------------------------


class Parts:
    """A file of many chunks, and what each of them holds."""

    def __init__(self, batches: list[bytes]) -> None:
        stream = BytesIO()
        target = Target(stream, ABOUT)
        target.flush()
        self.begin = stream.tell()  # config and versions are written by then
        for i, batch in enumerate(batches):
            target.write(batch)
            if i % 7 == 0:
                target.flush()
        target.finish(complete=True, dropped=0)
        self.data = stream.getvalue()
        summary = make_reader(BytesIO(self.data)).get_summary()
        assert summary is not None
        self.chunks: list[ChunkIndex] = summary.chunk_indexes
        self.rows = [row for batch in batches for row in rows(batch)]

    def messages_until(self, cut: int) -> int:
        """How many messages lie in chunks that end at or before a byte."""
        whole = sum(c.chunk_start_offset + c.chunk_length <= cut for c in self.chunks)
        reader = make_reader(BytesIO(self.data))
        return (
            sum(1 for _ in reader.iter_messages())
            if whole == len(self.chunks)
            else sum(self.counts[:whole])
        )

    @property
    def counts(self) -> list[int]:
        """Messages by chunk: the index has 16 bytes for each, and 15 for each channel."""
        return [
            (c.message_index_length - 15 * len(c.message_index_offsets)) // 16 for c in self.chunks
        ]


@pytest.fixture(scope="module")
def parts(memory: Memory) -> Parts:
    """Some hundred rows around the beginning of the task."""
    first = next(i for i, b in enumerate(memory._batches) if b"\x04\x00\x00\x00task" in b)
    parts = Parts(memory._batches[first - 40 : first + 100])
    assert len(parts.chunks) > 15 and sum(parts.counts) == len(parts.rows)
    return parts


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_cut_file_has_all_but_its_last_chunk(parts: Parts, data: st.DataObject) -> None:
    cut = data.draw(st.integers(0, len(parts.data) - 1))
    try:
        run = read_from(parts.data[:cut])
    except RecordError as error:
        assert cut < parts.begin and "run.mcap" in str(error)
        return
    assert not run.complete
    assert sum(run.messages.values()) == parts.messages_until(cut)
    assert run.config_text == ABOUT.config


@pytest.mark.parametrize("edge", ["begin", "chunk", "end"])
def test_cuts_at_the_edges(parts: Parts, edge: str) -> None:
    chunk = parts.chunks[4]
    at = {
        "begin": parts.begin,
        "chunk": chunk.chunk_start_offset + chunk.chunk_length,
        "end": len(parts.data) - 1,
    }[edge]
    for cut in {at - 1, at, at + 1} - {parts.begin - 1, len(parts.data), len(parts.data) + 1}:
        run = read_from(parts.data[:cut])
        assert sum(run.messages.values()) == parts.messages_until(cut)
        assert not run.complete
    assert read_from(parts.data).complete


def read_from(data: bytes) -> Run:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "run.mcap").write_bytes(data)
        return read_run(Path(folder))


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_a_damaged_file_is_not_taken_for_a_good_one(parts: Parts, data: st.DataObject) -> None:
    damaged = bytearray(parts.data)
    for at in data.draw(st.lists(st.integers(0, len(damaged) - 1), min_size=1, max_size=3)):
        damaged[at] = data.draw(st.integers(0, 255))
    try:
        run = read_from(bytes(damaged))
    except RecordError as error:
        assert "run.mcap: " in str(error)
        return
    if run.complete:
        assert run.log_sha256 == read_from(parts.data).log_sha256


def test_what_is_no_record(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"none: cannot be read: No such file"):
        read_run(tmp_path / "none")
    with pytest.raises(RecordError, match=r"run.mcap: cannot be read: No such file"):
        read_run(tmp_path)
    path = tmp_path / "text.mcap"
    path.write_text("not at all")
    with pytest.raises(RecordError, match=r"text.mcap: is no MCAP file"):
        read_run(path)
    path.write_bytes(MAGIC)
    with pytest.raises(RecordError, match="cut off at its beginning"):
        read_run(path)


def test_another_format_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.mcap"
    monkeypatch.setattr("headway.controller.record.target.FORMAT", "99")
    with path.open("wb") as stream:
        Target(stream, ABOUT).finish(complete=True, dropped=0)
    with pytest.raises(RecordError, match=r"has format 99, .* the version that wrote it, 0\.1"):
        read_run(path)


def test_a_record_without_a_row_can_be_read(tmp_path: Path) -> None:
    with Recording(tmp_path / "run.mcap", ABOUT) as recording:
        pass
    run = read_run(tmp_path)
    assert run.complete and sum(run.messages.values()) == 0
    assert same(run.arrays, Memory().arrays())
    assert recording.sha256() == Memory().sha256()


# --- notes that do not fit -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("task", (1, 2), "longer"),
        ("task", (), "shorter"),
        ("task", (1.0,), "task.start_us is no int: 1.0"),
        ("task", (True,), "task.start_us is no int: True"),
        ("outlier", (0, 0, 0, "far"), "could not convert"),
        ("startup", (0, b"12345678"), "startup.states is no int vector"),
        ("startup", (0, [1, 2.0]), "startup.states is no int vector"),
        ("actual", (3.0, [1.0]), "actual.position is no double vector"),
        ("actual", (b"123", b""), "actual.position is no double vector: b'123'"),
        ("none", (), "none"),
    ],
)
def test_a_wrong_note_is_not_recorded(name: str, values: tuple[Any, ...], message: str) -> None:
    memory = Memory()
    memory.add((name, 0, values))
    memory.publish()
    with pytest.raises((ValueError, KeyError), match=message):
        memory.arrays()


def test_a_vector_keeps_its_length() -> None:
    memory = Memory()
    for states in ([1, 2], [1, 2, 3]):
        memory.add(("startup", 0, (0, states)))
    memory.publish()
    with pytest.raises(ValueError, match="startup_states: the rows have from 2 to 3 values"):
        memory.arrays()


def test_a_packet_that_is_no_status() -> None:
    memory = Memory()
    memory.add(("received", 9, ([(1, 5, b"noise"), (0, 6, b"")], [False, True])))
    memory.publish()
    arrays = memory.arrays()
    assert arrays["received_us"].tolist() == [5, 6]
    assert arrays["received_device"].tolist() == [1, 0]
    assert not arrays["received_status"].any() and not arrays["received_plan_seen"].any()
    assert arrays["received_packet"].tobytes() == b"noise"
    assert arrays["received_packet_offsets"].tolist() == [0, 5, 5]
    assert arrays["received_sample_count_offsets"].tolist() == [0, 0, 0]
    assert np.isnan(arrays["received_s"]).all()  # no task has begun


def test_what_was_published_no_longer_changes() -> None:
    memory, position = Memory(), np.array([1.0, 2.0])
    memory.add(("actual", 0, (position, -position)))
    memory.publish()
    position[:] = 9
    assert memory.arrays()["actual_position"].tolist() == [[1.0, 2.0]]


# --- the ring, the writer and their ends ---------------------------------------------------------


def fill(recorder: Recorder, count: int, first: int = 0) -> None:
    for i in range(first, first + count):
        recorder.add(("task", i, (i,)))
        recorder.publish()


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[Recording]:
    recording = Recording(tmp_path / "run.mcap", ABOUT)
    yield recording
    if recording._process.poll() is None:
        recording._process.kill()
        recording._process.communicate()


def test_a_full_queue_drops_whole_batches_and_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The writer stands still: the ring fills up, then the queue, and then batches are lost."""
    monkeypatch.setattr(recording_module, "CAPACITY_BYTES", 1000)
    monkeypatch.setattr(recording_module, "QUEUE_BATCHES", 10)
    recording = Recording(tmp_path / "run.mcap", ABOUT)
    os.kill(recording._process.pid, signal.SIGSTOP)
    os.waitpid(recording._process.pid, os.WUNTRACED)
    published = 0
    while recording._dropped < 50:
        fill(recording, 1, first=published)
        published += 1
    os.kill(recording._process.pid, signal.SIGCONT)
    recording.finish()
    run, dropped = recording.run(), recording._dropped
    assert not run.complete and run.batches_dropped == dropped
    assert recording.failure == f"its writer was too slow: {dropped} batches were dropped"
    kept = run.arrays["task_start_us"]
    assert len(kept) == published - dropped and np.all(np.diff(kept) > 0)


def test_a_simulation_waits_for_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording_module, "CAPACITY_BYTES", 1000)
    monkeypatch.setattr(recording_module, "QUEUE_BATCHES", 10)
    with Recording(tmp_path / "run.mcap", ABOUT) as recording:
        for i in range(300):
            fill(recording, 1, first=i)
            recording.await_room()
    assert recording.failure == "" and recording.run().complete
    assert recording.run().arrays["task_start_us"].tolist() == list(range(300))


def test_nobody_waits_for_a_dead_writer(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_module, "QUEUE_BATCHES", 10)
    recording._process.kill()
    recording._process.wait()
    fill(recording, 8)
    recording._ring.push(bytes(recording._ring.capacity - 100))
    recording.await_room()
    fill(recording, 8)
    recording.finish()
    assert recording.failure == "its writer was ended by SIGKILL"


def test_a_note_that_cannot_be_taken(recording: Recording) -> None:
    fill(recording, 10)
    recording.add(("task", 0, (Path(),)))
    recording.publish()
    recording._thread.join()
    recording.await_room()  # for nothing
    fill(recording, 10)
    recording.finish()
    assert recording.failure == "it cannot take ['task']: unmarshallable object"
    assert not recording.run().complete and recording.run().messages["task"] == 10


def test_a_run_that_broke_off_is_not_complete(recording: Recording) -> None:
    fill(recording, 10)
    recording.finish(complete=False)
    run = recording.run()
    assert not run.complete and run.messages["task"] == 10
    assert recording.failure == ""


def test_the_disk_is_full(tmp_path: Path, memory: Memory) -> None:
    recording = Recording(tmp_path / "run.mcap", ABOUT)
    resource.prlimit(recording._process.pid, resource.RLIMIT_FSIZE, (100_000, 100_000))
    for batch in memory._batches:
        give(recording, batch)
    recording.finish()
    assert recording.failure == "File too large"
    assert not recording.run().complete


def test_the_writer_says_what_it_cannot_write(recording: Recording) -> None:
    recording.add(("task", 0, ("soon",)))
    recording.publish()
    recording.finish()
    assert recording.failure == "ValueError: task.start_us is no int: 'soon'"


def test_an_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_text("mine")
    with pytest.raises(FileExistsError):
        Recording(tmp_path / "run.mcap", ABOUT)
    assert (tmp_path / "run.mcap").read_text() == "mine"


def test_the_writer_imports_little() -> None:
    code = "import headway.controller.record.writer, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"mujoco", "casadi", "osqp", "scipy", "pinocchio", "pydantic", "ruamel", "matplotlib"}
    assert not heavy & set(done.stdout.split())


# --- the page about it ---------------------------------------------------------------------------

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "record.md").read_text(encoding="utf-8")


def test_the_page_has_every_channel_and_field() -> None:
    """If this fails, put what it expects between the page's two marks."""
    lines = []
    for channel in CHANNELS.values():
        lines += [f"**{channel.name}**: {channel.about}.", ""]
        lines += ["| field | kind | unit | meaning |", "|---|---|---|---|"]
        lines += [f"| {f.name} | {f.kind} | {f.unit} | {f.about} |" for f in channel.fields]
        lines.append("")
    table = PAGE.partition("<!-- channels:begin -->\n")[2].partition("<!-- channels:end -->")[0]
    assert table == "\n".join(lines)


def test_the_pages_examples_run(
    lockstep: Lockstep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs/mine").mkdir(parents=True)
    text = Path("config.yaml")
    save_config(lockstep.config, CONFIGS, text)
    memory = lockstep.record
    assert isinstance(memory, Memory)
    with Path("runs/mine/run.mcap").open("wb") as stream:
        target = Target(stream, About(text.read_text(), lockstep.config.seed, {}))
        for batch in memory._batches:
            target.write(batch)
        target.finish(complete=True, dropped=0)
    examples = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    outputs = []
    for example in examples:
        done = subprocess.run([sys.executable, "-c", example], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        outputs.append(done.stdout.splitlines())
    assert outputs[0][0].startswith("True 0 4096 0.")
    iterations = memory.arrays()["solver_iterations"]
    assert [int(line.split()[1]) for line in outputs[1]] == iterations.tolist()
