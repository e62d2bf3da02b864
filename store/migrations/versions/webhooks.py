"""Webhooks, and what is to be delivered to them.

Revision ID: 0005
"""

from alembic import op
from sqlalchemy import JSON, BigInteger, Column, Float, ForeignKey, Integer, String, Text

revision = "0005"
down_revision = "0004"

INDEXES = (
    ("webhooks", "project"),
    ("webhooks", "key_id"),
    ("deliveries", "webhook_id"),
    ("deliveries", "next_at"),
)


def upgrade() -> None:
    """Make the tables, unless records of before there were migrations were given them already."""
    op.create_table(
        "webhooks",
        Column("id", String(200), primary_key=True),
        Column("created_at", Float(53), nullable=False),
        Column("url", Text, nullable=False),
        Column("events", JSON, nullable=False),
        Column("secret", String(200), nullable=False),
        Column("project", String(64), nullable=False, server_default="default"),
        Column("key_id", String(200)),
        Column("stored_bytes", BigInteger, nullable=False, server_default="0"),
        if_not_exists=True,
    )
    op.create_table(
        "deliveries",
        Column("id", String(200), primary_key=True),
        Column(
            "webhook_id",
            String(200),
            ForeignKey("webhooks.id", ondelete="CASCADE"),
            nullable=False,
        ),
        Column("event", String(200), nullable=False),
        Column("payload", Text, nullable=False),
        Column("created_at", Float(53), nullable=False),
        Column("attempts", Integer, nullable=False),
        Column("next_at", Float(53)),
        Column("delivered_at", Float(53)),
        Column("outcome", String(200)),
        if_not_exists=True,
    )
    for table, column in INDEXES:
        op.create_index(f"ix_{table}_{column}", table, [column], if_not_exists=True)
