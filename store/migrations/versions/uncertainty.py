"""How much lifts have of the uncertainty of their points.

Revision ID: 0010
"""

from alembic import op
from sqlalchemy import Column, String

revision = "0010"
down_revision = "0009"


def upgrade() -> None:
    """Add the column; lifts that are there have deviations."""
    op.add_column("lifts", Column("uncertainty", String(200)))
