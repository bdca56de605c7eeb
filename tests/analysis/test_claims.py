import numpy as np
import pytest

from hdrqn_torchrl.analysis.claims import Alike, Near, Ordered


def results(**groups):
    return {"return": {name: np.array(values) for name, values in groups.items()}}


@pytest.mark.parametrize(
    ("a", "b", "outcome"),
    [
        ([1.5, 1.6, 1.7], [0.5, 0.6, 0.7], "agrees"),
        ([0.5, 0.6, 0.7], [1.5, 1.6, 1.7], "disagrees"),
        ([1.5, 1.6, 1.7], [1.2, 1.3, 1.4], "agrees"),
        ([1.5, 1.6, 1.7], [1.4, 1.5, 1.6], "open"),
        ([0.5, 1.5], [0.6, 1.4], "open"),
        ([1.7, 1.8], [0.9, 1.0], "agrees"),
        ([1.0, 1.8], [0.1, 0.9], "open"),  # resampled means of two seeds never overlap here
    ],
)
def test_an_order_of_two_groups_is_decided_by_their_difference(a, b, outcome):
    assert Ordered("return", ["a", "b"]).check(results(a=a, b=b)).outcome == outcome


def test_groups_of_one_level_are_not_compared():
    values = results(a=[3.0, 3.1], b=[1.0, 1.1], c=[1.9, 2.0])
    assert Ordered("return", ["a", ["b", "c"]]).check(values).outcome == "agrees"
    assert Ordered("return", ["a", "b", "c"]).check(values).outcome == "disagrees"  # though its first pair holds
    assert Ordered("return", ["c", ["b", "a"]]).check(values).claim == "c above b and a"


def test_an_order_of_many_needs_every_pair_and_is_refuted_by_one_after_bonferroni():
    """Welch's two-sided level of the pair is 0.03: below 0.05 for one pair, not below 0.05 / 2 for one of two."""
    low, high = np.array([1.0, 1.1, 1.2]), np.array([1.25, 1.35, 1.45])
    alone = results(a=low, b=high)
    among_two = results(a=low, b=high, c=[0.1, 0.2, 0.3])
    assert Ordered("return", ["a", "b"]).check(alone).outcome == "disagrees"
    assert Ordered("return", ["a", ["b", "c"]]).check(among_two).outcome == "open"
    assert Ordered("return", [["b", "a"], "c"]).check(among_two).outcome == "agrees"
    assert Ordered("return", ["b", ["a", "c"]]).check(among_two).outcome == "agrees"


@pytest.mark.parametrize(
    ("a", "b", "outcome"),
    [
        ([1.0, 1.01, 1.02], [1.03, 1.04, 1.05], "agrees"),
        ([1.0, 1.1], [1.0, 1.15], "open"),  # the means are close, but how close are others?
        ([1.0, 1.01, 1.02], [2.0, 2.01, 2.02], "disagrees"),
        ([1.0, 1.05, 1.1], [1.1, 1.15, 1.2], "open"),
        ([0.5, 1.5], [0.8, 0.8], "open"),
    ],
)
def test_two_groups_are_alike_if_the_interval_of_their_difference_lies_within(a, b, outcome):
    assert Alike("return", ["a", "b"]).check(results(a=a, b=b)).outcome == outcome


@pytest.mark.parametrize(
    ("values", "outcome"),
    [([1.2, 1.21], "agrees"), ([1.9, 1.91], "disagrees"), ([1.2, 1.4], "open"), ([1.9, 1.5], "open")],
)
def test_a_mean_is_near_a_value_if_its_interval_lies_within(values, outcome):
    verdict = Near("return", "a", 1.0, within=0.5).check(results(a=values))
    assert (verdict.outcome, verdict.claim) == (outcome, "a takes 1 return (within 0.5)")


@pytest.mark.parametrize(
    "claim",
    [
        Ordered("return", ["a", "b"]),
        Ordered("return", ["b", "a"]),
        Alike("return", ["a", "b"]),
        Near("return", "b", 1, 0.1),
    ],
    ids=str,
)
def test_one_seed_decides_nothing_and_the_verdict_says_so(claim):
    assert claim.check(results(a=[2.0, 2.1], b=[1.0])).outcome == "open (one seed)"


def test_seeds_that_are_all_equal_decide_nothing():
    values = results(a=[2.0, 2.0, 2.0], b=[1.0, 1.0, 1.0])
    for claim in (Ordered("return", ["a", "b"]), Alike("return", ["a", "b"]), Near("return", "b", 1.0, within=0.1)):
        assert claim.check(values).outcome == "open"


def test_a_measured_mean_comes_with_the_half_width_of_its_interval():
    verdict = Ordered("return", ["a", "b"]).check(results(a=[1.0, 2.0, 3.0], b=[0.5]))
    assert verdict.measured == "a 2 ± 2.48, b 0.5"


@pytest.mark.parametrize(
    "claim", [Ordered("return", ["a", "b"]), Alike("return", ["a", "b"]), Near("return", "b", 1.0, within=0.1)]
)
def test_without_results_there_is_no_verdict(claim):
    assert claim.check(results(a=[1.0])) is None
    assert claim.check({}) is None
