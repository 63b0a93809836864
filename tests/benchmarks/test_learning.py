"""The sweeps of learners, guarantees and queries: their problems, methods on the smallest lake, words on rows."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from bench import guarantees, learners, problems, queries, report, reproduce, settings
from bench.rows import Row, RowFile
from jaxhom import Status

LAKE = settings.tiled("tiles8", 2, 20)


@pytest.fixture(scope="module")
def lake():
    return problems.draw_problem(LAKE, (0, 1), 0)


@pytest.mark.parametrize("name", ["learners", "guarantees", "queries"])
def test_settings_of_the_sweeps(name):
    (sweeping,) = reproduce.SWEEPS[name].values()
    names = [setting.name for setting in sweeping.settings]
    assert len(set(names)) == len(names) and sweeping.draws == 50
    domains = {setting.domain for setting in sweeping.settings}
    assert domains - {"wrong16"} == {"grid16", "track_a", "track_b", "tiles8", "tiles16"}
    most = queries.ROUNDS if name == "queries" else 0
    assert all(setting.demonstrations + most <= setting.pool for setting in sweeping.settings)


def test_the_reward_of_a_lake_is_its_goal(lake):
    features, reward = np.asarray(lake.domain.mdp.features), np.asarray(lake.reward[0])
    np.testing.assert_array_equal(reward, features @ np.asarray(lake.weights[0]))
    assert (features[:, 0].sum(axis=1) == 1).all()  # one kind of cell each
    assert features.max(axis=(0, 1)).min() == 1  # and none that is nowhere
    goal = np.flatnonzero(reward[:, 0])
    assert goal.tolist() == [63]


def test_wrong_features_do_not_hold_the_reward():
    problem = problems.draw_problem(settings.misled(16, 64, 1, 20), (0,), 0)
    features = np.asarray(problem.domain.mdp.features)[:, 0]
    np.testing.assert_array_equal(features.sum(axis=1), 1)
    reward = np.asarray(problem.reward[0])[:, 0]
    left = reward - features @ np.linalg.lstsq(features, reward, rcond=None)[0]
    assert np.abs(left).max() > 0.1
    np.testing.assert_array_equal(reward, np.asarray(problem.domain.true_features)[:, 0] @ problem.weights[0])


@pytest.mark.parametrize("name", learners.LEARNERS)
def test_learners_on_a_lake(lake, name):
    found = lake.once(learners.LEARNERS[name])
    assert found.policy.shape == lake.reward.shape
    np.testing.assert_allclose(found.policy.sum(axis=-1), 1, atol=1e-6)


def test_bounds_hold_in_the_units_of_the_reward(lake):
    """True loss <= bound at the true weights <= bound over all weights; the robust policy's is the least."""
    value = np.asarray(lake.expert.value @ lake.domain.mdp.initial)
    one_step = 1.0 - float(lake.domain.mdp.discount)
    rows = {name: method(lake) for name, method in guarantees.GUARANTEES.items()}
    worst_of_robust = rows[f"robust policy, {guarantees.WORST}"].certificate
    for name in ("uniform", "k-NN", "Algorithm 1", "max. causal entropy"):
        at_truth, worst = (rows[f"{name}, {kind}"] for kind in (guarantees.TRUE, guarantees.WORST))
        worth = problems.jaxhom.policy_value(lake.domain.bare, at_truth.policy, lake.reward) @ lake.domain.mdp.initial
        assert (at_truth.certificate >= (value - np.asarray(worth)) * one_step - 1e-9).all()
        assert (worst.certificate >= at_truth.certificate - 1e-9).all()
        assert (worst_of_robust <= worst.certificate + 1e-5).all()
    least = rows[f"robust policy, {guarantees.LEAST}"].certificate
    assert (least <= worst_of_robust + 1e-9).all() and (worst_of_robust - least <= 1e-5).all()


@pytest.mark.parametrize("choice", ["demonstrations", "random states", "visits_entropy", "visits", "bound"])
def test_rounds_of_questions(lake, choice):
    """Five questions a round on the small lake, none of them twice, and one more demonstration otherwise."""
    choose = queries._CHOICES[choice]
    before, after = (queries._asked(lake, choose, rounds).demonstrations for rounds in (0, 2))
    for lane in range(2):
        if choice == "demonstrations":
            assert len(after[lane]) == len(before[lane]) + 2
            continue
        answers = after[lane][after[lane].is_answer]
        states = np.asarray(answers.states)[:, 0]
        known = np.asarray(before[lane].states)[np.asarray(before[lane].mask)]
        assert len(states) == 10 and len({*states}) == 10 and not {*states} & {*known}
        best = np.asarray(lake.expert.policy[lane]).argmax(axis=1)
        np.testing.assert_array_equal(np.asarray(answers.actions)[:, 0], best[states])


def rows_of(methods, domains=("grid16", "tiles8"), **fields):
    for domain in domains:
        for count in (1, 2):
            for number, name in enumerate(methods):
                for draw in (0, 1):
                    key = {"demonstrations": count, "distance": 1, "threshold": 0.0, "samples": 0, "regions": 0}
                    row = Row(domain, length=20, trial=30, method=name, draw=draw, seed=0, status="SOLVED", **key)
                    numbers = {"reward_per_step": 0.5 + 0.01 * number + 0.001 * draw, "expert_reward": 1.0} | fields
                    yield dataclasses.replace(row, **numbers)


def test_report_from_rows_alone(tmp_path):
    raw = tmp_path / "raw"
    RowFile(raw / "learners.csv").append(rows_of(learners.LEARNERS))
    bounds = list(rows_of(guarantees.GUARANTEES, loss_bound=0.1, certificate=0.2))
    bounds[0] = dataclasses.replace(bounds[0], loss_bound=0.3)
    RowFile(raw / "guarantees.csv").append(bounds)
    RowFile(raw / "queries.csv").append(rows_of(queries.QUERIES))
    assert report.main(["--results", str(tmp_path)]) == 0
    text = (tmp_path / "report.md").read_text()
    for name in ("learners", "guarantees", "queries"):
        assert {(tmp_path / f"{name}.{end}").exists() for end in ("png", "svg", "csv")} == {True}
    assert "the bound is below the true loss in 1 (largest excess 1e-01 of the expert's reward)" in text
    assert "| lake 8 x 8, tiles | 1 | 5 | 51.0 |" in text


def test_a_sweep_of_one_draw(tmp_path):
    """The command itself, on the smallest setting."""
    options = ["queries", "--draws", "1", "--rows", "tiles8/2", "--methods", "no questions", "visits, round 1"]
    assert reproduce.main([*options, "--output", str(tmp_path)]) == 0
    before, after = RowFile(tmp_path / "raw" / "queries.csv").read()
    assert before.status == after.status == Status.SOLVED.name
    assert jnp.isfinite(jnp.asarray([before.reward_per_step, after.reward_per_step])).all()
