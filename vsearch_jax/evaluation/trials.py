"""Trials of the black-box searchers."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.env import ViewSearchEnv
from vsearch_jax.evaluation.views import map_batched
from vsearch_jax.geometry import cosine_similarity
from vsearch_jax.search import Method, SearchArgs
from vsearch_jax.search.common import is_running, to_result
from vsearch_jax.types import Camera, SearchResult, Sight, View


class _Trial(NamedTuple):
    """A trial under way.

    Attributes:
      states: of all searchers, of which only the one's that is running changes.
      camera: where the arm saw the best view.
    """

    states: tuple[Any, ...]
    camera: Camera


def search_trials(
    keys: Array, env: ViewSearchEnv, methods: tuple[Method, ...], starts: tuple[Sight, Array], target: Sight
) -> list[tuple[SearchResult, Camera]]:
    """Runs every searcher from each of `starts`, one searcher after the other.

    All take their images in one place: taking images is what is long to compile.

    Args:
      keys: PRNG key of each searcher.
      env: the task.
      methods: the searchers' parts.
      starts: Sight of f32[N, ...] of the initial views and their scores f32[N].
      target: Sight of the target.

    Returns:
      For each searcher its results and the cameras at their views, leading axis N.
    """
    num_views = max(method.num_views for method in methods)
    batch_size = max(1, env.config.evaluation.batch_size // num_views)

    def searcher(xs: tuple[Array, Array]) -> _Trial:
        number, key = xs
        trial = functools.partial(_trial, env, methods, number, target)
        return map_batched(trial, (jax.random.split(key, starts[1].shape[0]), starts), batch_size)

    trials = jax.lax.map(searcher, (jnp.arange(len(methods)), keys))
    results = []
    for number, method in enumerate(methods):
        states, camera = jax.tree.map(lambda x, n=number: x[n], (trials.states[number], trials.camera))
        results.append((jax.vmap(to_result)(method.record(states)), camera))
    return results


def _trial(
    env: ViewSearchEnv,
    methods: tuple[Method, ...],
    number: Array,
    target: Sight,
    item: tuple[Array, tuple[Sight, Array]],
) -> _Trial:
    key, (start, score) = item
    args = SearchArgs(
        initial=start.view, band=env.reach.band, threshold=jnp.asarray(env.config.env.threshold), task=start.qpos
    )
    states = tuple(method.start(args, score) for method in methods)
    body = functools.partial(_generation, env, methods, (number, key), target, args)

    def goes_on(trial: _Trial) -> Array:
        records = [method.record(state) for method, state in zip(methods, trial.states, strict=True)]
        return jnp.stack([is_running(record, args.threshold) for record in records])[number]

    return jax.lax.while_loop(goes_on, body, _Trial(states, start.camera))


def _generation(
    env: ViewSearchEnv,
    methods: tuple[Method, ...],
    searcher: tuple[Array, Array],
    target: Sight,
    args: SearchArgs,
    trial: _Trial,
) -> _Trial:
    number, key = searcher
    num_views = max(method.num_views for method in methods)

    def ask(i: int, states: tuple[Any, ...]) -> tuple[View, tuple[Any, ...]]:
        views, state = methods[i].ask(key, args, states[i])
        missing = num_views - methods[i].num_views
        views = jax.tree.map(lambda x: jnp.pad(x, (0, missing), mode="edge"), views)
        return views, (*states[:i], state, *states[i + 1 :])

    def tell(i: int, states: tuple[Any, ...], views: View, scores: Array) -> tuple[tuple[Any, ...], Array]:
        own, scores = jax.tree.map(lambda x: x[: methods[i].num_views], (views, scores))
        state = methods[i].tell(key, args, states[i], own, scores)
        return (*states[:i], state, *states[i + 1 :]), methods[i].record(state).best

    numbers = range(len(methods))
    views, states = jax.lax.switch(number, [functools.partial(ask, i) for i in numbers], trial.states)
    sights, is_reachable = jax.vmap(env.look, in_axes=(0, None))(views, args.task)
    similarity = jax.vmap(cosine_similarity, in_axes=(0, None))(sights.code, target.code)
    scores = jnp.where(is_reachable, similarity, -jnp.inf)
    states, best = jax.lax.switch(number, [functools.partial(tell, i) for i in numbers], states, views, scores)
    camera = jax.tree.map(lambda new, old: jnp.where(best >= 0, new[best], old), sights.camera, trial.camera)
    return _Trial(states, camera)
