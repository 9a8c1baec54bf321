"""Public functions of the package and their docstrings. As a program it prints some at random, for a reader.

python tests/docstrings.py --count 10 --seed 1
"""

from __future__ import annotations

import argparse
import ast
import random
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PACKAGE = Path(__file__).resolve().parent.parent / "vsearch_jax"


class Function(NamedTuple):
    """A public function or method.

    Attributes:
      name: module, class and function, with dots.
      signature: as in the source.
      parameters: names, without self and cls.
      docstring: without indentation; empty where there is none.
    """

    name: str
    signature: str
    parameters: list[str]
    docstring: str


def public_functions() -> Iterator[Function]:
    """Yields every function and method whose name, class and module are public."""
    for path in sorted(PACKAGE.rglob("*.py")):
        module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef):
                yield from _describe(module, node)
            elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                for member in node.body:
                    if isinstance(member, ast.FunctionDef):
                        yield from _describe(f"{module}.{node.name}", member)


def _describe(owner: str, node: ast.FunctionDef) -> Iterator[Function]:
    if node.name.startswith("_"):
        return
    arguments = node.args
    names = [a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    signature = f"{node.name}({ast.unparse(arguments)}){returns}"
    parameters = [name for name in names if name not in ("self", "cls")]
    yield Function(f"{owner}.{node.name}", signature, parameters, ast.get_docstring(node) or "")


def main() -> None:
    """Prints functions drawn at random."""
    parser = argparse.ArgumentParser(description="prints docstrings drawn at random")
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    functions = [function for function in public_functions() if function.docstring]
    for function in random.Random(options.seed).sample(functions, options.count):
        print(f"{function.name}\n  {function.signature}\n")
        print("\n".join(f"  {line}" for line in function.docstring.splitlines()), end="\n\n\n")


if __name__ == "__main__":
    main()
