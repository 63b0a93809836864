"""Text files: plain and compressed, with a byte order mark, and what is none."""

import gzip
import re

import pytest

from jaxhom.interop import FileError
from jaxhom.interop.text_files import open_text, without_gz

TEXT = "state,action\nähre,1\n"
GOOD = {
    "plain": TEXT.encode(),
    "byte order mark": TEXT.encode("utf-8-sig"),
    "line breaks of Windows": TEXT.replace("\n", "\r\n").encode(),
    "compressed": gzip.compress(TEXT.encode()),
    "compressed in two parts": gzip.compress(TEXT[:5].encode()) + gzip.compress(TEXT[5:].encode()),
    "compressed with a byte order mark": gzip.compress(TEXT.encode("utf-8-sig")),
}
BAD = {
    "Latin-1": (TEXT.encode("latin-1"), "not a text file in UTF-8 (invalid"),
    "UTF-16": (TEXT.encode("utf-16"), "not a text file in UTF-8 ("),
    "zero bytes": (b"state\0action", "not a text file in UTF-8 (it holds zero bytes)"),
    "cut off": (gzip.compress(TEXT.encode() * 1000)[:-20], "compressed contents are damaged or cut off"),
    "damaged header": (b"\x1f\x8b\x07rest of it", "compressed contents are damaged or cut off"),
    "damaged": (gzip.compress(TEXT.encode())[:10] + b"\xff" * 30, "compressed contents are damaged or cut off"),
    "compressed Latin-1": (gzip.compress(TEXT.encode("latin-1")), "not a text file in UTF-8 (invalid"),
}


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz"])
@pytest.mark.parametrize("kind", GOOD)
def test_text_is_read_whatever_the_name(tmp_path, kind, name):
    path = tmp_path / name
    path.write_bytes(GOOD[kind])
    with open_text(path) as file:
        assert file.read() == TEXT


def test_line_breaks_are_kept_where_told(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(b"a\r\nb\n")
    with open_text(path, newline="") as file:
        assert list(file) == ["a\r\n", "b\n"]


@pytest.mark.parametrize("kind", BAD)
def test_what_is_no_text_is_refused(tmp_path, kind):
    contents, message = BAD[kind]
    path = tmp_path / "a.csv"
    path.write_bytes(contents)
    with pytest.raises(FileError, match=f"^{re.escape(f'{path}: ')}.*{re.escape(message)}"), open_text(path) as file:
        file.read()


def test_missing_files_and_folders_are_refused(tmp_path):
    for path, message in ((tmp_path / "none.csv", "no such file"), (tmp_path, "Is a directory")):
        with pytest.raises(FileError, match=f"^{re.escape(str(path))}: {message}$"), open_text(path):
            pass


def test_errors_of_the_block_stay_what_they_are(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(TEXT)
    with pytest.raises(KeyError), open_text(path):
        raise KeyError("mine")


@pytest.mark.parametrize(
    ("path", "expected"), [("a.csv.gz", "a.csv"), ("a.CSV.GZ", "a.CSV"), ("a.csv", "a.csv"), ("b/gz", "b/gz")]
)
def test_suffix_of_compression_is_taken_off(path, expected):
    assert without_gz(path) == expected
