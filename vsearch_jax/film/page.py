"""Layout of a film's frames."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from vsearch_jax.report.style import COLORS, INK, styled

_INCHES = (12.8, 7.2)
# Left and lower edge, width and height, as shares of the frame.
_OVERVIEW = (0.0, 0.0, 0.5, 1.0)
_WRIST, _TARGET = (0.53, 0.52, 0.2115, 0.376), (0.77, 0.52, 0.2115, 0.376)
_CURVE = (0.575, 0.085, 0.4065, 0.31)


class Moment(NamedTuple):
    """Content of one frame.

    Attributes:
      overview: u8[H, W, 3], H the height of the film and W half its width.
      wrist: u8[h, h, 3], image of the wrist camera.
      time: s since the start of the search, without holds.
      similarity: cosine of wrist image and target image.
      view_deg: azimuth and elevation in degrees of the wrist camera.
      caption: what the arm does.
      is_taken: whether the policy uses this wrist image.
    """

    overview: np.ndarray
    wrist: np.ndarray
    time: float
    similarity: float
    view_deg: tuple[float, float]
    caption: str
    is_taken: bool


class FilmPage:
    """Draws the frames of a film, one moment after another.

    Parts that do not change are drawn once. The curve holds all moments drawn so far.
    """

    @styled
    def __init__(self, target: np.ndarray, axes_limits: tuple[float, float], threshold: float, height: int) -> None:
        """Makes the layout and draws the parts that do not change.

        Args:
          target: u8[h, h, 3], the target image.
          axes_limits: time in s of the last moment, and lowest cosine on the curve's axis.
          threshold: cosine at which a view is found.
          height: height of the film in pixels; its width is 16/9 of that.
        """
        figure = Figure(figsize=_INCHES, dpi=height / _INCHES[1])
        figure.set_layout_engine("none")
        self._canvas = FigureCanvasAgg(figure)
        self._overview = _show_image(figure.add_axes(_OVERVIEW), np.zeros((1, 1, 3), np.uint8), is_static=False)
        self._wrist = _show_image(figure.add_axes(_WRIST), np.zeros_like(target), is_static=False)
        _show_image(figure.add_axes(_TARGET), target, is_static=True)
        for (x, y, _, image_height), name in ((_WRIST, "wrist camera"), (_TARGET, "target")):
            figure.text(x, y + image_height + 0.012, name, size=11)
        edge = {"transform": figure.transFigure, "fill": False, "linewidth": 5, "edgecolor": COLORS["cma_es"]}
        self._edge = figure.add_artist(Rectangle(_WRIST[:2], *_WRIST[2:], animated=True, **edge))
        positions = ((0.947, 17), (0.475, 13), (0.443, 11))
        self._texts = [figure.text(_WRIST[0], y, "", size=size, animated=True) for y, size in positions]
        self._lines = _make_curve(figure.add_axes(_CURVE), axes_limits, threshold)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(figure.bbox)
        self._moments: list[tuple[float, float]] = []
        self._taken: list[tuple[float, float]] = []

    @styled
    def draw(self, moment: Moment) -> np.ndarray:
        """Draws the next moment of the film, and returns the finished frame u8[height, width, 3]."""
        now = (moment.time, moment.similarity)
        self._moments.append(now)
        self._taken += [now] * moment.is_taken
        for line, points in zip(self._lines, (self._moments, self._taken, [now]), strict=True):
            line.set_data(*np.reshape(points, (-1, 2)).T)
        self._overview.set_data(moment.overview)
        self._wrist.set_data(moment.wrist)
        self._edge.set_visible(moment.is_taken)
        azimuth, elevation = moment.view_deg
        view = f"azimuth {azimuth:.0f}°, elevation {elevation:.0f}°"
        for text, content in zip(self._texts, (moment.caption, f"cosine {moment.similarity:.3f}", view), strict=True):
            text.set_text(content)
        self._canvas.restore_region(self._background)
        for artist in (self._overview, self._wrist, self._edge, *self._lines, *self._texts):
            self._canvas.figure.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


def _show_image(axes: Axes, image: np.ndarray, *, is_static: bool) -> AxesImage:
    axes.set_axis_off()
    return axes.imshow(image, aspect="auto", interpolation="nearest", animated=not is_static)


def _make_curve(axes: Axes, limits: tuple[float, float], threshold: float) -> tuple[Line2D, Line2D, Line2D]:
    """Returns empty lines for all moments, for the moments whose image the policy uses, and for the present moment."""
    seconds, lowest = limits
    axes.axhline(threshold, color=INK, linestyle="--", linewidth=1.2, label=f"threshold {threshold:g}")
    (line,) = axes.plot([], [], color=COLORS["sac"], linewidth=2.2, animated=True, label="in motion")
    (taken,) = axes.plot([], [], "o", color=COLORS["cma_es"], markersize=8, animated=True, label="image taken")
    (now,) = axes.plot([], [], "o", color=COLORS["sac"], markersize=5, animated=True)
    axes.set(xlabel="motion time (s)", ylabel="cosine with the target")
    axes.set(xlim=(-0.02 * seconds, 1.02 * seconds), ylim=(lowest, 1.05))
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.2)
    return line, taken, now
