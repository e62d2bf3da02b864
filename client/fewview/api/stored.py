"""What is stored and has an identifier: described, listed, renamed, deleted."""

import json
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Generic, TypeVar

import httpx2

from fewview.api.forms import Deleted, Described, Page, form_in, page_of, read
from fewview.api.lifting import identifier
from fewview.api.operations import Driver, Resource, listing, operation
from fewview.api.steps import Request, Steps, nothing, path

S = TypeVar("S", bound=Described)


class Stored(Resource[Driver], Generic[Driver, S]):
    """One kind of what is stored, such as ``/datasets``."""

    _form: type[S]
    _plural: ClassVar[str]

    @operation
    def get(self, identifier: str) -> Steps[S]:
        """Describe one.

        Raises
        ------
        NotFound
            There is none of this identifier.
        """
        return self._call(self._get(identifier))

    @listing
    def list(
        self, /, *, metadata: Mapping[str, Any] | None = None, **filters: Any
    ) -> Request[Page[S]]:
        """Iterate over all, newest first, that the filters allow.

        Parameters
        ----------
        metadata
            Values of their metadata under keys of its first level: strings, numbers or booleans.
        filters
            Those of the API's query: ``id``, ``tag`` (one or several), ``name``, ``search``
            (words of names and tags), ``created_after`` (a datetime), of jobs ``status`` and more.
        """
        query = filters | _metadata(metadata)
        return Request("GET", path(self._plural), page_of(self._form), params=query)

    @operation
    def update(self, stored: S | str, /, **changes: Any) -> Steps[S]:
        """Change the labels of one: its ``name``, ``tags`` or ``metadata``.

        Of a dataset also its ``skeleton``, ``view_names``, ``image_sizes`` and ``fps``; None
        removes these.

        Raises
        ------
        InvalidRequest
            Something else cannot be changed.
        """
        where = path(self._plural, identifier(stored))
        return self._call(Request("PATCH", where, form_in(self._form), body={"json": changes}))

    @operation
    def delete(self, stored: S | str) -> Steps[None]:
        """Delete one and what belongs to it; what was made from it stays.

        Raises
        ------
        Conflict
            It is a job that has not ended, or one that has not ended needs it.
        """
        return self._call(self._delete(identifier(stored)))

    @operation
    def would_delete(
        self, /, *, metadata: Mapping[str, Any] | None = None, **filters: Any
    ) -> Steps[int]:
        """Return how many :meth:`delete_many` finds with the same filters; deletes nothing.

        Raises
        ------
        InvalidRequest
            There is no filter.
        """
        query = filters | _metadata(metadata) | {"dry_run": True}
        return self._call(Request("DELETE", path(self._plural), _found, params=query))

    @operation
    def delete_many(
        self,
        /,
        *,
        expected_count: int,
        metadata: Mapping[str, Any] | None = None,
        **filters: Any,
    ) -> Steps[Deleted]:
        """Delete those that :meth:`list` gives with the same filters; what is in use stays.

        Parameters
        ----------
        expected_count
            How many these are, as :meth:`would_delete` returns it.
        metadata, filters
            As :meth:`list` takes them.

        Raises
        ------
        Conflict
            The filters find another number: nothing is deleted, or nothing more where it is about
            more than a page. So it is, too, if an answer was lost on its way and asked for again.
        InvalidRequest
            There is no filter, so that all would be deleted.
        """
        deleted: tuple[Any, ...] = ()
        refused: tuple[Any, ...] = ()
        query: dict[str, Any] = filters | _metadata(metadata)
        while True:
            query["expected_count"] = expected_count
            request = Request("DELETE", path(self._plural), _answered, params=query)
            some, cursor = yield from self._call(request)
            deleted, refused = deleted + some.deleted, refused + some.refused
            if cursor is None:
                return Deleted(deleted, refused)
            query["cursor"] = cursor
            # What a page of identifiers does not find is refused as well, but it has no next page.
            expected_count -= len(some.deleted) + len(some.refused)

    def _get(self, identifier: str) -> Request[S]:
        return Request("GET", path(self._plural, identifier), form_in(self._form))

    def _delete(self, identifier: str) -> Request[None]:
        return Request("DELETE", path(self._plural, identifier), nothing)


def labels(tags: Iterable[str], metadata: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the labels of a new resource, in the form of requests."""
    return {"tags": list(tags), "metadata": dict(metadata or {})}


def _metadata(given: Mapping[str, Any] | None) -> dict[str, str]:
    """Return the query that asks for metadata: what is no text is written as JSON."""
    return {
        f"metadata.{key}": value if isinstance(value, str) else json.dumps(value)
        for key, value in (given or {}).items()
    }


def _found(response: httpx2.Response) -> int:
    return int(response.json()["found"])


def _answered(response: httpx2.Response) -> tuple[Deleted, str | None]:
    """Read what was deleted, and where it goes on."""
    document = response.json()
    return read(Deleted, document), document["next_cursor"]
