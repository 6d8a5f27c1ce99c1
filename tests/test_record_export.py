"""`headway export`: the same numbers in other formats, or a message and nothing."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet

from headway.cli.main import main
from headway.configs.load import load_config
from headway.controller.record.channels import CHANNELS
from headway.controller.record.columns import Arrays
from headway.controller.record.reader import read_run
from headway.controller.record.recorder import Memory
from headway.controller.record.target import About, Target
from headway.sim.lockstep import Lockstep

CONFIGS = Path(__file__).resolve().parents[1] / "configs"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A run.mcap."""
    memory = Memory()
    config = load_config(CONFIGS / "arm2.yaml", ["duration_s=0.3", "sim.outlier_share=0.02"])
    Lockstep(config, CONFIGS, memory).run()
    path = tmp_path_factory.mktemp("data") / "run.mcap"
    with path.open("wb") as file:
        target = Target(file, About("name: arm2", 0, {}))
        for batch in memory._batches:
            target.write(batch)
        target.finish(complete=True, dropped=0)
    return path.read_bytes()


@pytest.fixture
def folder(data: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a run; the test starts beside it."""
    monkeypatch.chdir(tmp_path)
    folder = Path("run")
    folder.mkdir()
    (folder / "run.mcap").write_bytes(data)
    return folder


@pytest.fixture
def arrays(folder: Path) -> Arrays:
    return read_run(folder).arrays


def test_npz(folder: Path, arrays: Arrays, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(folder), "--npz"]) == 0
    assert capsys.readouterr() == ("written to run/run.npz\n", "")
    with np.load(folder / "run.npz") as exported:
        assert set(exported) == set(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(exported[name], array)


def test_csv(folder: Path, arrays: Arrays) -> None:
    assert main(["export", str(folder / "run.mcap"), "--csv", "--out", "new/tables"]) == 0
    tables = {path.stem: path for path in Path("new/tables").iterdir()}
    assert tables.keys() == CHANNELS.keys()
    for name, path in tables.items():
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == len(arrays[f"{name}_us"])
        assert [int(row["us"]) for row in rows] == arrays[f"{name}_us"].tolist()
    with tables["truth"].open(newline="") as file:
        for row, position in zip(csv.DictReader(file), arrays["truth_position"], strict=True):
            assert [float(row["position_0"]), float(row["position_1"])] == position.tolist()
    ends = arrays["sent_packet_offsets"], arrays["sent_torque_tq_offsets"]
    with tables["sent"].open(newline="") as file:
        for i, row in enumerate(csv.DictReader(file)):
            packet = arrays["sent_packet"][ends[0][i] : ends[0][i + 1]].tobytes()
            assert bytes.fromhex(row["packet"]) == packet
            points = arrays["sent_torque_tq"][ends[1][i] : ends[1][i + 1]]
            assert [int(point) for point in row["torque_tq"].split()] == points.tolist()
            assert row["plan"] == str(len(points) > 0)


def test_parquet(folder: Path, arrays: Arrays) -> None:
    assert main(["export", str(folder), "--parquet"]) == 0
    for name, channel in CHANNELS.items():
        table = parquet.read_table(folder / "run-parquet" / f"{name}.parquet")
        assert table["us"].to_pylist() == arrays[f"{name}_us"].tolist()
        for field in channel.fields:
            key = f"{name}_{field.name}"
            if f"{key}_offsets" in arrays:
                ends = arrays[f"{key}_offsets"]
                for i, value in enumerate(table[field.name].to_pylist()):
                    whole = arrays[key][ends[i] : ends[i + 1]]
                    same = whole.tobytes() if field.kind == "bytes" else whole.tolist()
                    assert value == same
            elif field.kind.endswith("vector"):
                for axis, column in enumerate(arrays[key].T):
                    exported = table[f"{field.name}_{axis}"].to_numpy()
                    np.testing.assert_array_equal(exported, column)
            else:
                np.testing.assert_array_equal(table[field.name].to_numpy(), arrays[key])


def test_an_incomplete_record_is_exported_and_told(
    folder: Path, data: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "run.mcap").write_bytes(data[: len(data) * 2 // 3])
    assert main(["export", str(folder), "--npz"]) == 0
    assert capsys.readouterr().err == "run/run.mcap: is incomplete; what is there was exported\n"
    with np.load(folder / "run.npz") as exported:
        assert len(exported["received_us"]) > 100


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run"], "export: give one of --npz, --csv and --parquet"),
        (["run", "--npz", "--csv"], "export: give one of --npz, --csv and --parquet"),
        (["none", "--npz"], "none: cannot be read: No such file or directory"),
        (["text", "--npz"], "text: is no MCAP file; give a run's folder or its run.mcap"),
        (["run", "--npz", "--out", "text"], "text: exists already: remove it, or name another"),
        (["run", "--csv", "--out", "run"], "run: exists already: remove it, or name another"),
        (["run", "--npz", "--out", "/proc/none/x"], "/proc/none/x: cannot be written"),
        (["run", "--csv", "--out", "text/x"], "text/x: cannot be written"),
    ],
)
def test_mistakes(
    arguments: list[str], message: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("text").write_text("not a record")
    before = sorted(Path().rglob("*"))
    assert main(["export", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and message in err and len(err.splitlines()) == 1
    assert sorted(Path().rglob("*")) == before


def test_pyarrow_is_missing(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert main(["export", str(folder), "--parquet"]) == 2
    assert "pip install pyarrow" in capsys.readouterr().err
    assert [path.name for path in folder.iterdir()] == ["run.mcap"]


def test_nothing_half_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(parquet, "write_table", full)
    assert main(["export", str(folder), "--parquet"]) == 2
    assert "run-parquet: cannot be written: No space left on device" in capsys.readouterr().err
    assert [path.name for path in folder.iterdir()] == ["run.mcap"]
