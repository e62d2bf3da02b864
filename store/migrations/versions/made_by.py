"""Which version of Fewview made fits and models.

Revision ID: 0008
"""

from alembic import op
from sqlalchemy import Column, String

revision = "0008"
down_revision = "0007"


def upgrade() -> None:
    """Add the columns; of what is there nobody knows it."""
    for table in ("fits", "models"):
        op.add_column(table, Column("version", String(200)))
