"""Trials of the black-box searchers."""

from __future__ import annotations

import functools
from typing import NamedTuple

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
from vsearch_jax.xla.tree import tree_where


class TrialResults(NamedTuple):
    """Results of one searcher. A trial is one search; each array has a leading axis of N trials.

    Attributes:
      result: best view, score and number of images of each trial.
      motions: cost of each trial's motions: `joint_travel` f32[N] rad, `motion_time` f32[N] s, `num_plans` i32[N].
      counts: the searcher's own counts by name, i32[N] each; see `Method.counts`.
      camera: camera in world at the best view of each trial.
    """

    result: SearchResult
    motions: dict[str, Array]
    counts: dict[str, Array]
    camera: Camera


class _Bench(NamedTuple):
    """What all trials of one searcher share. It holds functions too, so it is no pytree.

    Attributes:
      env: the task.
      methods: all searchers, each in parts.
      number: i32[], index into `methods` of the searcher that runs.
      target: Observation of the target.
    """

    env: ViewSearchEnv
    methods: tuple[Method, ...]
    number: Array
    target: Observation

    @property
    def num_views(self) -> int:
        """Views of a generation, padded to the largest of all searchers."""
        return max(method.num_views for method in self.methods)


class _Trial(NamedTuple):
    """Loop state of one trial.

    Attributes:
      states: one state for each searcher; only the state of the running searcher changes.
      camera: Camera at the best view.
      qpos: f32[nq] rad or m, present joints of the arm.
      costs: f32[2], travel in rad and duration in s, summed over the motions so far.
    """

    states: tuple[object, ...]
    camera: Camera
    qpos: Array
    costs: Array


