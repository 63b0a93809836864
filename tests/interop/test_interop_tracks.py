"""`.track` maps of planning benchmarks as racetracks: headers, letters, what is refused."""

import pathlib
import re

import numpy as np
import pytest

from jaxhom.domains.racetrack import racetrack

ROOT = pathlib.Path(__file__).resolve().parent.parent.parent
ROWS = ("#####", "#S..#", "#.#F#", "#####")
MAP = "xxxxx\nxs..x\nx.xgx\nxxxxx"
HEADERS = ["", "dim: 4 5\n", "DIM:4 5\n", "4,5\n", "4 , 5\n", "5 4\n", " 5\t4 \n", "5\n4\n"]


@pytest.mark.parametrize("header", HEADERS)
@pytest.mark.parametrize("end", ["", "\n", "\n\n\n"])
def test_headers_say_the_size_of_the_map(header, end):
    assert racetrack(header + MAP + end).rows == ROWS


def test_a_track_file_with_a_header_is_a_racetrack(tmp_path):
    path = tmp_path / "oval.track"
    path.write_bytes(b"\xef\xbb\xbf5\r\n4\r\n" + MAP.upper().replace("\n", "\r\n").encode())
    track, plain = racetrack(path), racetrack(ROWS)
    assert track.rows == ROWS
    np.testing.assert_array_equal(track.mdp.initial, plain.mdp.initial)
    np.testing.assert_array_equal(track.mdp.probability, plain.mdp.probability)
    assert np.flatnonzero(track.mdp.initial).tolist() == [track.state_of((1, 1))]


def test_the_benchmarks_own_track_is_read_from_its_file():
    path = ROOT / "bench" / "tracks" / "corner.track"
    lines = path.read_text().splitlines()
    track = racetrack(path)
    assert track.rows == racetrack([f"dim: {len(lines)} {len(lines[0])}", *lines]).rows
    assert track.mdp.num_states == 25 * sum(line.count(letter) for line in lines for letter in ".SF")


def test_letters_of_either_case_and_spaces_are_road():
    assert racetrack("X x#\nS.s \nGgF.").rows == ("#.##", "S.S.", "FFF.")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("dim: 4 5\n" + MAP[:-6], "track has 3 rows, but its header says 4 rows of 5 columns"),
        ("dim: 5 4\n" + MAP, "track has 4 rows, but its header says 5 rows of 4 columns"),
        ("4 5\n" + MAP, "track has 4 rows, but its header says 5 rows of 4 columns"),
        ("5,4\n" + MAP, "track has 4 rows, but its header says 5 rows of 4 columns"),
        ("6\n4\n" + MAP, "track line 3 has 5 columns, but its header says 4 rows of 6 columns"),
        ("dim: 4 5\n" + MAP.replace("..x", ".."), "track line 3 has 4 columns, but its header says"),
        ("dim: 4\n" + MAP, "track line 1: a header must be `dim: rows columns`"),
        ("dim 4 5\n" + MAP, "track line 1: a header must be"),
        ("4.0 5.0\n" + MAP, "track line 1: a header must be"),
        ("5\n" + MAP, "track line 1: a header must be"),
        ("1 2 3\n" + MAP, "track line 1: a header must be"),
        ("5\n", "track line 1: a header must be"),
        ("dim: 0 0\n", "track has no road cell (space, . or S) in its 0 rows"),
        (
            "dim: 4 5\n" + MAP.replace("g", "q"),
            "track line 4, column 4: unknown letter 'q'; use X, x, #, o or @ (wall)",
        ),
        ("5\n4\n" + MAP.replace("s", "&"), "track line 4, column 2: unknown letter '&'"),
        ("5 4\n\n" + MAP, "track has 5 rows, but its header says 4 rows of 5 columns"),
        (MAP.replace("g", "\f"), r"track line 3, column 4: unknown letter '\x0c'"),
        ("\n\n", "track has no road cell"),
    ],
)
def test_malformed_tracks_are_refused(text, message):
    with pytest.raises(ValueError, match=re.escape(message)) as raised:
        racetrack(text)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("track", "message"),
    [
        (None, "track must be a name, a path or a map, got NoneType"),
        (3, "track must be a name, a path or a map, got int"),
        ([3, "S.F"], "track line 1 must be text, got int"),
        (b"S.F", "track line 1 must be text, got int"),
    ],
)
def test_what_is_no_text_is_refused(track, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        racetrack(track)


def test_files_that_are_no_text_are_refused(tmp_path):
    path = tmp_path / "picture.track"
    path.write_bytes(b"\x89PNG\x00\xff")
    with pytest.raises(ValueError, match=r"picture.track' is not a text file"):
        racetrack(path)
    for missing in (tmp_path, "S..F" * 200, "no\0file"):
        with pytest.raises(FileNotFoundError, match="neither shipped"):
            racetrack(missing)


def test_a_map_with_too_many_starts_is_refused_before_it_is_built():
    """100 x 100 cells of road: a car put back to any of them has 10^4 successors in each of 250000 states."""
    with pytest.raises(ValueError, match=r"250000 x 5 x 9999 successor slots"):
        racetrack(["." * 100] * 99 + ["." * 99 + "F"])
