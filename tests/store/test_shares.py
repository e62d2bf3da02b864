"""Shares: nobody takes the whole, a newcomer always finds something, and none is lost."""

import numpy as np
import pytest

from store.shares import Shares, Who

WHOLE = 64


def greedy(shares: Shares, *everybody: Who) -> None:
    """Have everybody take, one after the other, as much as they may."""
    while takers := [who for who in everybody if shares.may_take(who)]:
        for who in takers:
            if shares.may_take(who):
                shares.take(who)


@pytest.mark.parametrize(
    ("everybody", "left"),
    [
        ([Who("a", "1")], 16),  # a quarter
        ([Who("a", str(n)) for n in range(50)], 8),  # an eighth, of one project
        ([Who("a", "1"), Who("b", "1")], 9),
    ],
)
def test_who_is_greedy_leaves_something_for_others(everybody: list[Who], left: int) -> None:
    shares = Shares(WHOLE)
    greedy(shares, *everybody)
    assert shares.free >= left
    assert shares.may_take(Who("newcomer", "1"))


def test_each_of_many_projects_gets_a_place() -> None:
    shares = Shares(WHOLE)
    for n in range(WHOLE):
        shares.take(Who(f"project {n}", "1"))
    assert not shares.free
    assert not shares.may_take(Who("newcomer", "1"))


def test_who_has_nothing_may_have_the_last() -> None:
    shares = Shares(1)
    assert shares.may_take(Who("a", "1"))
    assert not shares.may_take(Who("a", "1"), 2)


def test_what_is_given_back_is_free_again() -> None:
    rng, shares = np.random.default_rng(0), Shares(WHOLE)
    held: list[Who] = []
    for _ in range(2000):
        who = Who("abc"[rng.integers(3)], "12"[rng.integers(2)])
        if rng.random() < 0.6 and shares.may_take(who):
            shares.take(who)
            held.append(who)
        elif held:
            shares.give_back(held.pop(rng.integers(len(held))))
        assert shares.free + len(held) == WHOLE
    for who in held:
        shares.give_back(who)
    greedy(shares, Who("a", "1"))
    assert shares.free == WHOLE // 4
