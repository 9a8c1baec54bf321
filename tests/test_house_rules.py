"""Rules of the house that a tool can count: sizes, types, suppressions, docstrings. CONTRIBUTING.md states them."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from docstrings import Function, public_functions

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = sorted((ROOT / "vsearch_jax").rglob("*.py"))
SOURCES = [*PACKAGE, *(path for folder in ("train", "eval", "tests") for path in sorted((ROOT / folder).rglob("*.py")))]
SUPPRESSION = re.compile(r"(pyright: ignore|type: ignore|noqa)")
MAX_LINES, MAX_FUNCTION_LINES, MAX_ARGUMENTS = 300, 60, 6
MAX_TOP_LEVEL_MODULES, MAX_ANY, MAX_SUPPRESSIONS = 7, 59, 4


def _comments(path: Path) -> Iterator[str]:
    for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
        if token.type == tokenize.COMMENT:
            yield token.string


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_and_functions_stay_small(path: Path) -> None:
    text = path.read_text()
    assert text.count("\n") <= MAX_LINES
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            assert node.end_lineno - node.lineno < MAX_FUNCTION_LINES, f"split {node.name}"
            if ROOT / "tests" not in path.parents:
                assert len(node.args.args) + len(node.args.kwonlyargs) <= MAX_ARGUMENTS + 1, node.name  # self


def test_the_top_level_holds_rooms_and_few_modules() -> None:
    assert len(list((ROOT / "vsearch_jax").glob("*.py"))) <= MAX_TOP_LEVEL_MODULES


def test_the_word_any_is_rare() -> None:
    names = [
        token.string
        for path in PACKAGE
        for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline)
        if token.type == tokenize.NAME
    ]
    assert names.count("Any") <= MAX_ANY


def test_suppressions_are_few_and_each_has_its_reason() -> None:
    found = [comment for path in SOURCES for comment in _comments(path) if SUPPRESSION.search(comment)]
    assert len(found) <= MAX_SUPPRESSIONS, found
    for comment in found:
        assert re.search(r"(?:ignore\[\w+\]|noqa: \w+) # \w+", comment), f"say why: {comment}"


@pytest.mark.parametrize("function", list(public_functions()), ids=lambda function: function.name)
def test_public_functions_describe_their_arguments(function: Function) -> None:
    assert function.docstring, "write a docstring"
    if len(function.parameters) >= 2:
        section = re.search(r"^Args:\n((?:  .*\n?|\n)+)", function.docstring, re.MULTILINE)
        assert section, "write an Args section"
        for name in function.parameters:
            assert re.search(rf"^  \*?{name}\b[^:]*:", section.group(1), re.MULTILINE), f"describe {name}"
