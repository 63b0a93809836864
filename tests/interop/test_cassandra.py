"""Cassandra's format, against a reader that fills dense tables statement by statement."""

import gzip
import itertools
import re

import numpy as np
import pytest
from small_models import dense_transition

from jaxhom.interop import FileError, cassandra_statements
from jaxhom.interop.cassandra import from_cassandra

HEAD = "discount: 0.9\nvalues: reward\nstates: a b c\nactions: go stay\nobservations: x y\n"
STAY = "T: stay identity\n"


def write(folder, text, name="model.POMDP"):
    path = folder / name
    path.write_text(text)
    return path


def read(folder, text, **options):
    return from_cassandra(write(folder, text), **options)


def slow_tables(text):
    """T [A, S, S], O [A, S, O], R [A, S, S, O] and the start of a file whose statements are one on a line each."""
    lines = [line.split("#")[0] for line in text.splitlines() if line.split("#")[0].strip()]
    names = {}
    for word in ("states", "actions", "observations"):
        (line,) = [line for line in lines if line.startswith(word)]
        things = line.split(":")[1].split()
        names[word] = [str(n) for n in range(int(things[0]))] if len(things) == 1 and things[0].isdigit() else things
    states, actions, seen = names["states"], names["actions"], names["observations"]
    s, a, o = len(states), len(actions), len(seen)
    start = np.full(s, 1 / s)
    axes = {"T": (actions, states, states), "O": (actions, states, seen), "R": (actions, states, states, seen)}
    tables = {word: np.zeros([len(axis) for axis in axes[word]]) for word in axes}
    assert [t.shape for t in tables.values()] == [(a, s, s), (a, s, o), (a, s, s, o)]
    for line in lines:
        word = line.split(":")[0].strip()
        if word in tables:
            *fields, tail = line.split(":")[1:]
            last, *values = tail.split()
            fields = [*map(str.strip, fields), last]
            which = [
                range(len(axis)) if field == "*" else [axis.index(field) if field in axis else int(field)]
                for field, axis in zip(fields, axes[word], strict=False)
            ]
            rest = tables[word].shape[len(fields) :]
            if values == ["uniform"]:
                block = np.full(rest, 1 / rest[-1])
            elif values == ["identity"]:
                block = np.eye(s)
            elif values == ["reset"]:
                block = np.broadcast_to(start, rest)
            else:
                block = np.array([float(value) for value in values]).reshape(rest)
            for place in itertools.product(*which):
                tables[word][place] = block
    return tables["T"], tables["O"], tables["R"], start


def random_file(rng, num_states, num_actions, num_seen):
    """Statements of all forms in any order, ending with rows that make all of T and O distributions."""
    axes = {"T": (num_actions, num_states, num_states), "O": (num_actions, num_states, num_seen)}
    axes["R"] = (num_actions, num_states, num_states, num_seen)
    lines = ["discount: 0.9", "values: reward", f"states: {num_states}"]
    lines += [f"actions: {' '.join(f'act{n}' for n in range(num_actions))}", f"observations: {num_seen}"]
    for _ in range(40):
        word = rng.choice(["T", "O", "R"])
        shape = axes[word]
        count = rng.integers(1 if word != "R" else 2, len(shape) + 1)
        fields = ["*" if rng.random() < 0.3 else str(rng.integers(size)) for size in shape[:count]]
        if fields[0] != "*" and rng.random() < 0.5:
            fields[0] = f"act{fields[0]}"
        rest = shape[count:]
        values = " ".join(f"{v:.3g}" for v in rng.integers(-3 if word == "R" else 0, 4, size=rest).ravel())
        if word != "R" and rest and rng.random() < 0.4:
            values = rng.choice(["uniform", "reset", "identity"] if len(rest) == 2 and word == "T" else ["uniform"])
        lines.append(f"{word}: {' : '.join(fields)} {values}")
    for word in ("T", "O"):
        for a, s in itertools.product(*map(range, axes[word][:2])):
            lines.append(f"{word}: {a} : {s} {' '.join(map(repr, rng.dirichlet(np.ones(axes[word][2])).tolist()))}")
            if word == "T" and rng.random() < 0.5:  # an entry or two after the row
                lines[-1] = f"T: {a} : {s} uniform"
                z, y = rng.permutation(num_states)[:2]
                lines += [f"T: {a} : {s} : {z} 0", f"T: act{a}:{s}:{y} {float(2 / num_states)!r}"]
    return "\n".join(lines)


