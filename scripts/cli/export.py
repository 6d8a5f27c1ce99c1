"""`headway export`: a run's record as arrays or tables, for other programs."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from headway.cli.failure import ExitCode, Failure
from headway.cli.folder import written_whole

if TYPE_CHECKING:
    from headway.controller.record.columns import Arrays

Flag = Annotated[bool, Parameter(negative=())]


@dataclass(frozen=True)
class Column:
    """A value for each row."""

    values: Any  # an array, or a list of lists or of bytes
    kind: str = ""  # of its field, where it matters


Table = dict[str, Column]  # by name


def export(
    run: Path,
    /,
    *,
    npz: Flag = False,
    csv: Flag = False,
    parquet: Flag = False,
    out: Path | None = None,
) -> int:
    """Writes a run's record in another format: one .npz, or a folder with a table a channel.

    An array is named CHANNEL_FIELD; docs/record.md lists them. In a table, a field with a value for
    each axis has a column for each, from FIELD_0 on. Lists of any length are lists in Parquet, and
    numbers with blanks between them in CSV; a packet is bytes, and hexadecimal in CSV.

    Example: the last run as CSV, into a folder beside its run.mcap.

        headway export runs/mine --csv

    Parameters
    ----------
    run
        A run's folder, or its run.mcap.
    npz
        One file for numpy.load. What has any number of values in a row is one flat array; row i is
        [offsets[i] : offsets[i + 1]] of it, with CHANNEL_FIELD_offsets.
    csv
        A folder with a file for each channel.
    parquet
        The same as Parquet; needs pyarrow.
    out
        The file or folder to write; it must not exist yet. Default: run.npz, run-csv or
        run-parquet, beside run.mcap.
    """
    formats = {"npz": npz, "csv": csv, "parquet": parquet}
    chosen = [name for name, is_chosen in formats.items() if is_chosen]
    if len(chosen) != 1:
        raise Failure(ExitCode.USAGE, "export: give one of --npz, --csv and --parquet")
    write = _writer(chosen[0])
    from headway.controller.record.reader import RecordError, read_run  # takes a moment

    try:
        record = read_run(run)
    except RecordError as error:
        raise Failure(ExitCode.USAGE, str(error)) from error
    endings = {"npz": ".npz", "csv": "-csv", "parquet": "-parquet"}
    target = out or record.path.with_name(record.path.stem + endings[chosen[0]])
    with written_whole(target) as unfinished:
        write(unfinished, record.arrays)
    if not record.complete:
        print(f"{record.path}: is incomplete; what is there was exported", file=sys.stderr)
    print(f"written to {target}")
    return ExitCode.DONE


def _writer(name: str) -> Callable[[Path, Arrays], None]:
    """What writes a format. Raises Failure if a package for it is missing."""
    if name == "parquet":
        try:
            import pyarrow.parquet  # noqa: F401
        except ImportError as error:
            reason = "export --parquet needs pyarrow, which is not installed: pip install pyarrow"
            raise Failure(ExitCode.USAGE, reason) from error
    return {"npz": _write_npz, "csv": _write_csv, "parquet": _write_parquet}[name]


def _write_npz(path: Path, arrays: Arrays) -> None:
    import numpy as np

    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _write_csv(folder: Path, arrays: Arrays) -> None:
    folder.mkdir()
    for name, table in _tables(arrays):
        with (folder / f"{name}.csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(table)
            cells = (map(_cell, column.values) for column in table.values())
            writer.writerows(zip(*cells, strict=True))


def _cell(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.hex()
    return " ".join(map(str, value)) if isinstance(value, list) else value


def _write_parquet(folder: Path, arrays: Arrays) -> None:
    import pyarrow
    from pyarrow import parquet

    folder.mkdir()
    ragged = {"int list": pyarrow.list_(pyarrow.int64()), "bytes": pyarrow.binary()}
    for name, table in _tables(arrays):
        columns = {
            key: pyarrow.array(column.values, ragged.get(column.kind))
            for key, column in table.items()
        }
        parquet.write_table(pyarrow.table(columns), folder / f"{name}.parquet")


def _tables(arrays: Arrays) -> Iterable[tuple[str, Table]]:
    """A table for each channel, with a row for each message."""
    from headway.controller.record.channels import CHANNELS

    for name, channel in CHANNELS.items():
        table: Table = {key: Column(arrays[f"{name}_{key}"]) for key in ("us", "s")}
        for field in channel.fields:
            array = arrays[f"{name}_{field.name}"]
            if f"{name}_{field.name}_offsets" in arrays:
                ends = arrays[f"{name}_{field.name}_offsets"].tolist()
                whole = array.tobytes() if field.kind == "bytes" else array.tolist()
                pieces = [whole[begin:end] for begin, end in pairwise(ends)]
                table[field.name] = Column(pieces, field.kind)
            elif array.ndim == 2:
                for i, column in enumerate(array.T):
                    table[f"{field.name}_{i}"] = Column(column)
            else:
                table[field.name] = Column(array)
        yield name, table
