"""The queue's contract and the fit job. See ``docs/queue.md`` for the contract's public text.

The worker forks a process for every job. It imports torch when the first job is done, so that later
ones find it there, and never uses it: torch must not be used in a process forked from one that has.
"""
