"""YAML as the programs of the field write it: PyYAML's parser with the plain values of YAML 1.2.

In: a file or a text. Out: its documents as mappings, lists, texts, numbers and, where it is tagged ``!!opencv-matrix``, the
mapping of a matrix. What differs from PyYAML: 1e-05 is a number, 010 is ten, ``on`` and ``2026-01-01`` are texts
(YAML 1.2, core schema, as yaml-cpp and ROS read them); the first line may be OpenCV's ``%YAML:1.0``; a name that stands
twice in one mapping is an error, as the first value would be lost.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import yaml

from armsight.errors import InputError
from armsight.files import YAML_MB, read_text

#: A value of a file of another program: a number, a text, a list or a mapping, unknown until checked.
Foreign: TypeAlias = Any

#: Plain values of YAML 1.2's core schema, in the order in which they are tried, and the characters they may begin with;
#: OpenCV writes .Nan and .Inf.
_PLAIN = (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN|Nan)",
        list("-+.0123456789"),
    ),
    ("merge", r"<<", ["<"]),
)
#: Tags that change nothing of what is plain to see.
_HARMLESS = ("tag:yaml.org,2002:opencv-matrix", "tag:yaml.org,2002:opencv-nd-matrix", "tag:yaml.org,2002:python/tuple")


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with the plain values of YAML 1.2."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 - PyYAML's own form

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Return a mapping; a name that stands in it twice is an error."""
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"{key.value!r} stands twice in one mapping", key.start_mark
                    )
                seen.add(key.value)
        return super().construct_mapping(node, deep)

    def whole_number(self, node: yaml.ScalarNode) -> int:
        """Return a whole number; a leading zero does not make it octal."""
        text = str(self.construct_scalar(node))
        return int(text, 0 if text[:2] in ("0o", "0x") else 10)

    def untagged(self, node: yaml.Node) -> Any:  # noqa: ANN401 - whatever YAML holds
        """Return what stands behind a tag."""
        if isinstance(node, yaml.MappingNode):
            return self.construct_mapping(node, deep=True)
        if isinstance(node, yaml.SequenceNode):
            return self.construct_sequence(node, deep=True)
        return self.construct_scalar(node)  # type: ignore[arg-type]

    def unknown(self, node: yaml.Node) -> Any:  # noqa: ANN401 - never returns
        """Reject a value of a kind that is not known: what it means would be a guess."""
        tag = str(node.tag).replace("tag:yaml.org,2002:", "!!")
        python = "; that is a Python object, not plain numbers: write arrays with .tolist()" if "python/" in tag else ""
        raise yaml.constructor.ConstructorError(None, None, f"the tag {tag} is not known{python}", node.start_mark)


for _name, _pattern, _first in _PLAIN:
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_name}", re.compile(rf"^(?:{_pattern})$"), _first)
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.whole_number)
_Loader.add_constructor(None, _Loader.unknown)
for _name in _HARMLESS:
    _Loader.add_constructor(_name, _Loader.untagged)


def read_yaml(path: str | Path) -> Mapping[str, Foreign]:
    """Read a YAML file of one document that is a mapping.

    Raises:
        InputError: missing, not YAML, another number of documents, or no mapping; the message names file and line.
    """
    documents = parse_yaml(read_text(path, YAML_MB), path)
    if len(documents) != 1:
        raise InputError(
            f"{path}: holds {len(documents)} YAML documents, separated by ---; expected one: keep one of them"
        )
    if not isinstance(documents[0], dict):
        raise InputError(f"{path}: expected a YAML mapping of names to values, such as width: 640")
    return documents[0]


def parse_yaml(text: str, path: str | Path) -> list[Foreign]:
    """Return the documents of a YAML text, one at least; an empty one at its end (a trailing ---) is left out.

    Args:
        text: the text.
        path: where it comes from, for messages.

    Raises:
        InputError: not YAML; the message names the line.
    """
    text = text.removeprefix("\ufeff")
    if text.startswith("%YAML"):  # OpenCV's header is no directive of YAML; the line stays, for messages
        text = text[text.index("\n") :] if "\n" in text else ""
    try:
        documents = list(yaml.load_all(text, _Loader))
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise InputError(f"{path}: {line}not YAML ({error.problem})") from None
    except (yaml.YAMLError, ValueError, RecursionError):  # control characters, thousands of digits or brackets
        raise InputError(f"{path}: not YAML") from None
    while len(documents) > 1 and documents[-1] is None:
        documents.pop()
    return documents or [None]


def dump_yaml(document: Mapping[str, Foreign]) -> str:
    """Return YAML text whose numbers read back exactly."""
    return str(yaml.safe_dump(dict(document), sort_keys=False, default_flow_style=None, width=120))
