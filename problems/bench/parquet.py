"""Rows as a Parquet table: one table row a job, the sessions in the metadata of the schema.

Dictionaries of numbers are spread over dotted columns (`metrics.rmse`, `times.solve`, `status.solved`); settings,
options, warnings, curves and consistency, whose keys or types differ from scenario to scenario, are JSON text. In
`metrics.*` null means that the row has no such metric and NaN that the metric has no value.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from problems.bench.rows import Failure, Job, Row, finite
from problems.errors import ReadError, WriteError

NAME = "rows.parquet"

_JOB = {"scenario": "string", "method": "string", "solver": "string", "seed": "int64", "trial": "int64"}
_SPREAD = {"metrics": "float64", "times": "float64", "status": "int64"}
_PLAIN = {
    "steps": "int64",
    "step_median": "float64",
    "step_p95": "float64",
    "step_max": "float64",
    "iterations": "int64",
    "residual": "float64",
    "wall": "float64",
    "cpu": "float64",
    "memory": "int64",
}
_TEXT = ("options", "warnings", "curves", "consistency")
_FAILURE = ("kind", "message", "traceback")


def write(folder: Path, rows: Sequence[Row], sessions: Sequence[dict[str, Any]]) -> None:
    """Write the table, replacing the file in one step.

    Raises:
        WriteError: the file cannot be written.
    """
    import pyarrow as pa
    from pyarrow import parquet

    records = [_flatten(row) for row in rows]
    names = dict.fromkeys(name for record in records for name in record)
    columns = {name: pa.array([record.get(name) for record in records], _arrow_type(name)) for name in names}
    table = pa.table(columns).replace_schema_metadata({"sessions": json.dumps(sessions)})
    scratch = folder / f"{NAME}.new"
    try:
        parquet.write_table(table, scratch)
        os.replace(scratch, folder / NAME)
    except OSError as error:
        raise WriteError(folder, str(error.strerror or error)) from error


def read(folder: Path) -> tuple[list[Row], list[dict[str, Any]]]:
    """Rows and sessions of the table.

    Raises:
        ReadError: it is not a table written by `write`.
    """
    import pyarrow as pa
    from pyarrow import parquet

    try:
        table = parquet.read_table(folder / NAME)
        sessions = json.loads((table.schema.metadata or {})[b"sessions"])
        columns = {name: table.column(name).to_pylist() for name in table.column_names}
        return [
            _row(dict(zip(columns, values, strict=True))) for values in zip(*columns.values(), strict=True)
        ], sessions
    except (OSError, pa.ArrowException, KeyError, ValueError) as error:
        raise ReadError(folder / NAME, None, "a table written by horizonet bench", repr(error)) from error


def _arrow_type(name: str) -> Any:
    import pyarrow as pa

    kind = _SPREAD.get(name.partition(".")[0]) or _PLAIN.get(name) or _JOB.get(name) or "string"
    return getattr(pa, kind)()


def _flatten(row: Row) -> dict[str, Any]:
    record: dict[str, Any] = {name: getattr(row.job, name) for name in _JOB}
    record["settings"] = json.dumps(row.job.settings)
    record |= {name: json.dumps(getattr(row, name)) for name in _TEXT}
    record |= {name: getattr(row, name) for name in _PLAIN}
    record |= {f"metrics.{name}": math.nan if value is None else value for name, value in row.metrics.items()}
    for part in ("times", "status"):
        record |= {f"{part}.{name}": value for name, value in getattr(row, part).items()}
    return record | {f"failure.{name}": getattr(row.failure, name, None) for name in _FAILURE}


def _row(record: dict[str, Any]) -> Row:
    spread: dict[str, dict[str, Any]] = {part: {} for part in (*_SPREAD, "failure")}
    for name, value in record.items():
        part, dot, key = name.partition(".")
        if dot and value is not None:
            spread[part][key] = value
    metrics = {name: finite(value) for name, value in spread["metrics"].items()}
    job = Job(settings=json.loads(record["settings"]), **{name: record[name] for name in _JOB})
    return Row(
        job=job,
        metrics=metrics,
        times=spread["times"],
        status=spread["status"],
        failure=Failure(**spread["failure"]) if spread["failure"] else None,
        **{name: json.loads(record[name]) for name in _TEXT},
        **{name: record[name] for name in _PLAIN},
    )
