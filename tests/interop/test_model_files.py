"""Models by the suffix of their file, and the command line on each of them."""

import gzip

import numpy as np
import pytest

import jaxhom
from jaxhom.cli.parser import main
from jaxhom.interop import FileError, load_policy, read_model, save_mdp, save_policy

FILES = {  # a walk of two or three states each, and one feature or reward at least
    "lamp.POMDP": "discount: 0.9\nstates: lit dark\nactions: wait turn\nobservations: 2\n"
    "T: wait identity\nT: turn\n0 1\n1 0\nR: * : dark : * : * 1\n",
    "lamp.mdp": "discount: 0.9\nstates: 2\nactions: 2\nT: * uniform\nR: 0 : 0 : 1 1\n",
    "coin.tra": "2 2 3\n0 0 0 0.5\n0 0 1 0.5\n1 0 0 1\n",
    "walk.csv": "state,action,next,reward\n0,0,1,2\n1,0,0,0\n1,1,1,0\n",
    "walk.tsv": "state\taction\tnext\treward\n0\t0\t1\t2\n1\t0\t0\t0\n",
    "yard.map": "type octile\nheight 2\nwidth 3\nmap\n..@\n.T.\n",
    "small.gw": "G.x\n@.S\n",
    "roads.edgelist": "0 1 2.5\n1 0 2.5\n1 2 1\n2 1 1\n",
    "roads.edges": "0,1\n1,0\n",
}
DISCOUNT = {"lamp.POMDP": 0.9, "lamp.mdp": 0.9}


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("name", FILES)
def test_every_suffix_has_its_reader(tmp_path, name, compressed):
    path = tmp_path / (name + ".gz" * compressed)
    path.write_bytes(gzip.compress(FILES[name].encode()) if compressed else FILES[name].encode())
    model = read_model(path)
    assert float(model.mdp.discount) == DISCOUNT.get(name, 0.99)
    assert float(read_model(path, discount=0.5).mdp.discount) == 0.5
    np.testing.assert_allclose(model.mdp.transition.sum(axis=-1), np.asarray(model.mdp.allowed, float))


def test_archives_hold_what_lies_beside_the_model(tmp_path):
    world = jaxhom.gridworld(4)
    save_mdp(tmp_path / "world.npz", world.mdp)
    with np.load(tmp_path / "world.npz") as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "world.npz", **arrays, reward=np.arange(16.0), coordinates=world.coordinates)
    model = read_model(tmp_path / "world.npz")
    assert model.reward.shape == (16, 4) and model.reward[:, 3].tolist() == list(range(16))
    np.testing.assert_array_equal(model.coordinates, world.coordinates)
    assert model.terminal is None and model.state_names is None


@pytest.mark.parametrize("name", ["a.foo", "a", "a.npz.gz.foo", "a.gz"])
def test_other_suffixes_are_refused(tmp_path, name):
    with pytest.raises(FileError, match=f"{name}: models are .npz, .pomdp, .mdp, .tra, .csv, .tsv, .map, .gw"):
        read_model(tmp_path / name)


PIECES = ["", "0", "-1", "nan", "1e999", "x", "*", ":", "\n", "#", ",", '"', "@", "{", "é", "9" * 25, "T:", "uniform"]


@pytest.mark.parametrize("name", FILES)
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path, name):
    """Pieces of each file exchanged for others."""
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(30):
        text = FILES[name]
        for start in rng.integers(len(text), size=2):
            text = text[:start] + PIECES[rng.integers(len(PIECES))] + text[start + rng.integers(5) :]
        (tmp_path / name).write_text(text)
        try:
            read_model(tmp_path / name)
        except FileError as error:
            assert "\n" not in str(error) and name in str(error)
            refused += 1
    assert refused > 0


def test_policies_are_learned_in_files_of_others(tmp_path, capsys):
    """A reward, so that the expert can be sampled; remarks on stderr."""
    for name in ("lamp.POMDP", "walk.csv"):
        (tmp_path / name).write_text(FILES[name])
        output = tmp_path / f"{name}.npz"
        main(["learn", "--mdp", str(tmp_path / name), "--expert", "2", "--steps", "6", "--output", str(output)])
        told = capsys.readouterr()
        assert (told.err == f"jaxhom: {tmp_path / name}: 2 observations ignored\n") == (name == "lamp.POMDP")
        assert name in told.out
        best = np.asarray(jaxhom.optimal_policy(*(lambda m: (m.mdp, m.reward))(read_model(tmp_path / name))).policy)
        np.testing.assert_allclose(load_policy(output)[0], best[0])


def test_maps_are_drawn(tmp_path):
    """A picture of a model that has neither a reward nor an end."""
    (tmp_path / "yard.map").write_text(FILES["yard.map"])
    allowed = np.asarray(read_model(tmp_path / "yard.map").mdp.allowed)
    save_policy(tmp_path / "policy.npz", allowed / allowed.sum(axis=1, keepdims=True))
    picture = tmp_path / "policy.png"
    arguments = [str(tmp_path / "policy.npz"), "--mdp", str(tmp_path / "yard.map"), "--output", str(picture)]
    main(["plot", "policy", *arguments])
    assert picture.stat().st_size > 1000


def test_discounts_that_a_file_lacks_are_asked_for(tmp_path):
    (tmp_path / "lamp.POMDP").write_text(FILES["lamp.POMDP"].replace("0.9", "1.0"))
    with pytest.raises(FileError, match=r"line 1 \(discount\): must lie strictly between 0 and 1, got 1: give another"):
        read_model(tmp_path / "lamp.POMDP")
