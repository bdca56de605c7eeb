import numpy as np
import pytest

from hdrqn_torchrl.claims import Alike, Near, Ordered, difference


def results(**groups):
    return {"return": {name: np.array(values) for name, values in groups.items()}}


@pytest.mark.parametrize(
    ("a", "b", "outcome"),
    [
        ([1.5, 1.6, 1.7], [0.5, 0.6, 0.7], "agrees"),
        ([0.5, 0.6, 0.7], [1.5, 1.6, 1.7], "disagrees"),
        ([0.5, 1.5], [0.6, 1.4], "open"),
    ],
)
def test_order_of_two(a, b, outcome):
    assert Ordered("return", ["a", "b"]).check(results(a=a, b=b)).outcome == outcome


def test_groups_of_one_level_are_not_compared():
    values = results(a=[3.0, 3.0], b=[1.0, 1.0], c=[1.5, 1.5])
    assert Ordered("return", ["a", ["b", "c"]]).check(values).outcome == "agrees"
    assert Ordered("return", ["a", "b", "c"]).check(values).outcome == "disagrees"  # though its first pair holds
    assert Ordered("return", ["c", ["b", "a"]]).check(values).claim == "c above b and a"


@pytest.mark.parametrize(
    ("a", "b", "outcome"),
    [([1.0, 1.1], [1.0, 1.15], "agrees"), ([1.0, 1.0], [2.0, 2.0], "disagrees"), ([0.5, 1.5], [0.8, 0.8], "open")],
)
def test_alike(a, b, outcome):
    assert Alike("return", ["a", "b"]).check(results(a=a, b=b)).outcome == outcome


@pytest.mark.parametrize(("value", "outcome"), [(1.2, "agrees"), (1.9, "disagrees")])
def test_near(value, outcome):
    verdict = Near("return", "a", 1.0, within=0.5).check(results(a=[value, value]))
    assert (verdict.outcome, verdict.claim) == (outcome, "a takes about 1 return")


def test_one_seed_is_said():
    assert Ordered("return", ["a", "b"]).check(results(a=[2.0, 2.0], b=[1.0])).outcome == "agrees (one seed)"


@pytest.mark.parametrize(
    "claim", [Ordered("return", ["a", "b"]), Alike("return", ["a", "b"]), Near("return", "b", 1.0, within=0.1)]
)
def test_without_results_there_is_no_verdict(claim):
    assert claim.check(results(a=[1.0])) is None
    assert claim.check({}) is None


def test_the_interval_holds_the_difference():
    mean, low, high = difference(np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0]))
    assert low < mean == 1.5 < high
    assert difference(np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0])) == (mean, low, high)
