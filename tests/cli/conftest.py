"""Fixtures of the command-line tests."""

import pytest

from samples import fast_run
from vsearch_jax.report import page
from vsearch_jax.runs import loop


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces init, train, evaluate, record_search and the figures by those of the fast run, without its pauses."""
    for name in ("init", "train", "evaluate", "record_search"):
        monkeypatch.setattr(loop, name, getattr(fast_run, name))
    monkeypatch.setattr(page, "draw_figures", fast_run.draw_figures)
    monkeypatch.setattr(fast_run, "CHUNK_SECONDS", 0.0)
