"""Records of datasets, fits and models in SQL; their arrays and weights as objects beside them.

The one source of truth. Every write follows one order: objects first, then the record that points
to them, in one transaction; deletion the other way round. A crash between the two leaves an object
that nothing points to, which :func:`store.housekeeping.sweep` removes, never a record without its
object.
"""
