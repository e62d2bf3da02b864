"""The service's resources, a module each, written once for both clients.

What a resource does is a generator of steps (``steps.py``): requests, pauses, reads of a response.
Two drivers carry them out, one that blocks and one that awaits (``drivers.py``); ``operations.py``
gives each resource both faces. Retries (``retries.py``), downloads and jobs are steps, too.
"""
