import io
import json

import pytest
import rfc8785
from hypothesis import given
from hypothesis import strategies as st

from robosac.audit.lines import MOST_BYTES, RecordError, is_canonical, lines_in, read

NUMBERS = (
    st.integers(-(2**60), 2**60)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.floats(-1e-3, 1e-3)
    | st.integers(-50, 50).map(float)
    | st.integers(0, 30).map(lambda digits: 10.0**digits)
    | st.integers(0, 12).map(lambda digits: 10.0**-digits)
)
WORDS = st.text(max_size=8) | st.sampled_from(["1.0", ":1.0,", "[1e5]", ",12345678901234567,", "\x7f", "\u2028", "/"])
NAMES = WORDS | st.sampled_from(["\U0001f600", "\uffee", "a", "B"])
VALUES = st.recursive(
    st.none() | st.booleans() | NUMBERS | WORDS,
    lambda values: st.lists(values, max_size=3) | st.dictionaries(NAMES, values, max_size=3),
    max_leaves=8,
)
RECORDS = st.dictionaries(NAMES, VALUES, max_size=4)
ODD = ("1.0", "-0", "-0.0", "1e5", "1E5", "1e-7", "1e+21", "0.00001", "0.10", "1.50", "100.0", "1.0e1")


def canonical(record):
    try:
        return rfc8785.dumps(record)
    except rfc8785.CanonicalizationError:
        return None


@given(RECORDS, st.booleans(), st.booleans(), st.sampled_from([(",", ":"), (", ", ":"), (",", ": ")]))
def test_a_line_is_canonical_if_the_library_for_it_writes_the_same(record, ascii_only, in_order, separators):
    written = json.dumps(record, ensure_ascii=ascii_only, sort_keys=in_order, separators=separators)
    for line in (written.encode("utf-8", "surrogatepass"), canonical(record)):
        try:
            again = read(line)
        except (ValueError, TypeError, AttributeError):  # no UTF-8, or no canonical form
            continue
        assert is_canonical(line, again) == (canonical(again) == line)


@pytest.mark.parametrize("number", [*ODD, "9007199254740993", "1234567890" * 3])
@pytest.mark.parametrize("where", ['{{"a":{}}}', '{{"a":[{}]}}', '{{"a":[1,{}]}}', '{{"a":{{"b":{},"c":1}}}}'])
def test_numbers_are_written_in_one_way(number, where):
    line = where.format(number).encode()
    record = read(line)
    assert is_canonical(line, record) == (canonical(record) == line)


@pytest.mark.parametrize("end", [b"\n", b"\n{}", b"\n{}\n", b""])
@pytest.mark.parametrize("more", [0, 1, 2, 3, MOST_BYTES])
def test_of_a_line_that_is_too_long_no_more_is_read_than_shows_it(more, end):
    first, *others = lines_in(io.BytesIO(b" " * (MOST_BYTES + more) + end))
    assert len(first) <= MOST_BYTES + 2
    assert others == [end[1:]] * (len(end) > 1)
    with pytest.raises(RecordError, match="at most" if more else "empty"):
        read(first.removesuffix(b"\n"))
