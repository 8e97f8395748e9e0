"""The columns of a data set. `columns` defines them for the Parquet schema and the table in docs/tables/dataset.md."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from graspd_core.verify.metrics import METRICS
from graspd_dataset.run_records import markdown_table


@dataclass(frozen=True)
class Column:
    """One column of a data set.

    Attributes:
        name: name of the column.
        kind: type: string, int32, int64, double, double[3], double[4], double[], string[], contacts or trials.
        description: meaning of the values, with units and frame.
    """

    name: str
    kind: str
    description: str


def _posture(stage: str, what: str) -> tuple[Column, ...]:
    return (
        Column(f"{stage}_position", "double[3]", f"{what}: origin of the hand's base link, object frame [m]"),
        Column(f"{stage}_quaternion_wxyz", "double[4]", f"{what}: unit quaternion of the base link, object frame"),
        Column(f"{stage}_joint_positions", "double[]", f"{what}: in the order of `joint_names` [rad] or [m]"),
    )


_BEFORE = (
    Column("block", "string", "key of the block: the name of its file"),
    Column("row", "int32", "place in the block: verified grasps first"),
    Column("object_sha256", "string", "hash of the cleaned, scaled mesh, and name of its file in `objects/`"),
    Column("object_source", "string", "shape:NAME or the mesh file"),
    Column("scale", "double", "factor on the file's coordinates"),
    Column("mass", "double", "mass of the object [kg]"),
    Column("friction", "double", "Coulomb coefficient between hand and object"),
    Column("hand_name", "string", "name of the hand"),
    Column("hand_sha256", "string", "hash of the hand's URDF and description"),
    Column("joint_names", "string[]", "names of all joints, coupled joints too"),
    Column("method", "string", "method that found the grasp"),
    Column("preset", "string", "name of the settings; the file's metadata has them all"),
    Column("verify", "string", "the trials: standard, hard, full, hard_full or none"),
    Column("seed", "int64", "seed of the plan"),
    Column("code", "string", "version of graspd, and a hash of its sources"),
    Column("verdict", "string", "verified, failed, or unverified"),
    Column("reason", "string", "why the first failed trial failed; empty without one"),
    Column("score", "double", "the optimiser's own measure before any trial; larger is better"),
    Column("probability", "double", "probability that the grasp holds; null unless cameras saw the object"),
    *_posture("pregrasp", "open and clear of the object"),
    *_posture("grasp", "the fingers just touch"),
    *_posture("squeeze", "targets that press"),
    Column("contacts", "contacts", "for each touching link: `link`, `position` [m] and outward `normal`, object frame"),
    Column("trials", "trials", "for each trial: `name`, `passed`, `displacement` [m], `rotation` [rad], `reason`"),
)


def columns() -> tuple[Column, ...]:
    """Return all columns. The last columns are the metrics of `METRICS`, one column for each."""
    metrics = (
        Column(f"metric_{row.key}", "double", f"{row.name.replace('_', ' ')} (docs/metrics.md); null: not measured")
        for row in METRICS.values()
    )
    return (*_BEFORE, *metrics)


def arrow_schema() -> Any:
    """Return the pyarrow schema of a block's rows, one row per grasp."""
    import pyarrow as pa

    text, number, vector = pa.string(), pa.float64(), pa.list_(pa.float64(), 3)
    contact = {"link": text, "position": vector, "normal": vector}
    trial = {"name": text, "passed": pa.bool_(), "displacement": number, "rotation": number, "reason": text}
    kinds = {
        "string": text,
        "int32": pa.int32(),
        "int64": pa.int64(),
        "double": number,
        "double[3]": vector,
        "double[4]": pa.list_(number, 4),
        "double[]": pa.list_(number),
        "string[]": pa.list_(text),
        "contacts": pa.list_(pa.struct(contact.items())),
        "trials": pa.list_(pa.struct(trial.items())),
    }
    return pa.schema([pa.field(column.name, kinds[column.kind]) for column in columns()])


def object_schema() -> Any:
    """Return the pyarrow schema of the files in `objects/`. Each file has one row. Lengths are in metres."""
    import pyarrow as pa

    return pa.schema(
        [
            ("object_sha256", pa.string()),
            ("volume", pa.float64()),
            ("radius", pa.float64()),
            ("center_of_mass", pa.list_(pa.float64(), 3)),
            ("vertices", pa.list_(pa.list_(pa.float64(), 3))),
            ("faces", pa.list_(pa.list_(pa.int64(), 3))),
        ]
    )


def schema_table() -> str:
    """Return the table of all columns in Markdown, for docs/tables/dataset.md."""
    return markdown_table(
        ("column", "type", "what it holds"), [(f"`{c.name}`", c.kind, c.description) for c in columns()]
    )
