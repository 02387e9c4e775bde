"""YAML 1.2's plain values against the specification's own table, and OpenCV's headers and tags."""

import math

import pytest

from armsight.errors import InputError
from armsight.tables.document import dump_yaml, parse_yaml, read_yaml


def value(text):
    (document,) = parse_yaml(f"a: {text}\n", "f.yaml")
    return document["a"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1e-05", 1e-5),
        ("-1E5", -1e5),
        ("+1.5e+3", 1500.0),
        (".5", 0.5),
        ("500.", 500.0),
        ("-3.5000000000000003e-02", -0.035),
        ("-.Inf", -math.inf),
        (".inf", math.inf),
        ("010", 10),
        ("0o14", 12),
        ("0xC", 12),
        ("-12", -12),
        ("~", None),
        ("", None),
        ("True", True),
        ("false", False),
        ("on", "on"),
        ("yes", "yes"),
        ("1:30", "1:30"),
        ("1_000", "1_000"),
        ("2026-11-27", "2026-11-27"),
        ("'1e-05'", "1e-05"),
        ("1e", "1e"),
        ("0.1.2", "0.1.2"),
        ("!!python/tuple [1, 2e3]", [1, 2000.0]),
        (
            "!!opencv-matrix {rows: 1, cols: 2, dt: d, data: [1., 2.]}",
            {"rows": 1, "cols": 2, "dt": "d", "data": [1, 2]},
        ),
    ],
)
def test_plain_values_are_those_of_yaml_1_2(text, expected):
    found = value(text)
    assert found == expected
    assert type(found) is type(expected) or isinstance(expected, dict | list)


def test_opencv_spells_nan_its_own_way():
    assert all(math.isnan(value(text)) for text in (".Nan", ".nan", ".NaN"))


HEADERS = ["", "%YAML:1.0\n", "%YAML:1.0\n---\n", "%YAML 1.2\n---\n", "\ufeff%YAML:1.0\n\n", "---\n"]


@pytest.mark.parametrize("end", ["", "---\n", "...\n", "---\n---\n"])
def test_headers_and_ends_of_one_document(tmp_path, end):
    path = tmp_path / "a.yaml"
    for header in HEADERS:
        path.write_text(f"{header}a: 1e-3\n{end}")
        assert read_yaml(path) == {"a": 1e-3}, header


def test_several_documents_are_kept_apart(tmp_path):
    assert parse_yaml("a: 1\n---\na: 2\n---\n", "f") == [{"a": 1}, {"a": 2}]
    (tmp_path / "two.yaml").write_text("a: 1\n---\na: 2\n")
    with pytest.raises(InputError, match="holds 2 YAML documents"):
        read_yaml(tmp_path / "two.yaml")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\nb: 2\na: 3\n", "f.yaml: line 3: not YAML .'a' stands twice"),
        ("a: [1,\n", "f.yaml: line 2: not YAML"),
        ("a: !degrees 90\n", "line 1: .*the tag !degrees is not known"),
        ("a: !!python/object/apply:numpy.core.multiarray._reconstruct []\n", r"line 1: .*Python object.*tolist"),
        ("%YAML:1.0\n---\na: b: c\n", "line 3: not YAML"),
        ("a: \x00", "f.yaml: not YAML"),
        ("[" * 5000, "f.yaml: .*not YAML .*nesting"),
        ("- " * 5000, "f.yaml: line 1: not YAML .*nested over 100 deep"),
        ("a: &a [0]\nb: [" + "*a, " * 500_001 + "]", "f.yaml: line 2: not YAML .*over 1000000 values"),
        ("a: " + "1" * 5000, "f.yaml: not YAML"),
    ],
)
def test_what_is_no_yaml_names_its_line(text, said):
    with pytest.raises(InputError, match=said) as caught:
        parse_yaml(text, "f.yaml")
    assert "\n" not in str(caught.value)


def test_what_is_written_reads_back_exactly():
    document = {"a": [1e-5, 0.1, -3.0, 1e22], "b": {"c": "b", "d": "on"}}
    assert parse_yaml(dump_yaml(document), "f") == [document]
