"""The queue's contract and the fit job. See ``docs/queue.md`` for the contract's public text.

Nothing here imports torch at the top: the worker forks a process for every job, and torch must
never be used in a process forked from one that has used it.
"""
