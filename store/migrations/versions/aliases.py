"""Aliases of models.

Revision ID: 0004
"""

from alembic import op
from sqlalchemy import BigInteger, Column, Float, ForeignKey, String

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Make the table, unless records of before there were migrations were given it already."""
    op.create_table(
        "aliases",
        Column("project", String(64), primary_key=True, server_default="default"),
        Column("name", String(200), primary_key=True),
        Column("model_id", String(200), ForeignKey("models.id"), nullable=False),
        Column("moved_at", Float(53), nullable=False),
        Column("key_id", String(200)),
        Column("stored_bytes", BigInteger, nullable=False, server_default="0"),
        if_not_exists=True,
    )
    for column in ("model_id", "key_id"):
        op.create_index(f"ix_aliases_{column}", "aliases", [column], if_not_exists=True)
