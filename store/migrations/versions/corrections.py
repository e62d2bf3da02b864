"""Corrections of keypoints, of datasets and of the jobs that were made with them.

Revision ID: 0009
"""

from alembic import op
from sqlalchemy import JSON, BigInteger, Column, Computed, Integer, String

from store.migrations.versions.accounts import COUNTED, ROW, SIZE, STORED

revision = "0009"
down_revision = "0008"

TABLES = ("datasets", "fits", "lifts")


def upgrade() -> None:
    """Add the columns, and count what they hold; what is there has no corrections."""
    dialect = op.get_context().dialect.name
    for table in TABLES:
        op.add_column(table, Column("corrections", JSON))
        op.add_column(
            table, Column("corrections_count", Integer, nullable=False, server_default="0")
        )
        op.add_column(table, Column("corrections_checksum", String(200)))
        columns = map(SIZE[dialect].format, (*COUNTED[table], "corrections"))
        counts = Computed(
            " + ".join((str(ROW), "stored_bytes", *columns)), persisted=STORED[dialect]
        )
        op.drop_index(f"account_of_{table}", table)
        op.drop_column(table, "kept_bytes")
        op.add_column(table, Column("kept_bytes", BigInteger, counts, nullable=False))
        op.create_index(f"account_of_{table}", table, ["project", "key_id", "kept_bytes"])
