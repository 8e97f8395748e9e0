"""Tables to Parquet and back: the same rows give the same bytes, and a byte that changed is found when it is read."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

from graspd_core.dataset.blocks import FORMAT, SCHEMA_VERSION
from graspd_core.errors import FormatError

# Key of graspd's own part of the metadata.
_METADATA = b"graspd"


def parquet_bytes(table: Any, metadata: Mapping[str, Any]) -> bytes:
    """A pyarrow table as the bytes of a Parquet file whose metadata holds JSON-ready values beside the schema."""
    import pyarrow.parquet as pq

    told = json.dumps({"format": FORMAT, "version": SCHEMA_VERSION, **metadata}, sort_keys=True)
    kept = {**(table.schema.metadata or {}), _METADATA: told.encode()}
    buffer = BytesIO()
    pq.write_table(table.replace_schema_metadata(kept), buffer, compression="zstd", write_page_checksum=True)
    return buffer.getvalue()


def read_parquet(content: bytes, where: str, columns: Sequence[str] | None = None) -> tuple[Any, dict[str, Any]]:
    """The table of a file, of all columns or some, and its metadata.

    Raises:
        FormatError: it is no Parquet file of graspd, of an unknown version, or its content was changed.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.ParquetFile(BytesIO(content), page_checksum_verification=True).read(columns)
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise FormatError(f"{where}: not a whole Parquet file: {' '.join(str(error).split())[:200]}") from None
    try:
        told = json.loads((table.schema.metadata or {})[_METADATA])
    except (KeyError, ValueError):
        raise FormatError(f"{where}: not a file of `graspd dataset`: it says nothing of its origin") from None
    if told.get("format") != FORMAT or told.get("version") != SCHEMA_VERSION:
        raise FormatError(f"{where}: {told.get('format')} version {told.get('version')!r}; known: {SCHEMA_VERSION}")
    return table, told
