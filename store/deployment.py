"""The identity of a deployment, which its records and its objects both carry.

Objects without their records look like garbage, and records without their objects look like losses.
So nothing is read, served or deleted before both identities were found to agree.
"""

import json
import time
from collections.abc import Callable
from contextlib import AbstractContextManager

from sqlalchemy import select
from sqlalchemy.orm import Session

from store.errors import DeploymentError
from store.ids import new_id
from store.locks import alone
from store.objects import Objects
from store.records import Chunk, DatasetRecord, Deployment, FitRecord, LiftRecord, ModelRecord

MARK = "deployment.json"


Sessions = Callable[[], AbstractContextManager[Session]]


def agree(reading: Sessions, writing: Sessions, objects: Objects) -> str:
    """Return the identity of the deployment that records and objects are of.

    Where both are new, or were written before there were identities, they get one.

    Parameters
    ----------
    reading, writing
        Give sessions of the records; only the latter hold their write lock. It is taken only if
        there is no identity yet, so that no write waits for objects that cannot be reached.

    Raises
    ------
    DeploymentError
        If they are of different deployments, or only one of them is new.
    """
    with reading() as session:
        known = session.scalar(select(Deployment.id).where(Deployment.marked_at.is_not(None)))
    if known is not None:
        check(objects, known)
        return known
    with writing() as session:
        alone(session, "the deployment")  # of several that start together, one goes first
        if session.scalar(select(Deployment)) is None:
            _refuse_strangers(session, objects)
            session.add(Deployment(id=new_id("dep"), created_at=time.time()))
    with writing() as session:
        deployment = session.scalars(select(Deployment)).one()
        marked = _marked(objects)
        if marked is None and deployment.marked_at is None:
            mark = json.dumps({"deployment": deployment.id})
            objects.put(MARK, mark.encode())
        else:
            _compare(objects, deployment.id, marked)
        deployment.marked_at = deployment.marked_at or time.time()
    return deployment.id


def check(objects: Objects, identity: str) -> None:
    """Raise ``DeploymentError`` unless the objects are still those of a deployment."""
    _compare(objects, identity, _marked(objects))


def _compare(objects: Objects, identity: str, marked: str | None) -> None:
    if marked != identity:
        raise DeploymentError(
            f"The records are of deployment {identity}, but the objects in {objects.url} are of "
            f"{marked or 'none'}: is FEWVIEW_DATABASE_URL or FEWVIEW_STORE_URL missing or wrong?"
        )


def _marked(objects: Objects) -> str | None:
    try:
        return str(json.loads(objects.get(MARK))["deployment"])
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, KeyError) as error:
        raise DeploymentError(
            f"{MARK} in {objects.url} cannot be read: restore it from a backup of the objects."
        ) from error


def _refuse_strangers(session: Session, objects: Objects) -> None:
    """Raise where records without an identity and objects were not written together."""
    marked = _marked(objects)
    if marked is not None:
        raise DeploymentError(
            f"The objects in {objects.url} belong to other records (deployment {marked}): is "
            "FEWVIEW_DATABASE_URL missing or wrong? To start anew, choose another "
            "FEWVIEW_STORE_URL."
        )
    kinds = (DatasetRecord, FitRecord, LiftRecord, ModelRecord)
    if not any(session.scalar(select(kind.id).limit(1)) for kind in kinds):
        if next(objects.list(), None) is not None:
            raise DeploymentError(
                f"There are objects in {objects.url}, but the records are empty: is "
                "FEWVIEW_DATABASE_URL missing or wrong? To start anew, choose another "
                "FEWVIEW_STORE_URL."
            )
        return
    for column in (Chunk.key, ModelRecord.weights_key):
        key = session.scalar(select(column).limit(1))
        if key is not None and not objects.has(key):
            raise DeploymentError(
                f"The records know {key}, which is not in {objects.url}: is FEWVIEW_STORE_URL "
                "missing or wrong?"
            )
