"""The tables before there were migrations: whatever of them is missing is made.

So records of earlier versions, which knew no migrations, are brought to the same state: what they
lack is tables, indexes and columns that may hold null.

Revision ID: 0001
"""

from alembic import op
from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    inspect,
)

revision = "0001"
down_revision = None

TABLES = MetaData()
Table(
    "condemned_objects",
    TABLES,
    Column("key", String(200), primary_key=True),
    Column("due_at", Float(53), nullable=False),
)
Table(
    "datasets",
    TABLES,
    Column("id", String(200), primary_key=True),
    Column("created_at", Float(53), nullable=False),
    Column("frames", BigInteger, nullable=False),
    Column("views", Integer, nullable=False),
    Column("keypoints", Integer, nullable=False),
    Column("observed", JSON, nullable=False),
    Column("confidence", Boolean, nullable=False),
    Column("ground_truth", Boolean, nullable=False),
    Column("checksum", String(200), nullable=False),
    Column("skeleton", JSON),
    Column("image_sizes", JSON),
    Column("fps", Float(53)),
    Column("last_times", JSON),
    Column("view_names", JSON),
    Column("notes", JSON),
    Column("findings", JSON),
    Column("name", String(200), nullable=False),
    Column("tags", JSON),
    Column("user_metadata", JSON),
)
Table(
    "deployment",
    TABLES,
    Column("id", String(200), primary_key=True),
    Column("created_at", Float(53), nullable=False),
    Column("marked_at", Float(53)),
    Column("next_sweep_at", Float(53)),
)
Table(
    "fits",
    TABLES,
    Column("config", JSON, nullable=False),
    Column("from_model", String(200)),
    Column("progress", JSON),
    Column("cancel_requested_at", Float(53)),
    Column("attempt", Integer, nullable=False),
    Column("crashes", Integer, nullable=False),
    Column("crashed_at_step", Integer),
    Column("lease_expires_at", Float(53)),
    Column("checkpoint_key", String(200)),
    Column("reconstruction_key", String(200)),
    Column("model_id", String(200)),
    Column("id", String(200), primary_key=True),
    Column("created_at", Float(53), nullable=False),
    Column("started_at", Float(53)),
    Column("finished_at", Float(53)),
    Column("dataset_id", String(200), nullable=False, index=True),
    Column("frames", BigInteger, nullable=False),
    Column("job_id", String(200), nullable=False, unique=True),
    Column("status", String(200), nullable=False),
    Column("revision", Integer, nullable=False),
    Column("error", JSON),
    Column("findings", JSON),
    Column("name", String(200), nullable=False),
    Column("tags", JSON),
    Column("user_metadata", JSON),
    Index("fits_by_status", "status"),
)
Table(
    "idempotency_keys",
    TABLES,
    Column("scope", String(200), primary_key=True),
    Column("key", String(200), primary_key=True),
    Column("fingerprint", String(200), nullable=False),
    Column("resource_id", String(200), nullable=False),
    Column("created_at", Float(53), nullable=False),
)
Table(
    "lifts",
    TABLES,
    Column("model_id", String(200), nullable=False, index=True),
    Column("refine", String(200)),
    Column("views", JSON),
    Column("frame", String(200)),
    Column("up", JSON),
    Column("helpers", Integer, nullable=False),
    Column("chunks", Integer, nullable=False),
    Column("chunks_done", Integer, nullable=False),
    Column("frames_done", BigInteger, nullable=False),
    Column("seconds_left", Float(53)),
    Column("layout", JSON),
    Column("id", String(200), primary_key=True),
    Column("created_at", Float(53), nullable=False),
    Column("started_at", Float(53)),
    Column("finished_at", Float(53)),
    Column("dataset_id", String(200), nullable=False, index=True),
    Column("frames", BigInteger, nullable=False),
    Column("job_id", String(200), nullable=False, unique=True),
    Column("status", String(200), nullable=False),
    Column("revision", Integer, nullable=False),
    Column("error", JSON),
    Column("findings", JSON),
    Column("name", String(200), nullable=False),
    Column("tags", JSON),
    Column("user_metadata", JSON),
    Index("lifts_by_status", "status"),
)
Table(
    "models",
    TABLES,
    Column("id", String(200), primary_key=True),
    Column("created_at", Float(53), nullable=False),
    Column("fit_id", String(200)),
    Column("dataset_id", String(200)),
    Column("views", Integer),
    Column("keypoints", Integer, nullable=False),
    Column("frames", BigInteger),
    Column("config", JSON, nullable=False),
    Column("skeleton", JSON),
    Column("training_curve", JSON, nullable=False),
    Column("metrics", JSON, nullable=False),
    Column("weights_key", String(200), nullable=False),
    Column("weights_bytes", Integer, nullable=False),
    Column("weights_checksum", String(200), nullable=False),
    Column("findings", JSON),
    Column("name", String(200), nullable=False),
    Column("tags", JSON),
    Column("user_metadata", JSON),
)
Table(
    "chunks",
    TABLES,
    Column(
        "dataset_id", String(200), ForeignKey("datasets.id", ondelete="CASCADE"), primary_key=True
    ),
    Column("first_frame", BigInteger, primary_key=True),
    Column("frames", Integer, nullable=False),
    Column("key", String(200), nullable=False),
)
Table(
    "lift_chunks",
    TABLES,
    Column("lift_id", String(200), ForeignKey("lifts.id", ondelete="CASCADE"), primary_key=True),
    Column("first_frame", BigInteger, primary_key=True),
    Column("frames", Integer, nullable=False),
    Column("holder", String(200)),
    Column("lease_expires_at", Float(53)),
    Column("crashes", Integer, nullable=False),
    Column("finished_at", Float(53)),
    Column("arrays_key", String(200)),
    Column("lines_key", String(200)),
    Column("lines_bytes", Integer),
    Column("checksums", JSON),
)


def upgrade() -> None:
    """Make what is missing of the tables."""
    connection = op.get_bind()
    TABLES.create_all(connection)
    found = inspect(connection)
    for table in TABLES.sorted_tables:
        columns = {column["name"] for column in found.get_columns(table.name)}
        for column in table.columns:
            if column.nullable and column.name not in columns:
                op.add_column(table.name, Column(column.name, column.type))
        indexes = {index["name"] for index in found.get_indexes(table.name)}
        for index in table.indexes:
            if index.name not in indexes:
                index.create(connection)
