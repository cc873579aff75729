"""Line numbers of TOML keys in all syntaxes."""

from __future__ import annotations

import tomllib

from hypothesis import given, strategies as st

from lumisplat.io.scene_toml.toml_table import line_numbers

DOCUMENT = '''\
# comment = 0
plain = 1.5e3
"quoted = key" = "a # string"
dotted.key.here = true
multi = """line
[not.a.table]
""""
literal = \'\'\'
x = 1\'\'\'
date = 1979-05-27 07:32:00
list = [ 1, 2,   # two
  [3], "]",
]
inline = { a = 1, b.c = { d = [ { e = 1 }, { f = 2 } ] } }

[table.sub]   # header
key = 'v]='

[[array]]
x = 1
[array.below]
y = 2
[[array]]
x = 3
[[array.deep]]
z = 4
[[array.deep]]
z = 5
'''

LINES = {
    ("plain",): 2,
    ("quoted = key",): 3,
    ("dotted",): 4,
    ("dotted", "key", "here"): 4,
    ("multi",): 5,
    ("literal",): 8,
    ("date",): 10,
    ("list",): 11,
    ("list", 1): 11,
    ("list", 2): 12,
    ("list", 3): 12,
    ("inline", "a"): 14,
    ("inline", "b", "c", "d", 1, "f"): 14,
    ("table", "sub"): 16,
    ("table", "sub", "key"): 17,
    ("array",): 19,
    ("array", 0): 19,
    ("array", 0, "x"): 20,
    ("array", 0, "below"): 21,
    ("array", 0, "below", "y"): 22,
    ("array", 1): 23,
    ("array", 1, "x"): 24,
    ("array", 1, "deep", 0): 25,
    ("array", 1, "deep", 1): 27,
    ("array", 1, "deep", 1, "z"): 28,
}


def test_toml_line_numbers_are_found_for_every_key_syntax() -> None:
    """Documents have comments, four kinds of strings, dates, multi-line arrays, inline tables and headers."""
    tomllib.loads(DOCUMENT)
    found = line_numbers(DOCUMENT)
    assert {path: found.get(path) for path in LINES} == LINES
    assert not [path for path in found if "not" in path or "comment" in path]


def test_toml_line_numbers_allow_crlf_and_no_final_newline() -> None:
    """Lines are counted as editors do."""
    assert line_numbers("a = 1\r\n[t]\r\nb = [1,\r\n2]\r\nc = 3") == {
        ("a",): 1,
        ("t",): 2,
        ("t", "b"): 3,
        ("t", "b", 0): 3,
        ("t", "b", 1): 4,
        ("t", "c"): 5,
    }


KEYS = st.text(st.sampled_from("ab-_1"), min_size=1, max_size=4)
TEXTS = st.text(st.sampled_from("ab []{}=,.#'\n"), max_size=8)


def written(value: object) -> str:
    """Formats a value as TOML, with multi-line strings where it has line breaks."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"""\n{value}"""' if "\n" in value else f'"{value}"'
    if isinstance(value, list):
        return "[ " + ",\n ".join(map(written, value)) + " ]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {written(item)}" for key, item in value.items() if not lines_of(item)) + " }"
    return repr(value)


def lines_of(value: object) -> int:
    """Counts the line breaks in a formatted value; inline tables have none."""
    return written(value).count("\n")


VALUES = st.recursive(
    st.integers() | st.floats(allow_nan=False) | st.booleans() | TEXTS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=6,
)


@given(st.lists(st.tuples(st.booleans(), st.dictionaries(KEYS, VALUES, max_size=4)), max_size=5))
def test_toml_line_numbers_are_right_in_random_documents(tables: list[tuple[bool, dict]]) -> None:
    """Keys of random tables and arrays of tables are found on the lines where they were written."""
    text, expected, count = "", {}, 0
    for index, (in_array, values) in enumerate(tables):
        where = ("many", count) if in_array else (f"t{index}",)
        count += in_array
        text += "[[many]]\n" if in_array else f"[t{index}]\n"
        for key, value in values.items():
            expected[(*where, key)] = text.count("\n") + 1
            text += f"{key} = {written(value)}  # {key}\n"
    tomllib.loads(text)
    found = line_numbers(text)
    assert {path: found.get(path) for path in expected} == expected
