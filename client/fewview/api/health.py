"""Health: is the service up, and does it reach its parts."""

from fewview.api.forms import Health, form_in
from fewview.api.operations import Driver, Resource, operation
from fewview.api.steps import Request, Steps


class HealthChecks(Resource[Driver]):
    """``GET /health``."""

    @operation
    def ready(self) -> Steps[Health]:
        """Have the service reach its queue, records and objects.

        Raises
        ------
        Unavailable
            Some cannot be reached; ``errors`` name them.
        """
        return self._call(Request("GET", "/health/ready", form_in(Health)))
