"""Partners: left and right of each other, by how unlike they are."""

import numpy as np

from models.epipolar.symmetry import matched


def test_each_keypoint_has_one_partner_of_the_least_cost() -> None:
    costs = np.full((5, 5), np.inf)
    for p, q, cost in ((1, 2, 0.05), (0, 1, 0.1), (0, 3, 0.2), (2, 3, 0.15)):
        costs[p, q] = costs[q, p] = cost
    assert matched(costs).tolist() == [3, 2, 1, 0, 4]
