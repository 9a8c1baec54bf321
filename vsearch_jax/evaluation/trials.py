"""Trials of the black-box searchers."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vsearch_jax.env import ViewSearchEnv
from vsearch_jax.evaluation.outcome import Outcome, measure_outcome
from vsearch_jax.evaluation.views import SeenView
from vsearch_jax.geometry import cosine_similarity
from vsearch_jax.planning import Motion
from vsearch_jax.search import Method, SearchArgs
from vsearch_jax.search.common import is_running, taken_images, to_result
from vsearch_jax.types import Observation, View
from vsearch_jax.xla import lane_pool
from vsearch_jax.xla.tree import tree_where, tree_zeros


class _Bench(NamedTuple):
    """What all trials share. It holds functions too, so it is no pytree.

    Attributes:
      env: the task.
      methods: all searchers, each in parts.
      target: Observation of the target.
    """

    env: ViewSearchEnv
    methods: tuple[Method, ...]
    target: Observation

    @property
    def num_views(self) -> int:
        """Views of a generation, padded to the largest of all searchers."""
        return max(method.num_views for method in self.methods)


class _Problem(NamedTuple):
    """A trial to run.

    Attributes:
      number: i32[], index into `_Bench.methods` of the searcher that runs.
      key: PRNG key of the search.
      start: Observation from the initial view.
      score: f32[], score of the initial view.
    """

    number: Array
    key: Array
    start: Observation
    score: Array


class _Trial(NamedTuple):
    """Loop state of one trial.

    Attributes:
      states: one state for each searcher; only the state of the running searcher changes.
      best: Observation from the best view.
      qpos: f32[nq] rad or m, present joints of the arm.
      costs: f32[2], travel in rad and duration in s, summed over the motions so far.
      is_over: bool[], the search has ended.
    """

    states: tuple[object, ...]
    best: Observation
    qpos: Array
    costs: Array
    is_over: Array


def search_trials(
    keys: Array, env: ViewSearchEnv, methods: tuple[Method, ...], initial: SeenView, target: Observation
) -> list[Outcome]:
    """Runs all trials of the black-box searchers, one search by every searcher from each of N initial views.

    The trials of all searchers are one queue, and run on a pool of lanes: a lane takes the next trial as soon as its
    own ends. All searchers share one call of the renderer, since each call is compiled anew.

    Args:
      keys: PRNG keys [len(methods)], one for each searcher.
      env: the task.
      methods: the searchers, each in parts (start, ask, tell, record).
      initial: what the camera sees from the N initial views: arrays [N, ...]. The score of a view that the arm does not
        reach is -inf.
      target: what the camera sees from the target view.

    Returns:
      Measures of the N trials, for each searcher in the order of `methods`; `evaluate` describes them.
    """
    bench, shape = _Bench(env, methods, target), (len(methods), initial.is_reached.shape[0])
    similarity = jax.vmap(cosine_similarity, in_axes=(0, None))(initial.observation.code, target.code)
    starts = (initial.observation, jnp.where(initial.is_reached, similarity, -jnp.inf))
    trial_keys = jax.vmap(functools.partial(jax.random.split, num=shape[1]))(keys)
    numbers = jnp.broadcast_to(jnp.arange(shape[0])[:, None], shape)
    all_starts = jax.tree.map(lambda x: jnp.broadcast_to(x, (shape[0], *x.shape)), starts)
    problems = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), _Problem(numbers, trial_keys, *all_starts))

    # With "path" the views of a generation are observed one after another, so they need no room in the batch.
    num_views = 1 if env.config.env.reachable == "path" else bench.num_views
    num_lanes = max(1, min(env.config.evaluation.batch_size // num_views, numbers.size))
    lanes = jax.vmap(functools.partial(_start_trial, bench))(jax.tree.map(lambda x: x[:num_lanes], problems))
    trials = tree_zeros(jax.tree.map(lambda x: x[0], lanes), (numbers.size,))
    job = lane_pool.Job(
        reset=lambda problem, trial, is_new: tree_where(is_new, _start_trial(bench, problem), trial),
        step=lambda problem, trial: tree_where(trial.is_over, trial, _run_generation(bench, problem, trial)),
        is_done=lambda trial: trial.is_over,
        result=lambda _, trial: trial,
        has_stragglers=False,  # to compile the renderer once more takes longer than the last generations on all lanes
    )
    trials = lane_pool.run(job, problems, lane_pool.queue_where(jnp.ones(numbers.size, bool)), lanes, trials)

    measure = jax.vmap(functools.partial(measure_outcome, env), in_axes=(0, 0, None))
    outcomes: list[Outcome] = []
    for number, method in enumerate(methods):
        own = (trials.states[number], trials.best, trials.costs)
        rows = slice(number * shape[1], (number + 1) * shape[1])
        states, best, costs = jax.tree.map(lambda x, rows=rows: x[rows], own)
        result = jax.vmap(to_result)(method.record(states))
        # The image of the initial view needs no motion.
        motions = {"joint_travel": costs[:, 0], "motion_time": costs[:, 1], "num_plans": result.evaluations - 1}
        views: Outcome = {"initial_view": initial.observation.view}
        outcomes.append(measure(result, best, target) | jax.vmap(method.counts)(states) | motions | views)
    return outcomes


def _search_args(bench: _Bench, problem: _Problem) -> SearchArgs[None]:
    """Returns the search problem of a trial."""
    threshold = jnp.asarray(bench.env.config.env.threshold)
    return SearchArgs(initial=problem.start.view, band=bench.env.reach.band, threshold=threshold, task=None)


def _start_trial(bench: _Bench, problem: _Problem) -> _Trial:
    args = _search_args(bench, problem)
    states = tuple(method.start(args, problem.score) for method in bench.methods)
    is_over = _is_over(bench, problem, states)
    return _Trial(states, problem.start, problem.start.qpos, jnp.zeros(2), is_over)


def _is_over(bench: _Bench, problem: _Problem, states: tuple[object, ...]) -> Array:
    """Returns bool[]: the running searcher has finished the trial."""
    records = [method.record(state) for method, state in zip(bench.methods, states, strict=True)]
    threshold = _search_args(bench, problem).threshold
    return ~jnp.stack([is_running(record, threshold) for record in records])[problem.number]


def _run_generation(bench: _Bench, problem: _Problem, trial: _Trial) -> _Trial:
    """Asks the running searcher for views, observes them and tells it the scores."""
    methods, numbers = bench.methods, range(len(bench.methods))
    key, args = problem.key, _search_args(bench, problem)

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

    views, states = jax.lax.switch(problem.number, [functools.partial(ask, i) for i in numbers], trial.states)
    # Padding is not observed.
    is_requested = jnp.arange(bench.num_views) < jnp.asarray([method.num_views for method in methods])[problem.number]
    observations, motions, scores = _observe_generation(
        bench, (trial.qpos, trial.is_over), (views, is_requested), args.threshold
    )
    # The arm does not move to padding, nor to views after the one that ends the search.
    is_moved = motions.is_found & taken_images(scores, args.threshold) & is_requested
    qpos, costs = _add_motion_costs(bench.env, trial, observations.qpos, motions._replace(is_found=is_moved))
    states, best = jax.lax.switch(problem.number, [functools.partial(tell, i) for i in numbers], states, views, scores)
    best_of_generation = jax.tree.map(lambda x: x[best], observations)
    best_so_far = tree_where(best >= 0, best_of_generation, trial.best)
    return _Trial(states, best_so_far, qpos, costs, _is_over(bench, problem, states))


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
