"""How Alembic runs the migrations: in the transaction that ``store.schema`` has begun."""

from alembic import context

from store.records import Record

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Record.metadata,
    render_as_batch=True,
)
context.run_migrations()
