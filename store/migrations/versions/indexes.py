"""Indexes for what lists filter by, and for what deletes look for.

Revision ID: 0002
"""

from alembic import op

revision = "0002"
down_revision = "0001"

LABELLED = ("datasets", "fits", "lifts", "models")
COLUMNS = (
    *((table, "name") for table in LABELLED),
    *(("fits", column) for column in ("from_model", "model_id")),
    *(("models", column) for column in ("dataset_id", "fit_id")),
)


def upgrade() -> None:
    """Make the indexes."""
    for table, column in COLUMNS:
        op.create_index(f"ix_{table}_{column}", table, [column])
    if op.get_context().dialect.name == "postgresql":
        for table in LABELLED:  # SQLite has no such indexes: it looks at each record
            for column in ("tags", "user_metadata"):
                op.execute(
                    f"CREATE INDEX labels_of_{table}_{column} ON {table} "
                    f"USING gin (CAST({column} AS jsonb) jsonb_path_ops)"
                )
