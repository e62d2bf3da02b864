"""Keys, the projects that records belong to, and the audit.

Revision ID: 0003
"""

from alembic import op
from sqlalchemy import JSON, BigInteger, Column, Float, String

revision = "0003"
down_revision = "0002"

OWNED = ("datasets", "fits", "lifts", "models")


def upgrade() -> None:
    """Make the tables, and give what is stored to the default project."""
    for table in OWNED:
        op.add_column(
            table, Column("project", String(64), nullable=False, server_default="default")
        )
        op.add_column(table, Column("key_id", String(200)))
        op.add_column(table, Column("stored_bytes", BigInteger, nullable=False, server_default="0"))
        for column in ("project", "key_id"):
            op.create_index(f"ix_{table}_{column}", table, [column])
    op.create_table(
        "keys",
        Column("id", String(200), primary_key=True),
        Column("name", String(200), nullable=False),
        Column("project", String(64), nullable=False),
        Column("digest", String(200), nullable=False, unique=True),
        Column("scopes", JSON, nullable=False),
        Column("quotas", JSON),
        Column("created_at", Float(53), nullable=False),
        Column("expires_at", Float(53)),
        Column("revoked_at", Float(53)),
    )
    op.create_table(
        "audit",
        Column("id", String(200), primary_key=True),
        Column("at", Float(53), nullable=False, index=True),
        Column("project", String(64), nullable=False),
        Column("key_id", String(200), nullable=False),
        Column("action", String(200), nullable=False),
        Column("target", String(200), nullable=False),
        Column("request_id", String(200)),
    )
