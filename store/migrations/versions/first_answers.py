"""First answers of fits.

Revision ID: 0012
"""

from alembic import op
from sqlalchemy import BigInteger, Column, String

revision = "0012"
down_revision = "0011"


def upgrade() -> None:
    """Add the columns; fits that are there have none."""
    op.add_column("fits", Column("first_key", String(200)))
    op.add_column("fits", Column("first_model_key", String(200)))
    op.add_column("fits", Column("first_bytes", BigInteger, nullable=False, server_default="0"))
