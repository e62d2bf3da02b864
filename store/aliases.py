"""Aliases: names of models that can be moved, such as ``walk@production``.

An alias is of a project, and points to one of its models. Wherever an identifier of a model is
asked for, an alias will do: :func:`store.lookup.resolved` follows it.
"""

from typing import Annotated

from pydantic import Field
from sqlalchemy import func, select

from store import audit, clock
from store.authors import owned_by
from store.database import Store
from store.errors import InputError
from store.expectations import compare
from store.locks import alone
from store.lookup import lock
from store.records import ModelAlias, ModelRecord

_PART = "[a-z0-9][a-z0-9._-]{0,63}"
Alias = Annotated[str, Field(pattern=f"^{_PART}@{_PART}$")]
MAX_ALIASES = 1000  # of a project: each process of the API knows all of them


def put(store: Store, name: str, model_id: str) -> ModelAlias:
    """Have an alias point to a model, whatever it pointed to before; nothing else is a change.

    Parameters
    ----------
    model_id
        The model's identifier, or another alias of it.

    Raises
    ------
    NotFoundError
        If there is no such model.
    InputError
        If the project has as many aliases as it may.
    """
    with store.writing() as session:
        alone(session, ModelAlias.__tablename__)
        model = lock(session, ModelRecord, model_id)  # against deletion
        alias = session.get(ModelAlias, (store.project, name))
        before = None if alias is None else lock(session, ModelRecord, alias.model_id)
        compare(session, ModelRecord, name, before)
        if alias is None:
            count = session.scalar(select(func.count(ModelAlias.name))) or 0
            if count >= MAX_ALIASES:
                raise InputError(
                    "model_id", f"expected {MAX_ALIASES} aliases at most; delete some first"
                )
            alias = ModelAlias(name=name, **owned_by(store.author))
        elif alias.model_id == model.id:
            return alias
        alias.model_id, alias.moved_at = model.id, clock.read(session)
        session.add(alias)
        audit.note(session, "alias.set", name)
    return alias


def delete(store: Store, name: str) -> None:
    """Delete an alias; its model stays. Raise ``NotFoundError`` if there is none."""
    with store.writing() as session:
        alone(session, ModelAlias.__tablename__)
        lock(session, ModelRecord, name)  # or there is no such alias
        session.delete(session.get(ModelAlias, (store.project, name)))
        audit.note(session, "alias.delete", name)


def page(
    store: Store, *, limit: int, after: str | None = None, model_id: str | None = None
) -> list[ModelAlias]:
    """Return up to ``limit`` aliases by their names, after ``after``; of one model if it is given.

    Of all projects where the store has no author.
    """
    query = select(ModelAlias).order_by(ModelAlias.name).limit(limit)
    if after is not None:
        query = query.where(ModelAlias.name > after)
    if model_id is not None:
        query = query.where(ModelAlias.model_id == model_id)
    with store.reading() as session:
        return list(session.scalars(query))


def targets(store: Store) -> dict[tuple[str, str], str]:
    """Return which models all aliases point to, by project and name."""
    query = select(ModelAlias.project, ModelAlias.name, ModelAlias.model_id)
    with store.reading() as session:
        return {(row.project, row.name): row.model_id for row in session.execute(query)}
