"""Trials of the black-box searchers."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.env import ViewSearchEnv
from vsearch_jax.geometry import cosine_similarity
from vsearch_jax.planning import Motion
from vsearch_jax.search import Method, SearchArgs
from vsearch_jax.search.common import is_running, taken_images, to_result
from vsearch_jax.types import Camera, Observation, SearchResult, View
from vsearch_jax.xla.batching import map_in_batches


class _Trial(NamedTuple):
    """A trial under way.

    Attributes:
      states: of all searchers, of which only the one's that is running changes.
      camera: where the arm saw the best view.
      qpos: f32[nq] rad or m, where the arm stands.
      costs: f32[2], travel in rad and duration in s of the motions so far.
    """

    states: tuple[Any, ...]
    camera: Camera
    qpos: Array
    costs: Array


def search_trials(
    keys: Array, env: ViewSearchEnv, methods: tuple[Method, ...], starts: tuple[Observation, Array], target: Observation
) -> list[tuple[SearchResult, dict[str, Array], Camera]]:
    """Runs every searcher from each of `starts`, one searcher after the other.

    All take their images in one place: taking images is what is long to compile.

    Args:
      keys: PRNG key of each searcher.
      env: the task.
      methods: the searchers' parts.
      starts: Observation of f32[N, ...] of the initial views and their scores f32[N].
      target: Observation of the target.

    Returns:
      For each searcher its results, what its motions cost (`joint_travel` f32 rad, `motion_time` f32 s, `num_plans`
      i32) and the cameras at the views found, leading axis N.
    """
    # With paths the views of a generation are looked at one after the other.
    num_views = 1 if env.config.env.reachable == "path" else max(method.num_views for method in methods)
    batch_size = max(1, env.config.evaluation.batch_size // num_views)

    def searcher(xs: tuple[Array, Array]) -> _Trial:
        number, key = xs
        trial = functools.partial(_trial, env, methods, number, target)
        return map_in_batches(trial, (jax.random.split(key, starts[1].shape[0]), starts), batch_size)

    trials = jax.lax.map(searcher, (jnp.arange(len(methods)), keys))
    results = []
    for number, method in enumerate(methods):
        own = (trials.states[number], trials.camera, trials.costs)
        states, camera, costs = jax.tree.map(lambda x, n=number: x[n], own)
        result = jax.vmap(to_result)(method.record(states))
        # The image of the initial view needs no motion.
        motions = {"joint_travel": costs[:, 0], "motion_time": costs[:, 1], "num_plans": result.evaluations - 1}
        results.append((result, motions, camera))
    return results


def _trial(
    env: ViewSearchEnv,
    methods: tuple[Method, ...],
    number: Array,
    target: Observation,
    item: tuple[Array, tuple[Observation, Array]],
) -> _Trial:
    key, (start, score) = item
    args = SearchArgs(
        initial=start.view, band=env.reach.band, threshold=jnp.asarray(env.config.env.threshold), task=None
    )
    states = tuple(method.start(args, score) for method in methods)
    body = functools.partial(_generation, env, methods, (number, key), target, args)

    goes_on = functools.partial(_is_trial_running, methods, number, args)
    return jax.lax.while_loop(goes_on, body, _Trial(states, start.camera, start.qpos, jnp.zeros(2)))


def _generation(
    env: ViewSearchEnv,
    methods: tuple[Method, ...],
    searcher: tuple[Array, Array],
    target: Observation,
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
    # Those that only fill up the generation are not.
    is_asked = jnp.arange(num_views) < jnp.asarray([method.num_views for method in methods])[number]
    is_over = ~_is_trial_running(methods, number, args, trial)
    observations, motions, scores = _observe_generation(
        env, (trial.qpos, is_over), (views, is_asked), target, args.threshold
    )
    # Nor is anything after the view that ends the search.
    is_moved = motions.is_found & taken_images(scores, args.threshold) & is_asked
    qpos, costs = _add_motion_costs(env, trial, observations.qpos, motions._replace(is_found=is_moved))
    states, best = jax.lax.switch(number, [functools.partial(tell, i) for i in numbers], states, views, scores)
    camera = jax.tree.map(lambda new, old: jnp.where(best >= 0, new[best], old), observations.camera, trial.camera)
    return _Trial(states, camera, qpos, costs)


def _is_trial_running(methods: tuple[Method, ...], number: Array, args: SearchArgs, trial: _Trial) -> Array:
    """Returns bool[]: searcher `number` is not done with the trial."""
    records = [method.record(state) for method, state in zip(methods, trial.states, strict=True)]
    return jnp.stack([is_running(record, args.threshold) for record in records])[number]


def _observe_generation(
    env: ViewSearchEnv, now: tuple[Array, Array], asked: tuple[View, Array], target: Observation, threshold: Array
) -> tuple[Observation, Motion, Array]:
    """Looks at a generation of views, one after the other where paths are asked for.

    Args:
      env: the task.
      now: joints f32[nq] where the arm stands, and bool[], whether the search is over.
      asked: View of f32[N] rad, and bool[N], whether it is to be looked at: if not, the arm need not move.
      target: Observation of the target.
      threshold: f32[], the score at which the search ends, and with it the motions.

    Returns:
      What is seen, the motions, and the scores f32[N].
    """

    def look(here: Array, is_over: Array, asked: tuple[View, Array]) -> tuple[Observation, Motion, Array]:
        view, is_asked = asked
        observation, motion = env.move_to_view(view, here, is_over | ~is_asked)
        return (
            observation,
            motion,
            jnp.where(motion.is_found, cosine_similarity(observation.code, target.code), -jnp.inf),
        )

    if env.config.env.reachable == "ik":
        return jax.vmap(look, in_axes=(None, None, 0))(*now, asked)

    def go_on(
        now: tuple[Array, Array], asked: tuple[View, Array]
    ) -> tuple[tuple[Array, Array], tuple[Observation, Motion, Array]]:
        here, is_over = now
        observation, motion, score = look(here, is_over, asked)
        return (jnp.where(motion.is_found, observation.qpos, here), is_over | (score >= threshold)), (
            observation,
            motion,
            score,
        )

    return jax.lax.scan(go_on, now, asked)[1]


def _add_motion_costs(env: ViewSearchEnv, trial: _Trial, joints: Array, motions: Motion) -> tuple[Array, Array]:
    """Returns where the arm stands after the motions to `joints` (f32[N, nq]) that are found, and all costs so far.

    Without paths the views of a generation are looked at from one place, all at once, so here each way is measured
    anew from the view before.
    """

    def add(done: tuple[Array, Array], step: tuple[Array, Motion]) -> tuple[tuple[Array, Array], None]:
        (here, costs), (there, motion) = done, step
        if env.config.env.reachable == "ik":
            motion = env.straight_motion(here, there)._replace(is_found=motion.is_found)
        cost = jnp.stack([motion.travel, motion.duration])
        return (jnp.where(motion.is_found, there, here), costs + jnp.where(motion.is_found, cost, 0.0)), None

    return jax.lax.scan(add, (trial.qpos, trial.costs), (joints, motions))[0]
