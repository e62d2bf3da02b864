"""Fair turns of what waits."""

from service.http.fair_queue import FairQueue


def drained(queue: FairQueue[str]) -> str:
    items = []
    while (item := queue.pop()) is not None:
        items.append(item)
    assert not queue
    return "".join(items)


def test_projects_take_turns_and_in_them_keys() -> None:
    queue: FairQueue[str] = FairQueue()
    for item in "aaaa":
        queue.put(("greedy", "1"), item)
    for item in "bb":
        queue.put(("greedy", "2"), item)
    for item in "xyz":
        queue.put(("other", "1"), item)
    assert drained(queue) == "axbyazbaa"


def test_who_comes_later_waits_for_one_turn_of_each() -> None:
    queue: FairQueue[str] = FairQueue()
    for item in "abcdef":
        queue.put(("greedy", "1"), item)
    assert queue.pop() == "a"
    queue.put(("other", "1"), "x")
    assert [queue.pop(), queue.pop()] == ["b", "x"]


def test_what_is_not_allowed_keeps_its_place_and_holds_up_nobody() -> None:
    queue: FairQueue[str] = FairQueue()
    for path, item in ((("greedy", "1"), "a"), (("greedy", "1"), "b"), (("other", "1"), "x")):
        queue.put(path, item)
    assert queue.pop(lambda item: item != "a") == "x"
    assert queue.pop(lambda item: item != "a") is None
    assert drained(queue) == "ab"


def test_what_waits_no_longer_is_taken_out() -> None:
    queue: FairQueue[str] = FairQueue()
    for item in "abc":
        queue.put(("one", "1"), item)
    for item in "bx":
        queue.discard(("one", "1"), item)
    queue.discard(("none", "1"), "a")
    assert drained(queue) == "ac"
