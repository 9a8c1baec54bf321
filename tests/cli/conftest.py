"""Fixtures of the command-line tests."""

import pytest

from samples import fast_run
from vsearch_jax.runs import loop


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces init, train, evaluate and record_search by those of the fast run, without its pauses."""
    for name in ("init", "train", "evaluate", "record_search"):
        monkeypatch.setattr(loop, name, getattr(fast_run, name))
    monkeypatch.setattr(fast_run, "CHUNK_SECONDS", 0.0)
