"""What methods are asked and answer: requests and answers in part and put together, lanes certified once."""

import dataclasses

import jax
import numpy as np
import oracles
import pytest
import small_models

import jaxhom
from jaxhom import Status
from jaxhom.apprenticeship import lpal as lpal_module
from jaxhom.apprenticeship.certificate import Certifier
from jaxhom.apprenticeship.prepared import PreparedModel
from jaxhom.apprenticeship.solution import Found, LPALMethod
from jaxhom.apprenticeship.stages import in_turn
from jaxhom.planning.host_chains import HostModel


def request_for(case, count=3):
    expectations = np.random.default_rng(0).uniform(-3, 3, size=(count, case.features.shape[2]))
    return lpal_module._presolved(PreparedModel(case.mdp), expectations, 1e-3), expectations


def found_for(case, count=3, seed=0, **fields):
    rng = np.random.default_rng(seed)
    x = rng.uniform(size=(count, *case.shape))
    weights = rng.dirichlet(np.ones(case.features.shape[2]), size=count)
    counts, stopped = np.arange(count), np.full(count, Status.STALLED)
    fields = {"gap": np.full(count, np.inf), "decided_by": np.full(count, LPALMethod.COLUMNS)} | fields
    return Found(x=x, weights=weights, iterations=counts, stopped=stopped, **fields)


def test_a_part_of_a_request_has_its_lanes_numbers():
    request, _ = request_for(small_models.case("dense"), 5)
    policies = np.random.default_rng(1).uniform(size=(2, 7, 3))
    part = request.part(np.array([4, 1]), policy=policies, limit=7)
    np.testing.assert_array_equal(part.lanes, [4, 1])
    np.testing.assert_array_equal(part.expectations, request.expectations[[4, 1]])
    np.testing.assert_array_equal(part.part(np.array([1])).lanes, [1])
    np.testing.assert_array_equal(part.part(np.array([1])).policy, policies[1:])
    assert (part.limit, part.weights, request.limit, len(request.lanes)) == (7, None, None, 5)


@pytest.mark.parametrize("value", [None, np.ones((3, 6))])
def test_lanes_of_an_answer_are_exchanged(value):
    """What only one of two answers has is had by neither; shares of time stay each lane's own."""
    case = small_models.case("dense")
    mine, other = found_for(case, value=value), found_for(case, 2, seed=1, value=np.zeros((2, 6)), negligible=1e-14)
    both = mine.with_lanes(np.array([2, 0]), other)
    for one, expected in zip((2, 0, 1), (other.lane(0), other.lane(1), mine.lane(1)), strict=True):
        np.testing.assert_array_equal(both.lane(one).x, expected.x)
        np.testing.assert_array_equal(both.lane(one).weights, expected.weights)
        assert both.lane(one).negligible == expected.negligible
        assert (value is None) == (both.lane(one).value is None)
    assert mine.iterations.tolist() == [0, 1, 2] and both.iterations.tolist() == [1, 1, 0]


def test_a_lane_is_certified_once_as_long_as_nothing_new_is_found(monkeypatch):
    case = small_models.case("dense")
    request, expectations = request_for(case)
    certify, seen = Certifier._certify, []
    monkeypatch.setattr(
        Certifier, "_certify", lambda self, lanes, found: seen.extend(lanes) or certify(self, lanes, found)
    )
    found = found_for(case, value=np.full((3, 7), np.nan))
    first = request.certified(found)
    assert seen == [0, 1, 2]
    jax.tree.map(np.testing.assert_array_equal, first, request.certified(dataclasses.replace(found, x=found.x.copy())))
    assert seen == [0, 1, 2]
    again = request.part(np.array([1])).certified(found_for(case, 1, seed=2))
    assert seen == [0, 1, 2, 1]
    for solution, lane in ((first, 2), (again, 0)):
        asked = expectations[2 if lane else 1]
        true = oracles.margin(*case.arrays, asked, np.asarray(solution.policy[lane]))
        np.testing.assert_allclose(solution.margin[lane], true, rtol=0, atol=1e-9)


NONSENSE = {
    "NaN": np.nan,
    "infinite": np.inf,
    "negative": -1.0,
    "nothing": 0.0,
    "huge": 1e308,
    "tiny": 1e-320,
}


@pytest.mark.parametrize("name", NONSENSE)
@pytest.mark.parametrize("case", ["dense", "restart"])
def test_bounds_hold_whatever_is_found(case, name):
    """Everything nonsense, and some of it: the policy is one, and its margin and the bound are true."""
    case = small_models.case(case)
    request, expectations = request_for(case)
    found = found_for(case, value=np.random.default_rng(1).uniform(size=(3, case.shape[0])))
    for leaf in (found.x, found.value, found.weights):
        leaf[0], leaf[1, :2] = NONSENSE[name], NONSENSE[name]
    solution = request.certified(found)
    for lane, asked in enumerate(expectations):
        policy, weights = np.asarray(solution.policy[lane]), solution.weights[lane]
        np.testing.assert_array_equal(policy.sum(axis=1), 1.0)
        assert solution.margin[lane] <= oracles.margin(*case.arrays, asked, policy) + 1e-9
        best, _ = oracles.optimal_value(case.transition, case.discount, case.features @ weights)
        proved = best @ case.initial - weights @ asked
        assert proved - 1e-9 <= solution.margin_bound[lane] <= proved + 1e-3


