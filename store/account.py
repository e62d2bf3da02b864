"""What a row counts in the account of a project: computed by the database, whoever writes it.

A generated column is right after every statement, deletion by a cascade and by hand included, and
an index on it adds an account up without reading the rows.
"""

from typing import Any

from sqlalchemy import BigInteger, Computed, Index, Integer, column, literal_column
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.orm import MappedColumn, mapped_column
from sqlalchemy.sql.functions import FunctionElement

RECORD_BYTES = 512  # of a row: its short columns and its entries in indexes, roughly
PART_BYTES = 512  # of a row of a chunk, counted by what it is a part of


class Octets(FunctionElement[int]):
    """The bytes of a column of JSON or text; 0 where it is null."""

    type = Integer()
    inherit_cache = True


@compiles(Octets)
def _of_sqlite(element: Octets, compiler: Any, **more: Any) -> str:
    return f"coalesce(length(CAST({compiler.process(element.clauses, **more)} AS BLOB)), 0)"


@compiles(Octets, "postgresql")
def _of_postgresql(element: Octets, compiler: Any, **more: Any) -> str:
    return f"coalesce(octet_length(CAST({compiler.process(element.clauses, **more)} AS TEXT)), 0)"


def kept(*names: str, objects: bool = True) -> MappedColumn[int]:
    """Return the column of what a row counts.

    Parameters
    ----------
    names
        All columns of JSON or of long text.
    objects
        Whether the row counts objects, in ``stored_bytes``.
    """
    size: Any = literal_column(str(RECORD_BYTES))
    if objects:
        size += column("stored_bytes", BigInteger)
    for name in names:
        size += Octets(column(name))
    return mapped_column(BigInteger, Computed(size), deferred=True)


def counted(table: str) -> Index:
    """Return the index that adds up what a project, or a key of it, keeps of a table."""
    return Index(f"account_of_{table}", "project", "key_id", "kept_bytes")
