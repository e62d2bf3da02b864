"""One account of what a project keeps: what each row counts, and indexes that add it up.

Revision ID: 0007
"""

from functools import partial

from alembic import op
from sqlalchemy import BigInteger, Column, Computed, String

# ruff: noqa: S608 (all names in the statements are those below)

revision = "0007"
down_revision = "0006"

ROW = 512  # bytes, of a record and of a chunk
LABELS = ("tags", "user_metadata")
COUNTED = {  # columns of JSON and of long text
    "datasets": (
        *LABELS,
        *(
            "observed",
            "skeleton",
            "image_sizes",
            "last_times",
            "view_names",
            "notes",
            "findings",
            "calibration",
        ),
    ),
    "fits": (*LABELS, "error", "findings", "config", "progress"),
    "lifts": (*LABELS, "error", "findings", "views", "up", "layout"),
    "models": (*LABELS, "config", "skeleton", "training_curve", "metrics", "findings"),
    "aliases": (),
    "webhooks": ("url", "events"),
    "deliveries": ("payload",),
    "idempotency_keys": (),
    "audit": (),
}
GIVEN_OWNERS = ("deliveries", "idempotency_keys")
SIZE = {
    "sqlite": "coalesce(length(CAST({} AS BLOB)), 0)",
    "postgresql": "coalesce(octet_length(CAST({} AS TEXT)), 0)",
}
# SQLite cannot add a column that is stored, PostgreSQL cannot have an index of one that is not.
STORED = {"sqlite": False, "postgresql": True}
# What older versions stored without counting it, as far as records show its size.
ARRAYS = (
    "frames * keypoints * (views * (8 + CASE WHEN confidence THEN 4 ELSE 0 END)"
    " + CASE WHEN ground_truth THEN 12 ELSE 0 END)"
)


def upgrade() -> None:
    """Count all that is stored."""
    for table in GIVEN_OWNERS:
        op.add_column(
            table, Column("project", String(64), nullable=False, server_default="default")
        )
        op.add_column(table, Column("key_id", String(200)))
        op.add_column(table, Column("stored_bytes", BigInteger, nullable=False, server_default="0"))
    for name in ("project", "key_id"):
        op.execute(
            f"UPDATE deliveries SET {name} ="
            f" (SELECT {name} FROM webhooks WHERE webhooks.id = deliveries.webhook_id)"
        )
    op.execute("UPDATE models SET stored_bytes = weights_bytes WHERE stored_bytes = 0")
    op.execute(f"UPDATE datasets SET stored_bytes = {ARRAYS} WHERE stored_bytes = 0")
    for table, parts, of in (
        ("datasets", "chunks", "dataset_id"),
        ("lifts", "lift_chunks", "lift_id"),
    ):
        op.execute(
            f"UPDATE {table} SET stored_bytes = stored_bytes + {ROW} *"
            f" (SELECT count(*) FROM {parts} WHERE {parts}.{of} = {table}.id)"
        )
    dialect = op.get_context().dialect.name
    size, computed = SIZE[dialect], partial(Computed, persisted=STORED[dialect])
    for table, columns in COUNTED.items():
        objects = () if table == "audit" else ("stored_bytes",)
        counts = " + ".join((str(ROW), *objects, *map(size.format, columns)))
        op.add_column(table, Column("kept_bytes", BigInteger, computed(counts), nullable=False))
        op.create_index(f"account_of_{table}", table, ["project", "key_id", "kept_bytes"])
    for table in COUNTED.keys() - {*GIVEN_OWNERS, "audit"}:
        for column in ("project", "key_id"):
            op.drop_index(f"ix_{table}_{column}", table, if_exists=True)
