"""The view-search task (thesis 4.3) as a `brax.envs.Env`."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State
from jax import Array

from vsearch_jax import encoder as encoders
from vsearch_jax import render
from vsearch_jax.config import Config
from vsearch_jax.env.episode import build_obs, check_band, episode_of
from vsearch_jax.geometry import cosine_similarity, wrap_angle
from vsearch_jax.planning import (
    Motion,
    Trajectory,
    duration,
    nearest_cell,
    reachability_map,
    rrt_connect,
    solve_view,
    start_limits,
    straight_duration,
    time_path,
)
from vsearch_jax.planning.execution import check_drive, execute
from vsearch_jax.robot.arm import build_arm, camera_pose, forward_kinematics
from vsearch_jax.scene import SceneError, build_scene
from vsearch_jax.types import (
    Camera,
    EncoderState,
    EpisodeState,
    Image,
    Observation,
    Path,
    PlanStatus,
    ReachabilityMap,
    View,
)
from vsearch_jax.xla.tree import tree_where

_REACH_SEED = 20_191_201
"""Of the starts from which the reachability map is solved: the same map in every run, whatever the run's seed."""

_PLANNING_SEED = 20_191_202
"""Of the random trees: the same path between the same joints, always."""


class ViewSearchEnv(Env):
    """Moves a wrist camera over a sphere until its encoding matches that of a target view.

    Written for one environment; batch by `vmap` or by brax's own wrappers.

    Observation, f32[265] for the LWR: code (128) ‖ target code (128) ‖ joints in rad and m (9).
    Action, f32[2] in [-1, 1]: change of azimuth and elevation in units of `config.env.action_scale_deg`.
    Reward: cosine - 1; `success_reward` where the threshold is met; `unreachable_reward` where the arm can't reach the
    view, and then it stays.

    `done` is 1 where the episode terminated at the threshold. As brax expects, running out of steps is not `done`:
    `info["truncated"]` says it, and brax's EpisodeWrapper ends the episode.
    """

    def __init__(
        self, config: Config | None = None, encoder: EncoderState | None = None, reach: ReachabilityMap | None = None
    ) -> None:
        """Builds the scene; makes what is not given.

        Args:
          config: `Config.preset("cpu")` by default.
          encoder: trained encoder; by default an untrained one, whose codes tell views apart only roughly.
          reach: the arm's reachability map; computed by default.

        Raises:
          SceneError, PlanningError: arm or object can't be loaded, or the arm can't be driven as its motion needs it.
          ConfigError: the arm reaches no elevation at every azimuth (not under a trace, where nothing is known yet).
        """
        self.config = config if config is not None else Config.preset("cpu")
        self.scene = build_scene(self.config.scene)
        self.center = jnp.asarray(self.scene.center, jnp.float32)
        self.arm = build_arm(self.scene)
        if self.config.env.motion == "dynamic":
            check_drive(self.scene, self.arm)
        self.render_scene = render.compile_scene(self.scene.mj_model)
        if not set(self.scene.object_geom_ids) & set(self.render_scene.geom_ids):
            raise SceneError(f"object {self.config.scene.object!r} has no visible geom in the groups 0 to 2")
        self.fovy = math.radians(float(self.scene.mj_model.cam_fovy[self.scene.camera_id]))
        self.encoder = encoder if encoder is not None else encoders.init(jax.random.key(0), self.config)
        self.reach = reach if reach is not None else jax.jit(self.compute_reachability)(jax.random.key(_REACH_SEED))
        check_band(self.reach, self.config)

    @property
    def observation_size(self) -> int:
        """Entries of the observation."""
        return 2 * self.config.encoder.code_size + self.scene.mj_model.nq

    @property
    def action_size(self) -> int:
        """Entries of the action."""
        return 2

    @property
    def backend(self) -> str:
        """The physics backend, by brax's name."""
        return "mjx"

    def reset(self, rng: Array) -> State:
        """Returns the start of an episode: initial view and target both random over the reachable band.

        Args:
          rng: PRNG key (the name is brax's).
        """
        observations = jax.vmap(self.random_observation)(jax.random.split(rng))
        initial, target = (jax.tree.map(lambda x, i=i: x[i], observations) for i in range(2))
        return self.start(initial, target)

    def start(self, observation: Observation, target: Observation) -> State:
        """Returns the start of the episode that looks for `target` from `observation`."""
        episode = EpisodeState(observation=observation, target=target, num_steps=jnp.zeros((), jnp.int32))
        zero = jnp.zeros(())
        info = {"terminated": zero, "truncated": zero, "is_reachable": jnp.ones(())}
        metrics = {"similarity": cosine_similarity(observation.code, target.code), "unreachable": zero}
        metrics |= {"joint_travel": zero, "motion_time": zero}
        return State(
            pipeline_state=episode,  # pyright: ignore[reportArgumentType] # brax lets any pytree stand here
            obs=build_obs(episode),
            reward=zero,
            done=zero,
            metrics=metrics,
            info=info,
        )

    def step(self, state: State, action: Array) -> State:
        """Returns the state after moving by `action` (f32[2], clipped to [-1, 1]); after the end nothing changes."""
        is_over = state.done > 0.0
        moved, motion = self.move_to_view(
            self.commanded_view(state, action), episode_of(state).observation.qpos, is_over
        )
        return tree_where(is_over, state, self.apply_transition(state, moved, motion))

    def commanded_view(self, state: State, action: Array) -> View:
        """Returns the view to which `action` (f32[2], clipped to [-1, 1]) leads, whether or not the arm reaches it."""
        old = episode_of(state).observation.view
        delta = jnp.clip(action, -1.0, 1.0) * math.radians(self.config.env.action_scale_deg)
        return View(wrap_angle(old.azimuth + delta[0]), old.elevation + delta[1])

    def apply_transition(self, state: State, moved: Observation, motion: Motion) -> State:
        """Returns the state after a step that led to `moved`, or nowhere where its motion was not found."""
        episode, task = episode_of(state), self.config.env
        is_reachable = motion.is_found
        observation = tree_where(is_reachable, moved, episode.observation)
        similarity = cosine_similarity(observation.code, episode.target.code)
        is_found = is_reachable & (similarity >= task.threshold)
        reward = jnp.where(is_found, task.success_reward, similarity - 1.0)
        reward = jnp.where(is_reachable, reward, task.unreachable_reward)
        num_steps = episode.num_steps + 1
        terminated = is_found.astype(jnp.float32)
        truncated = (num_steps >= task.episode_length) & ~is_found
        episode = EpisodeState(observation=observation, target=episode.target, num_steps=num_steps)
        reached = is_reachable.astype(jnp.float32)
        flags = {"terminated": terminated, "truncated": truncated.astype(jnp.float32), "is_reachable": reached}
        info = state.info | flags
        costs = {"joint_travel": motion.travel, "motion_time": motion.duration}
        metrics = state.metrics | {"similarity": similarity, "unreachable": 1.0 - reached} | costs
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue] # flax adds it
            pipeline_state=episode, obs=build_obs(episode), reward=reward, done=terminated, metrics=metrics, info=info
        )

    def compute_reachability(self, key: Array) -> ReachabilityMap:
        """Returns the reachability map of the config's arm, mount and object."""
        return reachability_map(self.arm, self.center, self.scene.radius, self.config.ik, key)

    def solve_joints(self, view: View, qpos: Array) -> tuple[Array, Array]:
        """Returns joints f32[nq] for `view`, of those found the nearest to `qpos`, and bool[] is_reachable."""
        result, is_reachable = solve_view(
            self.arm, self.reach, view, qpos, (self.center, self.scene.radius), self.config.ik
        )
        return result.qpos, is_reachable

    def random_pose(self, key: Array) -> tuple[View, Array]:
        """Returns a random reachable view, uniform in azimuth and elevation over the band, and joints f32[nq] for it.

        The arm's configuration varies: of the solutions found it is the one nearest to random joints.
        Where IK fails between the cells of the map, the view of the nearest reachable cell is returned.
        """
        view, qpos, _ = self.resolve_view(*self.random_view(key), jnp.bool_(False))
        return view, qpos

    def resolve_view(self, view: View, qpos: Array, is_fixed: Array) -> tuple[View, Array, Array]:
        """Returns a view, joints f32[nq] for it near `qpos` (f32[nq]), and bool[] whether they reach it.

        Where `view` is not reached, the map's nearest reachable cell takes its place, unless it `is_fixed` (bool[]).
        """
        joints, is_reachable = self.solve_joints(view, qpos)
        stays = is_reachable | is_fixed
        cell = nearest_cell(self.reach, view)
        near = (View(self.reach.azimuths[cell[0]], self.reach.elevations[cell[1]]), self.reach.qpos[cell])
        view, joints = tree_where(stays, (view, joints), near)
        return view, joints, is_reachable | ~is_fixed

    def random_view(self, key: Array) -> tuple[View, Array]:
        """Returns a view, uniform over the band, and random joints f32[nq] to come from."""
        # One draw: each takes longer to compile than what is done with it.
        numbers = jax.random.uniform(key, (2 + self.scene.mj_model.nq,))
        low, high = self.reach.band
        view = View(jnp.pi * (2.0 * numbers[0] - 1.0), low + (high - low) * numbers[1])
        return view, self._joints(numbers[2:])

    def random_joints(self, key: Array) -> Array:
        """Returns f32[nq], the joints that move the camera uniform inside their limits, the others at home."""
        return self._joints(jax.random.uniform(key, (self.scene.mj_model.nq,)))

    def _joints(self, numbers: Array) -> Array:
        lower, upper = start_limits(self.arm)
        address = self.arm.chain.address
        joints = lower + (upper - lower) * numbers
        return self.arm.home.at[address].set(joints[address])

    def random_observation(self, key: Array) -> Observation:
        """Returns what is seen from a random reachable view."""
        view, qpos = self.random_pose(key)
        return self.observe_view(view, qpos)

    def move_to_view(self, view: View, qpos: Array, is_over: Array | None = None) -> tuple[Observation, Motion]:
        """Returns what is seen from `view`, and the motion there from joints `qpos` (f32[nq]).

        Where the search `is_over` (bool[]) or no joints are found the arm stays, since motions take long to compute;
        what is returned is then of no use.
        """
        joints, is_reachable = self.solve_joints(view, qpos)
        joints = jnp.where(is_reachable if is_over is None else is_reachable & ~is_over, joints, qpos)
        has_path = self.config.env.reachable == "path"
        joints, motion = self.move_joints(qpos, joints) if has_path else (joints, self.straight_motion(qpos, joints))
        is_found = is_reachable & motion.is_found
        costs = (jnp.where(is_found, cost, 0.0) for cost in (motion.travel, motion.duration))
        return self.observe_view(view, joints), Motion(is_found, *costs)

    def straight_motion(self, qpos: Array, goal: Array) -> Motion:
        """Returns the straight motion from `qpos` to `goal` (f32[nq] each), whether or not something is in the way."""
        travel = jnp.linalg.norm((goal - qpos)[self.arm.chain.address])
        return Motion(jnp.bool_(True), travel, straight_duration(self.arm, qpos, goal, self.config.planning))

    def move_joints(self, qpos: Array, goal: Array) -> tuple[Array, Motion]:
        """Returns where the arm stands after it was to go from `qpos` to `goal` (f32[nq] each), and the planned motion.

        Without a path it stays. In dynamic motion it follows the path and ends where its dynamics lead.
        """
        is_kinematic = self.config.env.motion == "kinematic"
        if self.arm.joints_without_speed and is_kinematic:
            path = self._path(qpos, goal)
            return path.waypoints[-1], Motion(_is_found(path), path.length, jnp.float32(jnp.nan))
        trajectory, motion = self.plan_motion(qpos, goal)
        if is_kinematic:
            return trajectory.waypoints[-1], motion
        reached = execute(self.arm, self.scene.mjx_model, trajectory, self.config.planning).qpos
        # The limits are soft constraints: the next plan must be able to start from here.
        return jnp.clip(reached, self.arm.lower, self.arm.upper), motion

    def plan_motion(self, qpos: Array, goal: Array) -> tuple[Trajectory, Motion]:
        """Returns the motion from `qpos` to `goal` (f32[nq] each) and what it costs; the same one every time.

        Raises:
          PlanningError: the model gives no speed limit for a joint.
        """
        path = self._path(qpos, goal)
        trajectory = time_path(self.arm, path, self.config.planning)
        return trajectory, Motion(_is_found(path), path.length, duration(trajectory))

    def _path(self, qpos: Array, goal: Array) -> Path:
        return rrt_connect(self.arm, jax.random.key(_PLANNING_SEED), qpos, goal, self.config.planning)

    def observe_view(self, view: View, qpos: Array) -> Observation:
        """Returns what the wrist camera sees with the arm at joints `qpos` (f32[nq]); `view` is only noted."""
        camera, latent = self.observe_latent(qpos)
        return Observation(view=view, qpos=qpos, camera=camera, code=encoders.code_of(self.encoder, latent))

    def observe_latent(self, qpos: Array) -> tuple[Camera, Array]:
        """Returns the wrist camera and the raw latent f32[Z] of its picture with the arm at joints `qpos` (f32[nq])."""
        camera, image = self.wrist_image(qpos)
        return camera, self.raw_latent(image)

    def raw_latent(self, image: Image) -> Array:
        """Returns the raw latent f32[Z] of a picture of the wrist camera."""
        pixels = encoders.network_input(image, jnp.asarray(self.scene.object_geom_ids), self.config)
        return encoders.raw_latent(self.encoder.params, pixels, self.config)

    def wrist_image(self, qpos: Array) -> tuple[Camera, Image]:
        """Returns the wrist camera and its picture with the arm at joints `qpos` (f32[nq])."""
        data, camera = self.forward(qpos)
        size = (self.config.scene.image_size, self.config.scene.image_size)
        return camera, render.render(self.render_scene, data, camera, size)

    def forward(self, qpos: Array) -> tuple[Any, Camera]:
        """Returns MJX data of the arm at joints `qpos` (f32[nq]) and its wrist camera."""
        data = forward_kinematics(self.arm, qpos)
        return data, render.camera_from_pose(camera_pose(self.arm, data), self.fovy)


def _is_found(path: Path) -> Array:
    return path.status == int(PlanStatus.FOUND)
