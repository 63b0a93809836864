"""Results are short when printed; bounds are shown rounded outward, and never by more than a digit."""

import copy
import dataclasses
import math
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhom.status import Record, at_most, bracket


def test_brackets_by_hand():
    assert bracket(0.0, 9.1e-13) == "0 <= e <= 1e-06"
    assert bracket(0.25, 0.25) == "0.25 <= e <= 0.25"
    assert bracket(0.1249999, 0.1250001) == "0.124999 <= e <= 0.125001"
    assert bracket(-math.inf, math.inf) == "-inf <= e <= inf"
    assert bracket(0.5, math.nan) == "0.5 <= e <= nan"


@pytest.mark.parametrize(
    ("bound", "text"),
    [(0.0, "0.0e+00"), (4e-11, "1.0e-05"), (0.0321, "3.3e-02"), (5.1, "5.1e+00"), (math.inf, "inf"), (math.nan, "nan")],
)
def test_small_bounds_by_hand(bound, text):
    assert at_most(bound) == text


def test_no_bound_is_shown_smaller_than_it_is(rng):
    for bound in 10.0 ** rng.uniform(-12, 6, size=500):
        assert bound * (1 - 1e-6) <= float(at_most(bound)) <= bound + max(1.001e-5, 0.1001 * bound)


class Answer(Record):
    """What a made-up method returns."""

    policy: object
    gap: object = None
    status: object = None
    size: int = dataclasses.field(default=0, metadata={"static": True})
    memory: object = dataclasses.field(default=None, metadata={"dropped": True})


class Pair(Record):
    first: Answer
    second: object = None


def answer(**changes):
    return Answer(policy=jnp.ones((3, 2)), gap=jnp.asarray(0.25), status=jnp.asarray([0, 0, 2])).replace(**changes)


FULL = "Answer(policy=float64[3,2], gap=0.25, status="
BARE = {"gap": None, "status": None}
TEXTS = {
    "numbers, arrays and statuses": (answer(size=3), FULL + "[2 SOLVED, 1 STALLED], size=3)"),
    "one status": (answer(status=np.int32(1)), FULL + "ITERATION_LIMIT, size=0)"),
    "an unknown status": (answer(status=np.array([7])), FULL + "[1 7], size=0)"),
    "no status": (answer(status=np.zeros(0, int)), FULL + "[], size=0)"),
    "a function": (answer(policy=0, memory=answer, **BARE), "Answer(policy=0, size=0, memory=answer)"),
    "axes": (Answer(policy=0), "Answer(policy=0, size=0)"),
    "shapes": (
        jax.eval_shape(lambda: answer(gap=1)),
        "Answer(policy=float64[3,2], gap=int64[], status=int64[3], size=0)",
    ),
    "a key": (answer(policy=jax.random.key(0), **BARE), "Answer(policy=key<fry>[], size=0)"),
    "names": (answer(policy={"a": np.ones(2), "b": 0.5}, **BARE), "Answer(policy={a: float64[2], b: 0.5}, size=0)"),
    "long": (answer(policy=("#" * 40,) * 12, **BARE), "Answer(policy=tuple[12], size=0)"),
    "one in another": (Pair(first=answer(status=None)), "Pair(first=Answer(policy=float64[3,2], gap=0.25, size=0))"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_records_are_short_when_printed(name):
    record, text = TEXTS[name]
    assert repr(record) == text


def test_long_ones_take_a_few_lines():
    lines = repr(Pair(first=answer(), second={f"event {i}": np.ones((10, 10)) for i in range(9)})).split("\n")
    assert len(lines) == 2 and max(map(len, lines)) <= 170
    assert lines[1].startswith("     second={event 0: float64[10,10], ") and lines[1].endswith(", ...})")


def test_printing_works_on_traced_values_compiles_nothing_and_never_raises():
    class Broken:
        def __repr__(self):
            raise RuntimeError("broken")

    assert repr(answer(policy=Broken())).startswith("Answer(policy=")
    gone = jnp.ones(())
    gone.delete()
    assert "gap=float64[]" in repr(answer(gap=gone))
    seen = []
    jax.vmap(jax.jit(lambda record: seen.append(repr(record)) or record.policy))(answer(gap=jnp.ones(3)))
    assert seen == ["Answer(policy=float64[2], gap=float64[], status=int64[], size=0)"]
    record = answer(policy=jnp.ones((5, 7)))
    with jax.log_compiles(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax.stages.Lowered, "compile", None)
        assert "float64[5,7]" in repr(record)


def test_notebooks_get_a_table_with_text_escaped():
    table = answer(policy="<b>", status=jnp.asarray(0))._repr_html_()
    assert table.startswith("<table><caption>Answer</caption>") and table.endswith("</table>")
    assert "&lt;b&gt;" in table and "<b>" not in table and ">SOLVED</td>" in table


def test_records_are_frozen_pytrees_without_what_is_dropped_or_remembered():
    record = answer(size=2, memory="how")
    with pytest.raises(dataclasses.FrozenInstanceError):
        record.gap = 1
    with pytest.raises(TypeError):
        Answer(jnp.ones(2))
    assert len(jax.tree.leaves(record)) == 3
    assert jax.tree.map(lambda leaf: leaf, record).memory is None
    vars(record)["_remembered"] = "much"
    copies = record.replace(gap=1), pickle.loads(pickle.dumps(record)), copy.copy(record), copy.deepcopy(record)
    for other in copies:
        assert (other.size, other.memory) == (2, "how") and not hasattr(other, "_remembered")
    assert record["size"] == 2 and dict(record)["policy"] is record.policy
    with pytest.raises(KeyError):
        record["weights"]
    assert "policy" in record and "weights" not in record
    with pytest.raises(TypeError):
        list(record)
    assert record == record and record != answer(size=2) and len({record, record}) == 1
