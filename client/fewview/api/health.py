"""Health: is the service up, does it reach its parts, and which one is it."""

from fewview.api.forms import Health, Queues, Version, form_in
from fewview.api.operations import Driver, Resource, operation
from fewview.api.steps import Request, Steps
from fewview.api.storage_forms import Storage


class HealthChecks(Resource[Driver]):
    """``GET /health``, ``GET /queues``, ``GET /storage`` and ``GET /version``."""

    @operation
    def ready(self) -> Steps[Health]:
        """Have the service reach its queue, records and objects.

        Raises
        ------
        Unavailable
            Some cannot be reached; ``errors`` name them.
        """
        return self._call(Request("GET", "/health/ready", form_in(Health)))

    @operation
    def queues(self) -> Steps[Queues]:
        """Return the jobs that wait for workers, and for how long they have."""
        return self._call(Request("GET", "/queues", form_in(Queues)))

    @operation
    def storage(self) -> Steps[Storage]:
        """Return what is stored, and how many bytes it takes."""
        return self._call(Request("GET", "/storage", form_in(Storage)))

    @operation
    def version(self) -> Steps[Version]:
        """Return the versions of the service."""
        return self._call(Request("GET", "/version", form_in(Version)))
