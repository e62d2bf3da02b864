"""Priorities of fits.

Revision ID: 0013
"""

from alembic import op
from sqlalchemy import Column, String

revision = "0013"
down_revision = "0012"


def upgrade() -> None:
    """Add the column; fits that are there are as urgent as others."""
    op.add_column("fits", Column("priority", String(200), nullable=False, server_default="normal"))