def search_trials(
    keys: Array, env: ViewSearchEnv, methods: tuple[Method, ...], starts: tuple[Observation, Array], target: Observation
) -> list[TrialResults]:
    """Runs all trials of the black-box searchers: one search by every searcher from each of N initial views.

    The searchers run one after another, and the trials of one searcher in batches. All searchers share one call of the
    renderer, since each call is compiled anew.

    Args:
      keys: PRNG keys [len(methods)], one for each searcher.
      env: the task.
      methods: the searchers, each in parts (start, ask, tell, record).
      starts: what the camera sees from the N initial views (Observation of f32[N, ...]), and the views' scores f32[N].
      target: what the camera sees from the target view.

    Returns:
      Results of the N trials, for each searcher in the order of `methods`.
    """
    # With "path" the views of a generation are observed one after another, so they need no room in the batch.
    num_views = 1 if env.config.env.reachable == "path" else max(method.num_views for method in methods)
    batch_size = max(1, env.config.evaluation.batch_size // num_views)

    def run_trials_of_searcher(searcher: tuple[Array, Array]) -> _Trial:
        number, key = searcher
        run_trial = functools.partial(_run_trial, _Bench(env, methods, number, target))
        return map_in_batches(run_trial, (jax.random.split(key, starts[1].shape[0]), starts), batch_size)

    trials = jax.lax.map(run_trials_of_searcher, (jnp.arange(len(methods)), keys))
    results = []
    for number, method in enumerate(methods):
        own = (trials.states[number], trials.camera, trials.costs)
        states, camera, costs = jax.tree.map(lambda x, n=number: x[n], own)
        result = jax.vmap(to_result)(method.record(states))
        # The image of the initial view needs no motion.
        motions = {"joint_travel": costs[:, 0], "motion_time": costs[:, 1], "num_plans": result.evaluations - 1}
        results.append(TrialResults(result, motions, jax.vmap(method.counts)(states), camera))
    return results


def _run_trial(bench: _Bench, item: tuple[Array, tuple[Observation, Array]]) -> _Trial:
    """Runs one trial to its end; `item` is its key, initial observation and initial score."""
    key, (start, score) = item
    env = bench.env
    args = SearchArgs(
        initial=start.view, band=env.reach.band, threshold=jnp.asarray(env.config.env.threshold), task=None
    )
    states = tuple(method.start(args, score) for method in bench.methods)
    body = functools.partial(_run_generation, bench, key, args)
    condition = functools.partial(_is_trial_running, bench, args)
    return jax.lax.while_loop(condition, body, _Trial(states, start.camera, start.qpos, jnp.zeros(2)))


def _is_trial_running(bench: _Bench, args: SearchArgs, trial: _Trial) -> Array:
    """Returns bool[]: the running searcher has not finished the trial."""
    records = [method.record(state) for method, state in zip(bench.methods, trial.states, strict=True)]
    return jnp.stack([is_running(record, args.threshold) for record in records])[bench.number]


def _run_generation(bench: _Bench, key: Array, args: SearchArgs, trial: _Trial) -> _Trial:
    """Asks the running searcher for views, observes them and tells it the scores."""
    methods, numbers = bench.methods, range(len(bench.methods))

    def ask(i: int, states: tuple[object, ...]) -> tuple[View, tuple[object, ...]]:
        """Returns the views of searcher `i`, padded to `bench.num_views`, and the new states."""
        views, state = methods[i].ask(key, args, states[i])
        missing = bench.num_views - methods[i].num_views
        views = jax.tree.map(lambda x: jnp.pad(x, (0, missing), mode="edge"), views)
        return views, (*states[:i], state, *states[i + 1 :])

    def tell(i: int, states: tuple[object, ...], views: View, scores: Array) -> tuple[tuple[object, ...], Array]:
        """Returns the new states, and the index of the best view or -1; see `Record.best`."""
        own, scores = jax.tree.map(lambda x: x[: methods[i].num_views], (views, scores))
        state = methods[i].tell(key, args, states[i], own, scores)
        return (*states[:i], state, *states[i + 1 :]), methods[i].record(state).best

    views, states = jax.lax.switch(bench.number, [functools.partial(ask, i) for i in numbers], trial.states)
    # Padding is not observed.
    is_requested = jnp.arange(bench.num_views) < jnp.asarray([method.num_views for method in methods])[bench.number]
    is_over = ~_is_trial_running(bench, args, trial)
    observations, motions, scores = _observe_generation(
        bench, (trial.qpos, is_over), (views, is_requested), args.threshold
    )
    # The arm does not move to padding, nor to views after the one that ends the search.
    is_moved = motions.is_found & taken_images(scores, args.threshold) & is_requested
    qpos, costs = _add_motion_costs(bench.env, trial, observations.qpos, motions._replace(is_found=is_moved))
    states, best = jax.lax.switch(bench.number, [functools.partial(tell, i) for i in numbers], states, views, scores)
    best_camera = jax.tree.map(lambda x: x[best], observations.camera)
    camera = tree_where(best >= 0, best_camera, trial.camera)
    return _Trial(states, camera, qpos, costs)


def _observe_generation(
    bench: _Bench, now: tuple[Array, Array], requests: tuple[View, Array], threshold: Array
) -> tuple[Observation, Motion, Array]:
    """Observes the views of a generation.

    With `env.reachable` "ik" all views are observed at once, each from the present joints. With "path" they are
    observed one after another, each from the joints at the view before.

    Args:
      bench: what the trials share.
      now: present joints f32[nq] rad or m, and bool[], whether the search is over.
      requests: View of f32[N] rad, and bool[N], whether to observe it. The arm does not move to the other views.
      threshold: f32[], score at which the search ends.

    Returns:
      Observation of f32[N, ...], Motion of f32[N], and scores f32[N], -inf where the arm cannot reach the view.
    """

    def observe(qpos: Array, is_over: Array, request: tuple[View, Array]) -> tuple[Observation, Motion, Array]:
        view, is_requested = request
        observation, motion = bench.env.move_to_view(view, qpos, is_over | ~is_requested)
        similarity = cosine_similarity(observation.code, bench.target.code)
        return observation, motion, jnp.where(motion.is_found, similarity, -jnp.inf)

    if bench.env.config.env.reachable == "ik":
        return jax.vmap(observe, in_axes=(None, None, 0))(*now, requests)

    def observe_next(
        now: tuple[Array, Array], request: tuple[View, Array]
    ) -> tuple[tuple[Array, Array], tuple[Observation, Motion, Array]]:
        qpos, is_over = now
        observation, motion, score = observe(qpos, is_over, request)
        qpos = jnp.where(motion.is_found, observation.qpos, qpos)
        return (qpos, is_over | (score >= threshold)), (observation, motion, score)

    return jax.lax.scan(observe_next, now, requests)[1]


def _add_motion_costs(env: ViewSearchEnv, trial: _Trial, goals: Array, motions: Motion) -> tuple[Array, Array]:
    """Adds the costs of one generation's motions.

    With `env.reachable` "ik" all views are observed from the same joints. But the arm goes from view to view, so here
    each motion is measured anew from the view before.

    Args:
      env: the task.
      trial: gives the joints before the generation and the costs so far.
      goals: f32[N, nq] rad or m, joints at the views.
      motions: Motion of f32[N]; motions that are not found cost nothing, and the arm stays.

    Returns:
      Joints f32[nq] after the generation, and costs f32[2] so far.
    """

    def add_motion(before: tuple[Array, Array], step: tuple[Array, Motion]) -> tuple[tuple[Array, Array], None]:
        (qpos, costs), (goal, motion) = before, step
        if env.config.env.reachable == "ik":
            motion = env.straight_motion(qpos, goal)._replace(is_found=motion.is_found)
        cost = jnp.stack([motion.travel, motion.duration])
        after = (jnp.where(motion.is_found, goal, qpos), costs + jnp.where(motion.is_found, cost, 0.0))
        return after, None

    return jax.lax.scan(add_motion, (trial.qpos, trial.costs), (goals, motions))[0]
