"""The view-search task (thesis 4.3) as a `brax.envs.Env`."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State
from jax import Array
from mujoco import mjx

from vsearch_jax import encoder as encoders
from vsearch_jax import render
from vsearch_jax.config import Config
from vsearch_jax.env import episode as episodes
from vsearch_jax.env import motion as motions
from vsearch_jax.env.episode import check_band, episode_of
from vsearch_jax.env.parts import build_parts
from vsearch_jax.geometry import view_from_uniform
from vsearch_jax.planning import Motion, Trajectory, nearest_cell, reachability_map, solve_view
from vsearch_jax.robot.arm import camera_pose, forward_kinematics
from vsearch_jax.types import Camera, EncoderState, Image, Observation, ReachabilityMap, View
from vsearch_jax.xla.tree import tree_where

_REACH_SEED = 20_191_201
"""Seed of the reachability map. It is fixed, so the map does not depend on the run's seed."""
_SOLUTION_SEED = 20_191_203
"""Seed of the joints from which further IK solutions of a view are searched. Equal views give equal solutions."""


class ViewSearchEnv(Env):
    """Moves a wrist camera over the view sphere until its code matches the code of a target view.

    Written for one environment. Batch it with `jax.vmap` or with brax's wrappers.

    obs: f32[265] for the LWR: code (128), target code (128), joint values in rad and m (9).
    Action: f32[2] in [-1, 1], change of azimuth and elevation in units of `config.env.action_scale_deg`.
    Reward: cosine similarity minus 1. `success_reward` if the similarity reaches the threshold.
    `unreachable_reward` if the arm cannot reach the view; then the arm stays.

    `done` is 1 if the similarity reached the threshold. Running out of steps is not `done`, as brax expects:
    `info["truncated"]` is 1, and brax's EpisodeWrapper ends the episode.
    """

    def __init__(
        self, config: Config | None = None, encoder: EncoderState | None = None, reach: ReachabilityMap | None = None
    ) -> None:
        """Builds the scene, and each part that is not given.

        Args:
          config: the run's config; `Config.preset("cpu")` by default.
          encoder: trained EncoderState. By default an untrained encoder, whose codes distinguish views only roughly.
          reach: ReachabilityMap of the arm; computed by default.

        Raises:
          ConfigError, SceneError, RenderError, PlanningError: as `build_parts`.
          UnreachableError: there is no elevation that the arm reaches at every azimuth. Not checked while JAX traces.
        """
        self.config = config if config is not None else Config.preset("cpu")
        self.scene, self.arm, self.render_scene = build_parts(self.config)
        self.center = jnp.asarray(self.scene.center, jnp.float32)
        self.fovy = math.radians(float(self.scene.mj_model.cam_fovy[self.scene.camera_id]))
        self.encoder = encoder if encoder is not None else encoders.init(jax.random.key(0), self.config)
        self.reach = reach if reach is not None else jax.jit(self.compute_reachability)(jax.random.key(_REACH_SEED))
        check_band(self.reach, self.config)

    @property
    def observation_size(self) -> int:
        """Length of the policy's input vector `obs` (brax's name)."""
        return 2 * self.config.encoder.code_size + self.scene.mj_model.nq

    @property
    def action_size(self) -> int:
        """Number of entries of an action: change of azimuth and change of elevation (brax's name)."""
        return 2

    @property
    def backend(self) -> str:
        """Name of the physics backend, "mjx"; brax requires this property."""
        return "mjx"

    # -- episode ------------------------------------------------------------------------------------------------------

    def reset(self, rng: Array) -> State:
        """Starts an episode with random ends (see `random_end`): returns its brax State.

        Args:
          rng: PRNG key (brax's name for it).
        """
        views, qpos = jax.vmap(self.random_end)(jax.random.split(rng), jnp.arange(2) == 1)
        observations = jax.vmap(self.observe_view)(views, qpos)
        return self.start(*(jax.tree.map(lambda x, i=i: x[i], observations) for i in range(2)))

    def start(self, observation: Observation, target: Observation) -> State:
        """Starts an episode with given observations: returns its brax State.

        Args:
          observation: what the wrist camera sees from the initial view.
          target: what the wrist camera sees from the target view.
        """
        return episodes.start_state(observation, target)

    def step(self, state: State, action: Array) -> State:
        """Moves the camera by an action, and returns the brax State after it.

        If `done` is set, the episode is over: the arm stays, and the reward is 0.

        Args:
          state: brax State before the action.
          action: f32[2], change of azimuth and elevation in units of `env.action_scale_deg`; clipped to [-1, 1]. A
            view of NaN is unreachable, so an action of NaN earns `unreachable_reward`, and the arm stays.
        """
        is_over = state.done > 0.0
        observation, motion = self.move_to_view(
            self.commanded_view(state, action), episode_of(state).observation.qpos, is_over
        )
        next_state = self.apply_transition(state, observation, motion)
        return tree_where(is_over, episodes.rest_state(state), next_state)

    def commanded_view(self, state: State, action: Array) -> View:
        """Returns the view that an action asks for: the present view plus the action's change. It may be unreachable.

        Args:
          state: brax State before the action.
          action: f32[2], change of azimuth and elevation in units of `env.action_scale_deg`; clipped to [-1, 1].
        """
        return episodes.commanded_view(episode_of(state).observation.view, action, self.config.env.action_scale_deg)

    def apply_transition(self, state: State, observation: Observation, motion: Motion) -> State:
        """Builds the brax State after one step from its observation: reward, `done`, metrics.

        Args:
          state: brax State before the step.
          observation: what the wrist camera sees from the commanded view; ignored if `motion` is not found.
          motion: cost of the motion to that view, and whether it was found. If not, the arm stays.
        """
        return episodes.next_state(state, observation, motion, self.config.env)

    # -- views and configurations -------------------------------------------------------------------------------------

    def compute_reachability(self, key: Array) -> ReachabilityMap:
        """Computes which views the arm reaches, on a grid of views; the PRNG key `key` draws the starts of IK."""
        return reachability_map(self.arm, self.center, self.scene.radius, self.config.ik, key)

    def solve_joints(self, view: View, qpos: Array) -> tuple[Array, Array]:
        """Solves IK for a view: returns joint values that bring the wrist camera there.

        Args:
          view: View to reach, f32[] rad.
          qpos: f32[nq] rad or m, preferred joint values; IK returns the nearest solution that it finds.

        Returns:
          Joint values f32[nq] rad or m; and bool[], whether they reach the view inside the limits and without contact.
        """
        result, is_reachable = solve_view(
            self.arm, self.reach, view, qpos, (self.center, self.scene.radius), self.config.ik
        )
        return result.qpos, is_reachable

    def random_end(self, key: Array, is_target: Array) -> tuple[View, Array]:
        """Draws a view at which an episode starts or ends, and joint values f32[nq] rad or m that reach it.

        The view is uniform over the band (elevations reachable at every azimuth). The joint values are the IK solution
        nearest to random ones. If IK fails, the nearest reachable view of the reachability map's grid is returned.

        Args:
          key: PRNG key.
          is_target: bool[], whether the episode ends at the view. With `env.target` "fixed" it is the fixed target.
        """
        view, qpos = self.random_view(key)
        if self.config.env.target == "fixed":
            view = tree_where(is_target, episodes.protocol_target(self.config), view)
        view, qpos, _ = self.resolve_view(view, qpos, jnp.bool_(False))
        return view, qpos

    def resolve_view(self, view: View, qpos: Array, is_fixed: Array) -> tuple[View, Array, Array]:
        """Returns a view that the arm reaches: `view` itself, or the nearest reachable view of the map's grid.

        Args:
          view: wanted View, f32[] rad.
          qpos: f32[nq] rad or m, preferred joint values; IK returns the nearest solution that it finds.
          is_fixed: bool[], `view` must not be replaced by another view.

        Returns:
          The View; joint values f32[nq] rad or m; and bool[], whether the joint values reach the View. This is false
          only if `view` is fixed and unreachable.
        """
        joints, is_reachable = self.solve_joints(view, qpos)
        is_kept = is_reachable | is_fixed
        cell = nearest_cell(self.reach, view)
        nearest = (View(self.reach.azimuths[cell[0]], self.reach.elevations[cell[1]]), self.reach.qpos[cell])
        view, joints = tree_where(is_kept, (view, joints), nearest)
        return view, joints, is_reachable | ~is_fixed

    def random_view(self, key: Array) -> tuple[View, Array]:
        """Draws a view, uniform over the reachable band, and joint values f32[nq] rad or m, unrelated to the view."""
        # One draw for all numbers, because each draw adds much compile time.
        numbers = jax.random.uniform(key, (2 + self.scene.mj_model.nq,))
        return view_from_uniform(numbers[:2], self.reach.band), motions.joints_from_uniform(self.arm, numbers[2:])

    def random_joints(self, key: Array) -> Array:
        """Draws random joint values f32[nq] rad or m.

        The joints that move the camera are uniform inside their limits. The other joints have their home values.
        """
        return motions.joints_from_uniform(self.arm, jax.random.uniform(key, (self.scene.mj_model.nq,)))

    # -- motions ------------------------------------------------------------------------------------------------------

    def move_to_view(self, view: View, qpos: Array, is_over: Array | None = None) -> tuple[Observation, Motion]:
        """Moves the arm to a view, and returns what the wrist camera sees there and what the motion cost.

        Args:
          view: View to reach, f32[] rad.
          qpos: f32[nq] rad or m, present joint values.
          is_over: bool[], the search has ended. Then the arm stays, which saves computing time, and the result has no
            meaning.

        Returns:
          The observation after the motion, and the cost of the motion. If the view is unreachable, the arm stays and
          `is_found` of the cost is false.
        """
        is_wanted = True if is_over is None else ~is_over
        if self.config.env.reachable == "path":
            joints, motion = self._move_along_path(view, qpos, is_wanted)
        else:
            solution, is_reachable = self.solve_joints(view, qpos)
            joints = jnp.where(is_reachable & is_wanted, solution, qpos)
            motion = self.straight_motion(qpos, joints)._replace(is_found=is_reachable)
        costs = (jnp.where(motion.is_found, cost, 0.0) for cost in (motion.travel, motion.duration))
        return self.observe_view(view, joints), Motion(motion.is_found, *costs)

    def _move_along_path(self, view: View, qpos: Array, is_wanted: Array | bool) -> tuple[Array, Motion]:
        """Moves the arm along a planned path to the first IK solution of a view to which a path leads.

        The first solution is near the present joints `qpos`, the others are near random ones. Returns the joint values
        f32[nq] after the motion, and its cost. If no path is found, or unless `is_wanted`, the arm stays.
        """

        def solution(number: Array) -> tuple[Array, Array]:
            random = self.random_joints(jax.random.fold_in(jax.random.key(_SOLUTION_SEED), number))
            joints, is_reachable = self.solve_joints(view, jnp.where(number == 0, qpos, random))
            return joints, is_reachable & is_wanted

        return motions.move_joints(self.scene, self.arm, qpos, solution, self.config)

    def straight_motion(self, qpos: Array, goal: Array) -> Motion:
        """Returns the cost of a straight motion between two joint vectors. Obstacles are ignored.

        Args:
          qpos: f32[nq] rad or m, joint values at the start.
          goal: f32[nq] rad or m, joint values at the end.
        """
        return motions.straight_motion(self.arm, qpos, goal, self.config.planning)

    def plan_motion(self, qpos: Array, goal: Array) -> tuple[Trajectory, Motion]:
        """Plans a timed motion without contact, and returns it with its cost. Equal arguments give equal results.

        Args:
          qpos: f32[nq] rad or m, joint values at the start.
          goal: f32[nq] rad or m, joint values at the end.

        Raises:
          PlanningError: the model gives no speed limit for a joint.
        """
        return motions.plan_motion(self.arm, qpos, goal, self.config.planning)

    # -- wrist camera -------------------------------------------------------------------------------------------------

    def observe_view(self, view: View, qpos: Array) -> Observation:
        """Returns what the wrist camera sees with the arm at `qpos`: camera pose and image code.

        Args:
          view: View, f32[] rad, of these joint values. It is only stored in the result.
          qpos: f32[nq] rad or m, joint values of the arm.
        """
        camera, latent = self.observe_latent(qpos)
        return Observation(view=view, qpos=qpos, camera=camera, code=encoders.code_of(self.encoder, latent))

    def observe_latent(self, qpos: Array) -> tuple[Camera, Array]:
        """Returns the wrist camera, and its image's raw latent (encoder output, f32[Z]), with the arm at `qpos`."""
        camera, image = self.wrist_image(qpos)
        return camera, self.raw_latent(image)

    def raw_latent(self, image: Image) -> Array:
        """Encodes an image of the wrist camera: returns its raw latent (the encoder's output of Z numbers), f32[Z]."""
        pixels = encoders.network_input(image, jnp.asarray(self.scene.object_geom_ids), self.config)
        return encoders.raw_latent(self.encoder.params, pixels, self.config)

    def wrist_image(self, qpos: Array) -> tuple[Camera, Image]:
        """Returns the wrist camera and the image that it takes, with the arm at `qpos` (f32[nq] rad or m)."""
        data, camera = self.forward(qpos)
        size = (self.config.scene.image_size, self.config.scene.image_size)
        return camera, render.render(self.render_scene, data, camera, size)

    def forward(self, qpos: Array) -> tuple[mjx.Data, Camera]:
        """Computes forward kinematics at `qpos` (f32[nq] rad or m): returns MJX data and the wrist camera in world."""
        data = forward_kinematics(self.arm, qpos)
        return data, render.camera_from_pose(camera_pose(self.arm, data), self.fovy)