@pytest.mark.parametrize("seed", range(8))
def test_all_forms_of_statements_agree_with_a_slow_reader(tmp_path, seed):
    rng = np.random.default_rng(seed)
    text = random_file(rng, *rng.integers(2, 6, size=3))
    transition, observation, reward, start = slow_tables(text)
    model = read(tmp_path, text)
    np.testing.assert_allclose(dense_transition(model.mdp), transition.swapaxes(0, 1), atol=1e-12)
    expected = np.einsum("asz,azo,aszo->sa", transition, observation, reward)
    np.testing.assert_allclose(model.reward, expected, atol=1e-10)
    np.testing.assert_allclose(model.mdp.initial, start)


def test_a_file_as_people_write_them(tmp_path):
    """Comments, names over several lines, matrices, numbers for names, costs, and a start."""
    model = read(
        tmp_path,
        """
# a lamp
discount : 0.95   # per hour
values: cost
states:
  lit
  T dark   # the second is called T
actions: wait repair
observations: 2
start: T

T : wait
0.9 1e-1 0
0.0 0.5
   0.5
0 0 1.0
T:repair:*   reset
O: * uniform
R: * : * : * : * 1
R: wait : 2 : * : * 5.5
R: repair : lit
2 2
3 3
4 4
""",
    )
    assert model.state_names == ("lit", "T", "dark") and model.action_names == ("wait", "repair")
    np.testing.assert_allclose(model.mdp.transition[:, 0], [[0.9, 0.1, 0.0], [0.0, 0.5, 0.5], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(model.mdp.transition[:, 1], np.tile([0.0, 1.0, 0.0], (3, 1)))
    np.testing.assert_allclose(model.reward, [[-1.0, -3.0], [-1.0, -1.0], [-5.5, -1.0]])
    assert float(model.mdp.discount) == pytest.approx(0.95) and model.mdp.initial.tolist() == [0.0, 1.0, 0.0]
    assert model.remarks == ("costs became rewards with the sign changed", "2 observations ignored")


@pytest.mark.parametrize(
    ("start", "expected"),
    [
        ("", [1 / 3] * 3),
        ("start: uniform", [1 / 3] * 3),
        ("start: b", [0, 1, 0]),
        ("start: 2", [0, 0, 1]),
        ("start: 0.5 0.25\n0.25", [0.5, 0.25, 0.25]),
        ("start: a c", [0.5, 0, 0.5]),
        ("start include: a 1", [0.5, 0.5, 0]),
        ("start  exclude : c", [0.5, 0.5, 0]),
        ("start: 0.500008 0.5 0.0", [0.500008 / 1.000008, 0.5 / 1.000008, 0]),
    ],
)
def test_where_episodes_start(tmp_path, start, expected):
    model = read(tmp_path, f"{HEAD}{start}\n{STAY}T: go reset\n")
    np.testing.assert_allclose(model.mdp.initial, expected, rtol=1e-6)
    np.testing.assert_allclose(model.mdp.transition[:, 0], np.tile(expected, (3, 1)), rtol=1e-6)
    assert model.reward is None


def test_large_tables_may_be_set_to_0_first(tmp_path):
    """6 x 10^6 entries that are never written out; what stood there before is gone."""
    count = 1000
    text = f"discount: 0.9\nstates: {count}\nactions: 6\nT: * : 3 : 4 0.5\nT: * : * : * 0\n"
    model = read(tmp_path, text + "T: * : * : 7 1\nT: 2 identity\n")
    assert model.mdp.next_state.shape == (count, 6, 1)
    expected = np.full((count, 6), 7)
    expected[:, 2] = np.arange(count)
    np.testing.assert_array_equal(model.mdp.next_state[..., 0], expected)


def test_several_statements_on_a_line(tmp_path):
    """Its readers see words and not lines; a word behind a colon is a name, `T` and `start` too."""
    lines = ["discount: 0.9", "states: T start", "actions: O", "start: 0.25 0.75", "T: O : T : start 1.0"]
    lines += ["T: O : start 0.5 0.5", "R: O : T : * : * 3", "R: O :start : * : * -1"]
    one, many = (read(tmp_path, text) for text in (" ".join(lines), "\n".join(lines)))
    for got, expected in ((one.reward, many.reward), (one.mdp.transition, many.mdp.transition)):
        np.testing.assert_array_equal(got, expected)
    assert one.mdp.initial.tolist() == [0.25, 0.75] and many.reward.tolist() == [[3.0], [-1.0]]
    with pytest.raises(FileError, match=r"line 3 \(T\): no state 'd' among"):
        read(tmp_path, f"{HEAD.replace(chr(10), ' ', 3)}T: go uniform {STAY[:-1]} T: go : c : d 1")


def test_models_without_observations(tmp_path):
    """A `.MDP` file: rewards have no fourth field, and may be rows and matrices over next states."""
    text = "discount: 0.9\nstates: 2\nactions: 2\nT: * uniform\nR: 0 : 0 : 1 4\nR: 1 : 0\n1 3\nR: 1 : 1 : * : * 7\n"
    model = read(tmp_path, text)
    assert model.reward.tolist() == [[2.0, 2.0], [0.0, 7.0]] and model.state_names is None and model.remarks == ()


def test_discounts(tmp_path):
    text = HEAD + STAY + "T: go uniform\n"
    assert read(tmp_path, text, discount=0.5).remarks[0] == "discount 0.9 replaced by 0.5"
    assert float(read(tmp_path, text.replace("0.9", "1.0"), discount=0.5).mdp.discount) == 0.5
    without = text.replace("discount: 0.9\n", "")
    assert not any("discount" in remark for remark in read(tmp_path, without, discount=0.5).remarks)
    with pytest.raises(FileError, match="it has no discount: give one"):
        read(tmp_path, without)
    for wrong in (1.0, "high", [0.5]):
        with pytest.raises(ValueError, match="discount must"):
            read(tmp_path, text, discount=wrong)


def test_sums_that_are_a_little_off(tmp_path):
    model = read(tmp_path, HEAD + STAY + "T: go\n0.333333 0.333333 0.333333\n0 1 0\n0.333336 0.333336 0.333336\n")
    np.testing.assert_allclose(model.mdp.transition[0, 0], [1 / 3] * 3, atol=1e-12)
    assert "2 rows of probabilities missed 1 by up to 8e-06: divided by their sums" in model.remarks


def test_observations_count_where_rewards_depend_on_them(tmp_path):
    text = HEAD + STAY + "T: go uniform\nO: * : *\n0.25 0.75\nR: go : * : * : y 4\nR: go : b : b : y 0\n"
    model = read(tmp_path, text)
    np.testing.assert_allclose(model.reward[:, 0], [3.0, 2.0, 3.0])
    assert model.remarks == ("reward depends on the 2 observations: the expected one is used",)


def test_compressed_files_and_many_statements(tmp_path, monkeypatch):
    """More statements than are split at once, and one among them that is no plain one."""
    monkeypatch.setattr(cassandra_statements, "_CHUNK", 7)
    count = 12
    rows = [f"T: {a} : {s} : {(s + a) % count} 1.0" for a in range(9) for s in range(count)]
    rows.insert(30, "R: 3\n:\n5 : * : * 2")
    text = f"discount: 0.9\nstates: {count}\nactions: 9\nobservations: 1\n" + "\n".join(rows)
    path = tmp_path / "ring.POMDP.gz"
    path.write_bytes(gzip.compress(text.encode()))
    model = from_cassandra(path)
    assert model.mdp.transition[:, 7].argmax(axis=-1).tolist() == [(s + 7) % count for s in range(count)]
    assert np.argwhere(np.asarray(model.reward)).tolist() == [[5, 3]]


BAD = {
    "no statement": ("hello\n" + HEAD, "line 1: expected a statement such as `states: ...`, got 'hello'"),
    "text before": ("\n\nhello: 3\n" + HEAD, "line 3: expected a statement"),
    "empty": ("", "it declares no states (it has nothing)"),
    "no actions": ("discount: 0.9\nstates: 2\n", "it declares no actions (it has discount, states)"),
    "two of one": (HEAD + "discount: 0.8\n", "line 6 (discount): it stands on line 1 already"),
    "two starts": (HEAD + "start: a\nstart include: b\n", "line 7 (start include): it stands on line 6 already"),
    "no states": ("states: 0\n", "line 1 (states): there must be one state at least, got 0"),
    "too many states": ("states: 99999999999\n", "line 1 (states): there must be one state at least"),
    "nameless": ("states:\nactions: 2\n", "line 1 (states): expected the number of states or their names"),
    "twins": ("states: a b a\n", "line 1 (states): state 'a' is named twice"),
    "too large": ("states: 99999\nactions: 99999\n", "more than 2^31 - 2"),
    "discount of 1": (HEAD.replace("0.9", "1.0"), "line 1 (discount): must lie strictly between 0 and 1, got 1"),
    "discount in words": (HEAD.replace("0.9", "high"), "line 1 (discount): expected a number, got 'high'"),
    "values": (HEAD.replace("values: reward", "values: gain") + "T: * uniform\n", "line 2 (values): must be reward or"),
    "start off": (HEAD + "start: 0.5 0.4 0\n", "line 6 (start): sum of initial must be 1"),
    "start short": (HEAD + "start: 0.5 0.5\n", "line 6 (start): expected 3 numbers, got 2: '0.5 0.5'"),
    "start unknown": (HEAD + "start: d\n", "line 6 (start): no state 'd' among 'a, b, c'"),
    "start everywhere": (HEAD + "start include: *\n", "line 6 (start include): expected a state, got '*'"),
    "start nowhere": (HEAD + "start exclude: a b c\n", "line 6 (start exclude): no state is left to start in"),
    "state": (HEAD + "T: go : d : a 1\n", "line 6 (T): no state 'd' among 'a, b, c'"),
    "state among many": (HEAD + STAY + "T: go : a : a 1\nT: go : 3 : a 1\n", "line 8 (T): no state '3' among"),
    "action": (HEAD + "T: fly : a : a 1\n", "line 6 (T): no action 'fly' among 'go, stay'"),
    "action of a matrix": (HEAD + "\nT: fly identity\n", "line 7 (T): no action 'fly' among 'go, stay'"),
    "no action": (HEAD + "T:\n", "line 6 (T): expected an action"),
    "observation": (HEAD + "T: * uniform\nR: * : * : * : z 1\n", "line 7 (R): no observation 'z' among 'x, y'"),
    "too many fields": (HEAD + "T: go : a : a : x 1\n", "line 6 (T): 4 fields, but the table has 3"),
    "number": (HEAD + "T: go : a : a one\n", "line 6 (T): expected a number, got 'one'"),
    "underscore": (HEAD + "T: go : a : a 0_1\n", "line 6 (T): expected a number, got '0_1'"),
    "number among many": (HEAD + "T: go : a : a 1\nT: go : b : b nan\n", "line 7 (T): expected a number, got 'nan'"),
    "number missing": (HEAD + "T: go : a : a\nT: go : a : b 1\n", "line 6 (T): expected 1 number, got 0"),
    "two numbers": (HEAD + "T: go : a : a 0.5 0.5\n", "line 6 (T): expected 1 number, got 2: '0.5 0.5'"),
    "row short": (HEAD + "T: go : a\n0.5 0.5\n", "line 6 (T): expected 3 numbers, got 2: '0.5 0.5'"),
    "matrix long": (HEAD + "T: go\n" + "1 0 0\n" * 4, "line 6 (T): expected 9 numbers, got 12"),
    "word in a matrix": (HEAD + "T: go\n1 0 0\n0 one 0\n0 0 1\n", "line 6 (T): expected a number, got 'one'"),
    "identity of a row": (HEAD + "T: go : a identity\n", "line 6 (T): 'identity' is not for this table or part of it"),
    "uniform rewards": (HEAD + "T: * uniform\nR: go : a uniform\n", "line 7 (R): expected 6 numbers, got 1"),
    "row off": (
        HEAD + STAY + "T: go : * 0.5 0.4 0.0\n",
        "probabilities of action 'go' in state 'a' must sum to 1, got 0.9",
    ),
    "negative": (HEAD + STAY + "T: go : * 1.5 -0.5 0\n", "action 'go' in state 'a', column 1 must not be negative"),
    "no row": (
        HEAD + STAY + "T: go : a : a 1\n",
        "no probabilities (T) of action 'go' in state 'b', nor of 1 other pair",
    ),
    "no transitions": (HEAD, "no probabilities (T) of action 'go' in state 'a', nor of 5 other pairs"),
    "observations off": (
        HEAD + "T: * uniform\nO: * : * : x 0.5\nR: * : * : * : x 1\n",
        "observations (O) of action 'go' and next state 'a' must sum to 1, got 0.5",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_refused_by_line(tmp_path, case):
    text, message = BAD[case]
    path = write(tmp_path, text)
    with pytest.raises(FileError, match=f"^{re.escape(str(path))}.*{re.escape(message)}"):
        from_cassandra(path)


def test_files_that_are_none(tmp_path):
    with pytest.raises(FileError, match="no such file"):
        from_cassandra(tmp_path / "none.POMDP")
    (tmp_path / "binary.POMDP").write_bytes(bytes(range(256)))
    with pytest.raises(FileError, match="not a text file"):
        from_cassandra(tmp_path / "binary.POMDP")


@pytest.mark.parametrize(
    ("lines", "line", "name"),
    [
        (["discount: 0.9", "actions: a b", "value: cost", "states: 2", "T: * uniform"], 3, "value"),
        (["discount: 0.9", "actions: 2", "states: 2", "Start: 0", "T: * uniform"], 4, "Start"),
        (["discount: 0.9", "states: 2", "actions: 2", "", "Observations : 3", "T: * identity"], 5, "Observations"),
    ],
)
def test_statements_that_are_not_known_are_no_names(tmp_path, lines, line, name):
    path = tmp_path / "misspelt.POMDP"
    path.write_text("\n".join(lines))
    with pytest.raises(FileError, match=rf"line {line}: no statement '{name}' is known; those that are: disc"):
        from_cassandra(path)