@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-3])
def test_guesses_that_say_enough_need_no_factor(noise, monkeypatch):
    """The best policy and the values for its weights: a product each, unless they are off by more than matters."""
    mdp = jaxhom.gridworld(6, num_regions=4).mdp
    arrays = [np.asarray(leaf) for leaf in (mdp.transition, mdp.discount, mdp.initial, mdp.features)]
    weights = np.array([0.1, 0.2, 0.3, 0.4])
    best, action_value = oracles.optimal_value(*arrays[:2], arrays[3] @ weights)
    policy = np.eye(4)[action_value.argmax(axis=1)]
    x, rng = oracles.occupancy(*arrays[:3], policy), np.random.default_rng(0)
    expectations = oracles.feature_expectations(*arrays, policy)[None]
    request = lpal_module._presolved(PreparedModel(mdp), expectations, 1e-3)
    chains, chain = [], HostModel.chain
    monkeypatch.setattr(HostModel, "chain", lambda self, policy: chains.append(policy) or chain(self, policy))
    found = Found(
        x=(x * (1.0 + noise * rng.uniform(size=x.shape)))[None],
        weights=weights[None],
        value=(best + noise * rng.uniform(size=best.shape))[None],
        iterations=np.zeros(1, int),
        stopped=np.full(1, Status.STALLED),
        decided_by=np.full(1, LPALMethod.COLUMNS),
        gap=np.zeros(1),
    )
    solution = request.certified(found)
    assert bool(chains) == (noise == 1e-3)
    true = oracles.margin(*arrays, expectations[0], np.asarray(solution.policy[0]))
    np.testing.assert_allclose(solution.margin[0], true, rtol=0, atol=1e-7)
    assert solution.margin[0] <= true + 1e-9
    assert -1e-9 <= solution.margin_bound[0] <= 1e-4
    np.testing.assert_allclose(solution.occupancy[0].sum(), 100.0, rtol=1e-9)


def test_what_is_prepared_is_made_once_in_units_of_about_one():
    case = small_models.case("dense")
    model = PreparedModel(case.mdp.replace(features=48.0 * case.mdp.features / np.abs(case.features).max()))
    made = []
    assert model.once(lambda mdp: made.append(mdp) or "made") == "made"
    assert model.unit == 32.0
    np.testing.assert_allclose(np.abs(made[0].features).max(), 1.5, rtol=1e-12)
    for _ in range(2):
        model.once(made.append)
    assert len(made) == 2 and made[1] is model.mdp


# ------------------------------------------------------------------------------------------------------------- stages


def stage(case, gap, iterations, seed, seen):
    """A method that claims a gap for each lane of the call, and says what it was asked."""

    def method(request):
        seen.append(request)
        found = found_for(case, len(request.lanes), seed, gap=np.asarray(gap, float)[request.lanes])
        return dataclasses.replace(found, iterations=np.full(len(request.lanes), iterations))

    return method


def test_methods_take_lanes_in_turn():
    """Open lanes are handed on with what was found; a worse answer is not taken; iterations add up."""
    case, seen = small_models.case("dense"), []
    request, _ = request_for(case)
    first = stage(case, [np.inf, 5.0, 3.0], 4, 0, seen)
    second = stage(case, [7.0, 2.0, 4.0], 10, 1, seen)
    found = in_turn(request.replace(limit=30), first, second)
    alone = first(request), second(request)
    assert [len(one.lanes) for one in seen[:2]] == [3, 3]
    np.testing.assert_array_equal(seen[1].policy, alone[0].x)
    np.testing.assert_array_equal(seen[1].weights, alone[0].weights)
    assert seen[1].limit == 26
    np.testing.assert_array_equal(found.gap, [7.0, 2.0, 3.0])
    for lane, method in enumerate((1, 1, 0)):
        np.testing.assert_array_equal(found.x[lane], alone[method].x[lane])
    np.testing.assert_array_equal(found.iterations, [14, 14, 14])


def test_what_a_method_takes_for_closed_is_certified():
    """Claims that the certificate does not bear out are handed on; lanes without iterations left are not."""
    case, seen = small_models.case("dense"), []
    request, _ = request_for(case)
    last = stage(case, [1.0, 1.0, 1.0], 1, 2, seen)
    in_turn(request, stage(case, [0.0, np.nan, 1.0], 4, 0, []), last)
    np.testing.assert_array_equal(seen[-1].lanes, [0, 1, 2])
    found = in_turn(request.replace(limit=5), stage(case, [0.0, 9.0, 1.0], 4, 0, []), last, last)
    assert len(seen) == 2
    np.testing.assert_array_equal(found.iterations, 5)
    np.testing.assert_array_equal(found.stopped, Status.ITERATION_LIMIT)


def test_a_start_from_another_model_is_named():
    small, large = (jaxhom.gridworld(size, num_regions=4).mdp for size in (4, 6))
    found = jaxhom.lpal(small, np.zeros(4))
    with pytest.raises(ValueError, match=r"warm_start.policy must have shape"):
        jaxhom.lpal(large, np.zeros(4), warm_start=found)
