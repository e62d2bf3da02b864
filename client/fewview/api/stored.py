"""What is stored and has an identifier: described, listed, renamed, deleted."""

from typing import Any, ClassVar, Generic, TypeVar

from fewview.api.forms import Described, form_in, page_of
from fewview.api.lifting import identifier
from fewview.api.operations import Driver, Page, Resource, listing, operation
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
    def list(self, /, **filters: Any) -> Request[Page[S]]:
        """Iterate over all, newest first.

        Parameters
        ----------
        filters
            Those of the API's query: ``name``, ``created_after`` (a datetime), of jobs ``status``
            and more.
        """
        return Request("GET", path(self._plural), page_of(self._form), params=filters)

    @operation
    def update(self, stored: S | str, /, **changes: Any) -> Steps[S]:
        """Change what is said of one: its ``name``, and of datasets their ``metadata``.

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

    def _get(self, identifier: str) -> Request[S]:
        return Request("GET", path(self._plural, identifier), form_in(self._form))

    def _delete(self, identifier: str) -> Request[None]:
        return Request("DELETE", path(self._plural, identifier), nothing)
