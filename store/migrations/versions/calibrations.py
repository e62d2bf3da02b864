"""Calibrations that come with datasets.

Revision ID: 0006
"""

from alembic import op
from sqlalchemy import JSON, Column

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    """Add the column; datasets that are there have none."""
    op.add_column("datasets", Column("calibration", JSON))
