"""The queue's contract and the fit job. See ``docs/queue.md`` for the contract's public text.

The worker forks a process for every job. It imports torch when the first job is done, so that later
ones find it there, and never uses it: torch must not be used in a process forked from one that has.

What RQ does (seen with 2.12), and what is done about it; each has a test in ``tests/worker/``:

- It cancels a started job by a mark, and the job runs on: a flag in the record is polled.
- A killed worker's work-horse lives on: it dies with it (PDEATHSIG), and fencing voids its writes.
- Worker and horse killed, a job stays `started` for 90 s: a lease in the record, and a reconciler.
- A worker killed as it takes a job leaves it in an intermediate list, or loses it:
  every job goes through that list, and the reconciler looks there.
- SIGTERM waits for the whole job: the fit, or the lift's chunk, is saved and given back.
- Jobs are pickles, and one without sense stops every worker: few fields are read, as plain data
  within bounds, and what cannot be recorded is set aside.
- Its heartbeat shows a process, not work: workers leave signs of work, which health looks for.
- A worker that loses Redis quits: ours goes on with its job, and connects again.
"""
