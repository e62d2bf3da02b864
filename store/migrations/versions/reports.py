"""Reports on fits.

Revision ID: 0011
"""

from alembic import op
from sqlalchemy import BigInteger, Column, Computed, String, Text

from store.migrations.versions.accounts import COUNTED, ROW, SIZE, STORED

revision = "0011"
down_revision = "0010"


def upgrade() -> None:
    """Add the columns, and count what they hold; fits that are there have no report."""
    dialect = op.get_context().dialect.name
    op.add_column("fits", Column("report_key", String(200)))
    op.add_column("fits", Column("report_words", Text))
    columns = map(SIZE[dialect].format, (*COUNTED["fits"], "corrections", "report_words"))
    counts = Computed(" + ".join((str(ROW), "stored_bytes", *columns)), persisted=STORED[dialect])
    op.drop_index("account_of_fits", "fits")
    op.drop_column("fits", "kept_bytes")
    op.add_column("fits", Column("kept_bytes", BigInteger, counts, nullable=False))
    op.create_index("account_of_fits", "fits", ["project", "key_id", "kept_bytes"])
