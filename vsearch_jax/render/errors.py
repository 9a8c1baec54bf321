"""The error of the renderer."""

from __future__ import annotations


class RenderError(ValueError):
    """The renderer cannot draw a model or cannot use an argument. The message names the cause and the remedy."""
