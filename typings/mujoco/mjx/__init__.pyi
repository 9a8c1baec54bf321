# A stub of a package hides the whole of it, so its subpackages need one too; see ../__init__.pyi.
from typing import Any

def __getattr__(name: str) -> Any: ...
