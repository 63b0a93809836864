"""What pages quote is what the rows say."""

import pytest

from bench import quotations


@pytest.fixture(scope="module")
def quoted():
    return quotations.quotations()


def test_pages_say_what_the_rows_say(quoted):
    assert [one.passage for one in quoted if not one.is_up_to_date] == []
    pages = {"README.md", *(f"docs/{name}.md" for name in ("which_method", "relations", "scale", "sweeps"))}
    assert {one.page for one in quoted} == pages and len(quoted) > 50


def test_another_digit_is_out_of_date(quoted):
    """Passages hold numbers, and a page that has others does not have them."""
    for one in quoted:
        digits = [place for place, letter in enumerate(one.passage) if letter.isdigit()]
        changed = (
            one.passage[: digits[-1]] + str((int(one.passage[digits[-1]]) + 1) % 10) + one.passage[digits[-1] + 1 :]
        )
        assert not quotations.Quotation(one.page, changed).is_up_to_date
