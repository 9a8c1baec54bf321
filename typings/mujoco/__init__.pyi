# MuJoCo's compiled modules come without types; this lets any name through.
from typing import Any

def __getattr__(name: str) -> Any: ...
